"""`harness eval` and `harness drive`: walk, score, write. A killed run resumes where it was."""

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec

from harness.backends.base import Backend
from harness.backends.cache import cached
from harness.backends.cards import Card
from harness.backends.registry import open_backend
from harness.core.errors import UserError, printable
from harness.core.files import alone, canonical_json, digest, write_whole
from harness.core.memory import uncollected
from harness.core.parallel import spread
from harness.dataset.load import Scene
from harness.evaluate import latency as latencies
from harness.evaluate import timing
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource, FrozenWorld
from harness.evaluate.spec import Spec, versions
from harness.evaluate.walk import table, walk
from harness.runs import folder
from harness.runs.decisions import Decisions
from harness.runs.formats import CONFIG, FORMAT, WORK
from harness.runs.metrics import Grid
from harness.runs.records import Answer, Episode, Latency, Manifest, Score
from harness.runs.summary import counted, scores

if TYPE_CHECKING:  # the simulator is loaded by who drives
    from harness.evaluate.live_world import LiveSource, LiveWorld

EPISODES_AT_ONCE = 8  # of the closed loop that are driven in step and kept together, at least
LEAST_VIEWERS = 4  # asked at once for each of them, the ego and three helpers


@dataclass(frozen=True)
class Evaluated:
    """A finished run: its folder, its manifest and its summary."""

    out: Path
    manifest: Manifest
    scores: Sequence[Score]


def evaluate(
    spec: Spec,
    out: Path,
    resume: bool,
    progress: Callable[[int], None],
    cache: Path | None = None,
    more: Callable[[int], None] = lambda count: None,
    workers: int = 1,
) -> Evaluated:
    """Evaluate a model with a prompt and write the run's folder; the same for any number of workers.

    Args:
        spec: what is evaluated.
        out: the run's folder.
        resume: continue the run that a kill left there.
        progress: called with the number of new answers, or of episodes just driven, those kept from before
            included.
        cache: file of completions kept between runs, for language models; None for no cache.
        more: called with the number of answers that are owed next, where scenes are frozen.
        workers: processes that drive, each with a backend of its own.

    Raises:
        UserError: the folder holds something else, or the model is not available. Nothing is written then.
    """
    if resume and (out / "run.json").is_file():
        return finished(spec, out)
    refuse(spec, out, resume)
    if isinstance(spec.source, FrozenSource):
        done = _frozen(spec, spec.source, out, progress, cache, more)
    else:
        done = _closed_loop(spec, cast("LiveSource", spec.source), out, progress, cache, workers)
    tidy(out)
    return done


@dataclass(frozen=True)
class Walked:
    """All that a walk decided, rounded, how its episodes ended, and the answers by request id."""

    decisions: Decisions
    episodes: Sequence[Episode]
    answers: dict[str, Answer]


def _walked(spec: Spec, world: "FrozenWorld | LiveWorld", asker: Asker) -> Walked:
    decided = list(chain.from_iterable(walk(world, spec.points, asker)))
    decisions = table(decided, world.columns(), spec.actions).rounded()
    return Walked(decisions, world.episodes(), asker.answers)


def _frozen(
    spec: Spec, source: FrozenSource, out: Path, progress: Callable[[int], None], cache: Path | None,
    more: Callable[[int], None],
) -> Evaluated:  # fmt: skip
    dataset = source.dataset
    backend = open_backend(spec.card, device=spec.device, dtype=spec.dtype, batch_size=spec.batch_size)
    latency = _latency(spec, out, backend, lambda: timing.spread_over(dataset.scenes(dataset.courses())))
    with working(spec, out, backend.identity(), latency) as work:
        asked = cached(backend, spec.card, cache)
        asker = Asker(spec, lambda: asked, latency, work / "answers.jsonl", progress=progress, more=more)
        walked = _walked(spec, FrozenWorld(dataset, spec.points, spec.seeds), asker)
        with uncollected():
            return _written(spec, out, work, dataset.episodes, walked, backend.identity(), latency)


def _closed_loop(
    spec: Spec, source: "LiveSource", out: Path, progress: Callable[[int], None], cache: Path | None,
    workers: int,
) -> Evaluated:  # fmt: skip
    # Compiled templates do not travel between processes.
    spec = replace(spec, prompt=replace(spec.prompt))
    # Engines are opened where they answer: a forked process has none of their threads.
    [(identity, latency)] = spread(partial(_begin, out=out), [spec], workers, lambda done: None)
    with working(spec, out, identity, latency) as work:
        size = max(EPISODES_AT_ONCE, math.ceil(spec.batch_size / LEAST_VIEWERS))
        chunks = [range(at, min(at + size, source.episodes)) for at in range(0, source.episodes, size)]
        sizes = iter(map(len, chunks))  # all but the last are of one size, whichever is done first
        drive = partial(_driven, spec, source.first_seed, latency, work, cache)
        parts = spread(drive, chunks, min(workers, len(chunks)), lambda done: progress(next(sizes)))
        with uncollected():
            read = [folder.read_part(part, spec.actions) for part in parts]
            walked = Walked(
                Decisions.concat([decisions for decisions, _, _ in read]),
                [episode for _, episodes, _ in read for episode in episodes],
                {answer.id: answer for _, _, answers in read for answer in answers},
            )
            return _written(spec, out, work, tuple(range(source.episodes)), walked, identity, latency)


def _driven(
    spec: Spec, first_seed: int, latency: Latency, work: Path, cache: Path | None, chunk: range
) -> Path:
    """Drive a chunk, unless a killed run did."""
    from harness.evaluate.live_world import LiveWorld

    part = work / f"episodes-{chunk.start:06d}"
    if not part.is_dir():
        asker = Asker(
            spec, partial(_opened, spec.card, spec.device, spec.dtype, spec.batch_size, cache), latency
        )
        world = LiveWorld(spec.scenario, first_seed, chunk, spec.points, spec.seeds, spec.ego_alone)
        walked = _walked(spec, world, asker)
        folder.write_part(part, walked.decisions, walked.episodes, list(walked.answers.values()))
    return part


def _begin(spec: Spec, out: Path) -> tuple[dict[str, Any], Latency]:
    """Identity of the model and latency of its decisions in the closed loop."""
    backend = _opened(spec.card, spec.device, spec.dtype, spec.batch_size, None)
    source = cast("LiveSource", spec.source)
    return backend.identity(), _latency(
        spec, out, backend, lambda: source.trial(timing.SCENES, spec.ego_alone)
    )


def _latency(spec: Spec, out: Path, backend: Backend, trial: Callable[[], Sequence[Scene]]) -> Latency:
    """What a resumed run began with, or what a new one is to have; `trial` gives scenes to measure it in."""
    if (out / WORK / CONFIG).is_file():
        return msgspec.convert(_begun(out / WORK)["latency"], Latency)
    return latencies.known(spec.latency, spec.card, backend) or timing.measured(spec, backend, trial())


@lru_cache(maxsize=2)
def _opened(
    card: Card, device: str | None, dtype: str | None, batch_size: int, cache: Path | None
) -> Backend:
    """This process's backend, with the cache in front of a language model's."""
    if cache is not None:
        backend = _opened(card, device, dtype, batch_size, None)
        return cached(backend, card, cache)
    return open_backend(card, device=device, dtype=dtype, batch_size=batch_size)


def _written(
    spec: Spec, out: Path, work: Path, numbers: tuple[int, ...], walked: Walked, identity: dict[str, Any],
    latency: Latency,
) -> Evaluated:  # fmt: skip
    """Score a walk and write the run's files, the manifest last."""
    begun = _begun(work)
    spec = spec.tagged(begun)
    again = spec
    if spec.latency == latencies.MEASURED:  # measured again, the times and so the rows would be others
        again = replace(spec, latency=latencies.as_declared(latency))
    grid = Grid(tuple(point.name for point in spec.points), spec.seeds, numbers)
    episodes = counted(grid, walked.decisions, walked.episodes)
    answers = folder.ordered(walked.answers.values(), walked.decisions)
    summary = scores(spec.source.kind, grid, walked.decisions, episodes, answers)
    manifest = msgspec.convert({
        "format": FORMAT, "name": out.name, "created": begun["created"], "command": again.command(out),
        "tags": spec.tags, **spec.settings(), "latency": msgspec.to_builtins(latency),
        "answer_times": msgspec.to_builtins(latencies.times(answers)), "identity": identity,
        "cached_answers": sum(answer.cached for answer in answers),
        "engine_errors": sum(answer.error is not None for answer in answers),
        "retries": sum(answer.retries for answer in answers),
        "versions": versions(),
    }, Manifest)  # fmt: skip
    folder.write(out, manifest, walked.decisions, episodes, answers, summary)
    return Evaluated(out, manifest, summary)


def finished(spec: Spec, out: Path) -> Evaluated:
    """The run that is there already. Raises UserError if it is another run, or damaged."""
    run = folder.read(out)
    _same(spec.settings(), msgspec.json.decode(msgspec.json.encode(run.manifest)), out)
    tidy(out)
    return Evaluated(out, run.manifest, run.scores)


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
        _same(spec.settings(), _begun(out / WORK)["settings"], out)
    elif out.exists() and (not out.is_dir() or any(p.name != WORK for p in out.iterdir())):
        raise UserError(f"--out {shown} exists and is no run; choose another folder")
    if spec.latency == latencies.MEASURED and not (out / WORK / CONFIG).is_file():
        timing.refuse_busy()


def _begun(work: Path) -> dict[str, Any]:
    begun: dict[str, Any] = msgspec.json.decode((work / CONFIG).read_bytes())
    return begun


def _same(settings: dict[str, Any], stored: dict[str, Any], out: Path) -> None:
    """Refuse to go on with other settings, naming those that differ."""
    now = msgspec.json.decode(canonical_json(settings))
    other = _differing(now, stored)
    if "world" in other and "world" in stored:
        # It may lie in another folder now.
        inside = [key for key in _differing(now["world"], stored["world"]) if key != "path"]
        other = [key for key in other if key != "world"] + [f"{key} of the world" for key in inside]
    if other:
        raise UserError(
            f"--resume: {printable(out)} was begun with another {', '.join(other)}; "
            "repeat its settings, or choose another --out"
        )


def _differing(now: dict[str, Any], stored: dict[str, Any]) -> list[str]:
    return [key for key, value in now.items() if stored.get(key) != value]


@contextmanager
def working(spec: Spec, out: Path, identity: dict[str, Any], latency: Latency) -> Iterator[Path]:
    """The working folder, new or the one that a kill left. A new one goes again if the input proves bad."""
    work, made = out / WORK, [path for path in (out, *out.parents) if not path.exists()]
    new = not (work / CONFIG).is_file()
    if not new and _begun(work)["identity"] != digest(identity):
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
                         "tags": spec.tags, "latency": msgspec.to_builtins(latency)}  # fmt: skip
                write_whole(work / CONFIG, canonical_json(begun))
            yield work
    except BlockingIOError:
        raise UserError(f"--out {printable(out)} is being written by another process; wait for it") from None
    except UserError:
        if new:
            shutil.rmtree(work)
            for path in made:
                with suppress(OSError):  # somebody else's run is in it by now
                    path.rmdir()
        raise
