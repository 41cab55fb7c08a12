"""`harness eval`: ask, score, write. A run killed at any moment goes on where it was."""

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.backends.cache import cached
from harness.backends.registry import open_backend
from harness.coordination.channel import Draws
from harness.core.errors import UserError, printable
from harness.core.files import alone, canonical_json, digest, write_whole
from harness.core.memory import uncollected
from harness.evaluate import merging
from harness.evaluate.asking import Answer, ask_all, requests
from harness.evaluate.intents import Answered, intents
from harness.evaluate.merging import Merged
from harness.evaluate.scoring import draw, score
from harness.evaluate.spec import FORMAT, Spec, versions
from harness.evaluate.success import Table, table
from harness.evaluate.timing import inference_s, measure, merge_latency, merge_s, settled
from harness.runs import record
from harness.runs.summary import summary

if TYPE_CHECKING:
    import pandas as pd

WORK = ".work"
CONFIG = "config.json"  # what the run was begun with; its work counts only once this is there


@dataclass(frozen=True)
class Evaluated:
    """A finished run: its folder, its manifest and its summary."""

    out: Path
    manifest: dict[str, Any]
    summary: "pd.DataFrame"


@dataclass(frozen=True)
class Told:
    """What the answers say, laid out to be scored: episodes, intents, draws by seed."""

    laid: Table
    known: Answered
    draws: Mapping[int, Draws]


def evaluate(
    spec: Spec,
    out: Path,
    resume: bool,
    progress: Callable[[int], None],
    cache: Path | None = None,
    more: Callable[[int], None] = lambda count: None,
) -> Evaluated:
    """Evaluate a model with a prompt on a dataset and write the run's folder.

    Args:
        spec: what is evaluated.
        out: the run's folder.
        resume: go on with the run that a kill left there.
        progress: called with the number of answers just had, those kept from before included.
        cache: file of completions kept between runs, for language models; None to ask for every answer.
        more: called with the number of second questions, once it is known how many there are.

    Raises:
        UserError: the folder holds something else, or the model cannot be had. Nothing is written then.
    """
    if resume and (out / "run.json").is_file():
        return finished(spec, out)
    refuse(spec, out, resume)
    backend = open_backend(spec.card, device=spec.device, dtype=spec.dtype, batch_size=spec.batch_size)
    identity = backend.identity()
    with working(spec, out, identity) as work:
        # Times are had from the backend itself: the cache answers in no time, which is nobody's.
        latency = measure(spec, backend, work / "latency.json")
        asked = cached(backend, spec.card, cache)
        kept = work / "answers.jsonl"
        by_id = ask_all(spec, asked, requests(spec, spec.dataset.scenes), kept, progress)
        latency = settled(spec, backend, latency, by_id, work / "latency.json")
        with uncollected():
            told = _told(spec, by_id, latency)
        codes = merging.delivered(told.known, spec.points, told.draws.values())
        again = list(merging.requests(spec, told.known, codes))
        more(len(again))
        by_id = ask_all(spec, asked, again, kept, progress) if again else by_id
        latency = merge_latency(spec, backend, latency, again, by_id, work / "latency.json")
        answers = [by_id[request.id] for request in again]
        second = merging.merged(spec, codes, answers, merge_s(latency, answers))
        begun = json.loads((work / CONFIG).read_text())
        done = _scored(spec.tagged(begun), out, told, second, {
            "created": begun["created"], "identity": identity, "latency": latency,
            "cached_answers": sum(answer["cached"] for answer in by_id.values()),
            "engine_errors": sum(answer["error"] is not None for answer in by_id.values()),
        })  # fmt: skip
    tidy(out)
    return done


def _told(spec: Spec, by_id: Mapping[str, Answer], latency: Mapping[str, Any]) -> Told:
    laid, known = table(spec.dataset), intents(spec.dataset, by_id, spec.answer, spec.thinking)
    draws = {seed: draw(laid, seed, known.valid.shape) for seed in spec.seeds}
    return Told(laid, replace(known, inference_s=inference_s(latency, known.answers)), draws)


@uncollected()
def _scored(spec: Spec, out: Path, told: Told, second: Merged, begun: Mapping[str, Any]) -> Evaluated:
    """Score the answers and write the run's files; `begun` is what its manifest says of its making."""
    laid, known = told.laid, told.known
    runs = [
        score(laid, known, point, seed, told.draws[seed], second)
        for point in spec.points for seed in spec.seeds
    ]  # fmt: skip
    result = summary(spec, laid, known, runs, second)
    manifest = {
        "format": FORMAT,
        "name": out.name,
        "created": begun["created"],
        "command": spec.command(out),
        "tags": list(spec.tags),
        **spec.settings(),
        **{key: begun[key] for key in ("identity", "latency", "cached_answers", "engine_errors")},
        "delay_allowance_s": laid.allowance_s,
        "versions": versions(),
    }
    manifest["dataset"]["path"] = str(spec.dataset.path)
    write_whole(out / "rows.jsonl", "".join(record.rows(spec, laid, known, runs, second)))
    write_whole(out / "episodes.csv", record.episodes(spec, laid, runs).to_csv(index=False))
    write_whole(out / "summary.csv", result.to_csv(index=False))
    write_whole(out / "run.json", json.dumps(manifest, indent=1, allow_nan=False) + "\n")
    return Evaluated(out, manifest, result)


def finished(spec: Spec, out: Path) -> Evaluated:
    """The run that is there already. Raises UserError if it is another one, or damaged."""
    import pandas as pd

    try:
        manifest = json.loads((out / "run.json").read_text())
        _same(spec.settings(), manifest, out)
        # Names stay text: a model may be called "null" and a prompt "1".
        text = dict.fromkeys(("model", "prompt", "answer", "condition", "metric", "interval"), str)
        result = pd.read_csv(
            out / "summary.csv",
            dtype=text,
            keep_default_na=False,
            na_values=[""],
            float_precision="round_trip",
        )
    except (OSError, ValueError, AttributeError) as error:
        raise UserError(
            f"--out {printable(out)} holds a damaged run ({printable(error)}); delete it and run again"
        ) from None
    tidy(out)
    return Evaluated(out, manifest, result)


def tidy(out: Path) -> None:
    """Remove what the work left, and what kills left of files half written."""
    shutil.rmtree(out / WORK, ignore_errors=True)
    for part in out.glob(".*.part"):
        part.unlink(missing_ok=True)


def refuse(spec: Spec, out: Path, resume: bool) -> None:
    """Raise before anything is loaded or written, if the folder cannot be used."""
    shown = printable(out)
    if (out / "run.json").exists():
        raise UserError(f"--out {shown} already holds a finished run; choose another folder or delete it")
    if (out / WORK / CONFIG).is_file():
        if not resume:
            raise UserError(f"--out {shown} holds an unfinished run; add --resume to go on, or delete it")
        _same(spec.settings(), json.loads((out / WORK / CONFIG).read_text())["settings"], out)
    elif out.exists() and (not out.is_dir() or any(p.name != WORK for p in out.iterdir())):
        raise UserError(f"--out {shown} exists and is no run; choose another folder")


def _same(settings: dict[str, Any], stored: dict[str, Any], out: Path) -> None:
    """Refuse to go on with other settings, naming those that differ."""
    other = [
        key for key, value in settings.items() if _stored(stored, key) != json.loads(canonical_json(value))
    ]
    if other:
        raise UserError(
            f"--resume: {printable(out)} was begun with another {', '.join(other)}; "
            "repeat its settings, or choose another --out"
        )


def _stored(stored: dict[str, Any], key: str) -> Any:
    value = stored.get(key)
    return {k: v for k, v in value.items() if k != "path"} if key == "dataset" and value else value


@contextmanager
def working(spec: Spec, out: Path, identity: dict[str, Any]) -> Iterator[Path]:
    """The working folder, new or the one that a kill left. A new one goes again if the input proves bad."""
    work, existed = out / WORK, out.exists()
    new = not (work / CONFIG).is_file()
    if not new and json.loads((work / CONFIG).read_text())["identity"] != digest(identity):
        raise UserError(
            f"--resume: the model behind {printable(spec.card.name)} is not the one this run was begun with "
            "(its files, package versions or device differ); start a new run in another --out"
        )
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"--out {printable(out)} cannot be made ({error.strerror}); choose another folder"
        ) from None
    try:
        with alone(work / "lock"):
            if new:
                (work / "answers.jsonl").unlink(missing_ok=True)
                begun = {"created": datetime.now(UTC).isoformat(timespec="seconds"),
                         "settings": spec.settings(), "identity": digest(identity),
                         "tags": spec.tags}  # fmt: skip
                write_whole(work / CONFIG, canonical_json(begun))
            yield work
    except BlockingIOError:
        raise UserError(f"--out {printable(out)} is being written by another process; wait for it") from None
    except UserError:
        if new:
            shutil.rmtree(work)
            if not existed:
                out.rmdir()
        raise
