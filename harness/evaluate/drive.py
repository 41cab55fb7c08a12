"""`harness drive`: drive, score, write. A run killed at any moment goes on with the episodes still owed."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.core.files import canonical_json, write_whole
from harness.core.memory import uncollected
from harness.core.parallel import spread
from harness.evaluate.evaluate import Evaluated, finished, refuse, tidy, working
from harness.evaluate.live import drive
from harness.evaluate.live_model import begin, opened
from harness.evaluate.live_spec import Drive
from harness.evaluate.spec import versions
from harness.runs import driven_record as record
from harness.runs.driven_record import Row
from harness.runs.driven_summary import summary
from harness.runs.folder import answers_of
from harness.runs.formats import CONFIG, DRIVE

if TYPE_CHECKING:
    pass

EPISODES_AT_ONCE = 8  # driven in step and kept together, at least
LEAST_VIEWERS = 4  # asked at once for each of them, the ego and three helpers


def run(
    spec: Drive,
    out: Path,
    resume: bool,
    workers: int,
    progress: Callable[[int], None],
    cache: Path | None = None,
) -> Evaluated:
    """Drive a model with a prompt and write the run's folder; the same for any number of workers.

    Args:
        spec: what is driven.
        out: the run's folder.
        resume: go on with the run that a kill left there.
        workers: processes, each with a backend of its own.
        progress: called with the number of episodes just driven, those kept from before included.
        cache: file of completions kept between runs, for language models; None to ask for every answer.

    Raises:
        UserError: the folder holds something else, or the model cannot be had. Nothing is written then.
    """
    if resume and (out / "run.json").is_file():
        return finished(spec, out)
    refuse(spec, out, resume)
    # Compiled templates do not travel between processes.
    spec = replace(spec, prompt=replace(spec.prompt))
    # Engines are opened where they are asked: a process that is forked has none of their threads.
    [(identity, latency)] = spread(begin, [spec], workers, lambda done: None)
    with working(spec, out, identity) as work:
        kept = work / "latency.json"
        if kept.is_file():
            latency = json.loads(kept.read_text())
        else:
            write_whole(kept, canonical_json(latency))
        chunks = _chunks(spec)
        sizes = iter(map(len, chunks))  # all but the last are of one size, whichever is done first
        todo = partial(_driven, spec, latency, work, cache)
        spread(todo, chunks, min(workers, len(chunks)), lambda done: progress(next(sizes)))
        begun = json.loads((work / CONFIG).read_text())
        told = {"created": begun["created"], "identity": identity, "latency": latency}
        done = _written(spec.tagged(begun), out, work, told)
    tidy(out)
    return done


def _chunks(spec: Drive) -> list[range]:
    """Numbers of episodes that are driven together: enough to fill a batch."""
    size = max(EPISODES_AT_ONCE, math.ceil(spec.batch_size / LEAST_VIEWERS))
    return [range(at, min(at + size, spec.episodes)) for at in range(0, spec.episodes, size)]


def _file(work: Path, chunk: range) -> Path:
    return work / f"episodes-{chunk.start:06d}.json"


def _driven(spec: Drive, latency: Mapping[str, Any], work: Path, cache: Path | None, chunk: range) -> None:
    """Drive a chunk, unless that was done before."""
    if not _file(work, chunk).is_file():
        backend = opened(spec.card, spec.device, spec.dtype, spec.batch_size, cache)
        moments, episodes = drive(spec, backend, latency, chunk)
        write_whole(_file(work, chunk), canonical_json({"moments": moments, "episodes": episodes}))


@uncollected()
def _written(spec: Drive, out: Path, work: Path, begun: Mapping[str, Any]) -> Evaluated:
    """Write the run's files from what was kept; `begun` is what its manifest says of its beginning."""
    parts = [json.loads(_file(work, chunk).read_text(encoding="utf-8")) for chunk in _chunks(spec)]
    moments: list[Row] = [row for part in parts for row in part["moments"]]
    episodes: list[Row] = [row for part in parts for row in part["episodes"]]
    result = summary(spec, moments, episodes)
    answers = [a for row in moments for a in answers_of(row).values()]
    manifest = {
        "format": DRIVE,
        "name": out.name,
        "created": begun["created"],
        "command": spec.command(out),
        "tags": list(spec.tags),
        **spec.settings(),
        "identity": begun["identity"],
        "latency": begun["latency"],
        "late_against": "full-view driver, whose decisions act at once",
        "cached_answers": sum(answer["cached"] for answer in answers),
        "engine_errors": sum(answer["error"] is not None for answer in answers),
        "versions": versions(),
    }
    write_whole(out / "rows.jsonl", "".join(canonical_json(row) + "\n" for row in moments))
    write_whole(out / "episodes.csv", record.episodes(spec, episodes).to_csv(index=False))
    write_whole(out / "summary.csv", result.to_csv(index=False))
    write_whole(out / "run.json", json.dumps(manifest, indent=1, allow_nan=False) + "\n")
    return Evaluated(out, manifest, result)
