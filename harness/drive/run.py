"""`harness drive`: drive, score, write. A run killed at any moment goes on with the episodes still owed."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from harness.backends.base import Backend, Rendering
from harness.backends.cache import Cached
from harness.backends.registry import open_backend
from harness.cards import Card
from harness.drive.engine import P, drive, look, start
from harness.drive.record import Row
from harness.drive.spec import FORMAT, Drive
from harness.drive.summary import summary
from harness.errors import UserError, printable
from harness.files import canonical_json, write_whole
from harness.memory import uncollected
from harness.run import merging
from harness.run.asking import answer_of, requests
from harness.run.evaluate import CONFIG, Evaluated, finished, refuse, tidy, working
from harness.run.intents import intents
from harness.run.spec import versions
from harness.run.timing import SAMPLE, measure, merge_latency
from harness.workers import spread

if TYPE_CHECKING:
    import pandas as pd

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
    [(identity, latency)] = spread(_begin, [spec], workers, lambda done: None)
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
        created = json.loads((work / CONFIG).read_text())["created"]
        done = _written(spec, out, work, {"created": created, "identity": identity, "latency": latency})
    tidy(out)
    return done


def _begin(spec: Drive) -> tuple[dict[str, Any], dict[str, Any]]:
    """Identity of the model and latency of its decisions.

    An answer's own seconds depend on what else the machine does, so a measured latency is always the median
    of a sample: the same in every episode, with any number of workers.
    """
    backend = _opened(spec.card, spec.device, spec.dtype, spec.batch_size, None)
    scenes = []
    for number in range(min(SAMPLE, spec.episodes)):
        trajectory = start(spec, number)
        trajectory.world.advance(round(number * P.decision_period_s * P.simulation_hz / 2))
        scenes.append(look(spec, trajectory, 0))
    sample = replace(spec, dataset=replace(spec.dataset, scenes=tuple(scenes)), batch_size=2)
    with TemporaryDirectory() as folder:
        latency = measure(sample, backend, Path(folder) / "latency.json")
    if any(point.asks_again for point in spec.points):
        asked = list(requests(sample, scenes))
        by_id = {r.id: answer_of(r, c) for r, c in zip(asked, backend.complete(asked), strict=True)}
        known = intents(sample.dataset, by_id, spec.answer, spec.thinking)
        heard = merging.codes_of(known.valid)[known.valid.any(axis=1)]
        second = list(merging.requests(sample, known, heard))
        latency = {
            "merge_s": latency["inference_s"]["ego"],
            **merge_latency(sample, backend, latency, second, {}),
        }
    if latency["inference_s"] is None or None in latency["inference_s"].values():
        raise UserError(
            f"--model {printable(spec.card.name)}: none of {len(scenes)} trial answers could be timed, and "
            "no episode goes on without a latency; see what `harness model check` says"
        )
    return backend.identity(), latency


@lru_cache(maxsize=2)
def _opened(
    card: Card, device: str | None, dtype: str | None, batch_size: int, cache: Path | None
) -> Backend:
    """This process's backend."""
    if cache is not None:
        backend = _opened(card, device, dtype, batch_size, None)
        return Cached(backend, cache) if isinstance(backend, Rendering) else backend
    return open_backend(card, device=device, dtype=dtype, batch_size=batch_size)


def _chunks(spec: Drive) -> list[range]:
    """Numbers of episodes that are driven together: enough to fill a batch."""
    size = max(EPISODES_AT_ONCE, math.ceil(spec.batch_size / LEAST_VIEWERS))
    return [range(at, min(at + size, spec.episodes)) for at in range(0, spec.episodes, size)]


def _file(work: Path, chunk: range) -> Path:
    return work / f"episodes-{chunk.start:06d}.json"


def _driven(spec: Drive, latency: Mapping[str, Any], work: Path, cache: Path | None, chunk: range) -> None:
    """Drive a chunk, unless that was done before."""
    if not _file(work, chunk).is_file():
        backend = _opened(spec.card, spec.device, spec.dtype, spec.batch_size, cache)
        moments, episodes = drive(spec, backend, latency, chunk)
        write_whole(_file(work, chunk), canonical_json({"moments": moments, "episodes": episodes}))


@uncollected()
def _written(spec: Drive, out: Path, work: Path, begun: Mapping[str, Any]) -> Evaluated:
    """Write the run's files from what was kept; `begun` is what its manifest says of its beginning."""
    parts = [json.loads(_file(work, chunk).read_text(encoding="utf-8")) for chunk in _chunks(spec)]
    moments: list[Row] = [row for part in parts for row in part["moments"]]
    episodes: list[Row] = [row for part in parts for row in part["episodes"]]
    result = summary(spec, moments, episodes)
    answers = [a for row in moments for a in (*row["answers"].values(), *row.get("merged", {}).values())]
    manifest = {
        "format": FORMAT,
        "name": out.name,
        "created": begun["created"],
        "command": spec.command(out),
        **spec.settings(),
        "identity": begun["identity"],
        "latency": begun["latency"],
        "late_against": "full-view driver, whose decisions act at once",
        "cached_answers": sum(answer["cached"] for answer in answers),
        "engine_errors": sum(answer["error"] is not None for answer in answers),
        "versions": versions(),
    }
    write_whole(out / "rows.jsonl", "".join(canonical_json(row) + "\n" for row in moments))
    write_whole(out / "episodes.csv", _table(spec, episodes).to_csv(index=False))
    write_whole(out / "summary.csv", result.to_csv(index=False))
    write_whole(out / "run.json", json.dumps(manifest, indent=1, allow_nan=False) + "\n")
    return Evaluated(out, manifest, result)


def _table(spec: Drive, episodes: Sequence[Row]) -> "pd.DataFrame":
    """The table of `episodes.csv`: a frozen run's columns, then what only driving shows."""
    import pandas as pd

    return pd.DataFrame(
        {
            "model": spec.card.name, "prompt": spec.prompt.version, "answer": spec.answer,
            "condition": e["condition"], "seed": e["seed"], "episode": e["episode"], "danger": e["danger"],
            "success": e["result"] == "cleared", "failure": "" if e["result"] == "cleared" else e["result"],
            "delay_s": e["delay_s"], "messages": e["messages"], "trigger_rate": e["means"]["triggered"],
            "latency_ms": e["means"]["latency_ms"], "deadline_misses": e["deadline_misses"],
            **{k: e[k] for k in (
                "layout_seed", "time_s", "partner", "striker", "fault", "least_gap_m", "hard_brakings",
                "other_crashes", "decisions", "skipped", "never_acted",
            )},
        }
        for e in episodes
    )  # fmt: skip
