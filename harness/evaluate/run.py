"""`harness eval` and `harness drive`: walk, score, write. A run that was stopped goes on where it was."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import msgspec

from harness.backends.base import Backend
from harness.backends.registry import open_backend, opened
from harness.backends.swarm import open_each, together
from harness.core import work
from harness.core.errors import UserError, printable
from harness.core.files import digest
from harness.core.formats import FORMAT, WORK
from harness.core.memory import uncollected
from harness.core.parallel import spread
from harness.dataset.load import Scene
from harness.evaluate import device, timing
from harness.evaluate import latency as latencies
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource, FrozenWorld
from harness.evaluate.spec import Spec, versions
from harness.evaluate.walk import table, walk
from harness.runs import folder
from harness.runs.decisions import Decisions
from harness.runs.metrics import Grid
from harness.runs.records import Answer, Episode, Latency, Manifest, Score
from harness.runs.summary import counted, scores

if TYPE_CHECKING:  # the simulator is loaded by who drives
    from harness.evaluate.live_world import LiveSource, LiveWorld

Opens = Callable[..., Backend]  # as `open_backend` is called
NOTHING: Mapping[str, Answer] = MappingProxyType({})
EPISODES_AT_ONCE = 16  # of the closed loop that are driven in step and kept together, at least
LEAST_VIEWERS = 4  # asked at once for each of them, the ego and three helpers


class Begun(work.Begun, frozen=True, kw_only=True):
    """What a run began with, which it keeps when it goes on."""

    created: str
    identity: str  # digest of the model's
    tags: tuple[str, ...]
    latency: Latency


@dataclass(frozen=True)
class Evaluated:
    """A finished run: its folder, its manifest and its summary."""

    out: Path
    manifest: Manifest
    scores: Sequence[Score]


def evaluate(
    spec: Spec,
    out: Path,
    progress: Callable[[int], None],
    cache: Path | None = None,
    more: Callable[[int], None] = lambda count: None,
    workers: int = 1,
    opens: Opens | None = None,
    given: Mapping[str, Answer] = NOTHING,
) -> Evaluated:
    """Evaluate a model with a prompt and write the run's folder; the same for any number of workers.

    What was stopped there before goes on. The working folder stays until `work.tidy`, which whoever adds to
    the run calls at the end.

    Args:
        spec: what is evaluated.
        out: the run's folder.
        progress: called with the number of new answers, or of episodes just driven, those kept from before
            included.
        cache: file of completions kept between runs, for language models; None for no cache.
        more: called with the number of answers that are owed next, where scenes are frozen.
        workers: processes that drive, each with a backend of its own.
        opens: in the place of `open_backend`, where scenes are frozen: what it gives may be open already.
        given: answers that are there already, by request id, where scenes are frozen.

    Raises:
        UserError: the folder holds something else, or the model is not available. Nothing is written then.
    """
    if (out / "run.json").exists():
        if (out / WORK).is_dir():
            return finished(spec, out)
        raise UserError(
            f"--out {printable(out)} already holds a finished run; choose another folder or delete it"
        )
    begun = left(spec, out)
    if not begun and spec.latency == latencies.MEASURED:
        timing.refuse_busy()
    if isinstance(spec.source, FrozenSource):
        return _frozen(spec, spec.source, out, begun, progress, cache, more, opens or open_backend, given)
    return _closed_loop(spec, cast("LiveSource", spec.source), out, begun, progress, cache, workers)


@dataclass(frozen=True)
class Walked:
    """All that a walk decided, rounded, how its episodes ended, and the answers by request id."""

    decisions: Decisions
    episodes: Sequence[Episode]
    answers: dict[str, Answer]


def _walked(spec: Spec, world: "FrozenWorld | LiveWorld", asker: Asker) -> Walked:
    decided = list(chain.from_iterable(walk(world, spec.points, asker)))
    decisions = table(decided, world.columns(), spec.actions)
    if spec.device_profile:
        answers = asker.answers.values()
        taken = device.energy(spec.device_profile, asker.latency, spec.points, decisions, answers)
        decisions = decisions.replace(**taken)
    decisions = decisions.rounded()
    return Walked(decisions, world.episodes(), asker.answers)


def _frozen(
    spec: Spec, source: FrozenSource, out: Path, begun: Begun | None, progress: Callable[[int], None],
    cache: Path | None, more: Callable[[int], None], opens: Opens, given: Mapping[str, Answer],
) -> Evaluated:  # fmt: skip
    dataset = source.dataset
    options = {"device": spec.device, "dtype": spec.dtype, "batch_size": spec.batch_size}
    models = open_each(spec.cards, partial(opens, **options))
    identity = together(spec.cards, models).identity()
    latency = _latency(spec, begun, models, lambda: timing.spread_over(dataset.scenes(dataset.courses())))
    begun = _begin(spec, out, begun, identity, latency)
    with work.working(out, begun, "run.json") as place:
        asked = together(spec.cards, models, cache)
        asker = Asker(spec, lambda: asked, latency, place / "answers.jsonl", given, progress, more)
        walked = _walked(spec, FrozenWorld(dataset, spec.points, spec.seeds), asker)
        with uncollected():
            return _written(spec, out, begun, dataset.episodes, walked, identity)


def _closed_loop(
    spec: Spec, source: "LiveSource", out: Path, begun: Begun | None, progress: Callable[[int], None],
    cache: Path | None, workers: int,
) -> Evaluated:  # fmt: skip
    # Engines are opened where they answer: a forked process has none of their threads.
    [(identity, latency)] = spread(partial(_model, begun=begun), [spec], workers, lambda done: None)
    begun = _begin(spec, out, begun, identity, latency)
    with work.working(out, begun, "run.json") as place:
        size = max(EPISODES_AT_ONCE, math.ceil(spec.batch_size / LEAST_VIEWERS))
        chunks = [source.numbers[at : at + size] for at in range(0, len(source.numbers), size)]
        sizes = iter(map(len, chunks))  # all but the last are of one size, whichever is done first
        drive = partial(_driven, spec, source.first_seed, latency, place, cache)
        parts = spread(drive, chunks, min(workers, len(chunks)), lambda done: progress(next(sizes)))
        with uncollected():
            read = [folder.read_part(part, spec.actions) for part in parts]
            walked = Walked(
                Decisions.concat([decisions for decisions, _, _ in read]),
                [episode for _, episodes, _ in read for episode in episodes],
                {answer.id: answer for _, _, answers in read for answer in answers},
            )
            return _written(spec, out, begun, tuple(source.numbers), walked, identity)


def _driven(
    spec: Spec, first_seed: int, latency: Latency, place: Path, cache: Path | None, chunk: Sequence[int]
) -> Path:
    """Drive a chunk, unless a killed run did."""
    from harness.evaluate.live_world import LiveWorld

    part = place / f"episodes-{chunk[0]:06d}"
    if not part.is_dir():
        asker = Asker(spec, lambda: together(spec.cards, _opened_all(spec), cache), latency)
        world = LiveWorld(spec.scenario, first_seed, chunk, spec.points, spec.seeds, spec.ego_alone)
        walked = _walked(spec, world, asker)
        folder.write_part(part, walked.decisions, walked.episodes, list(walked.answers.values()))
    return part


def _model(spec: Spec, begun: Begun | None) -> tuple[dict[str, Any], Latency]:
    """Identity of the models and latency of their decisions in the closed loop."""
    models, source = _opened_all(spec), cast("LiveSource", spec.source)
    latency = _latency(spec, begun, models, lambda: source.trial(timing.SCENES, spec.ego_alone))
    return together(spec.cards, models).identity(), latency


def _latency(
    spec: Spec, begun: Begun | None, models: Sequence[Backend], trial: Callable[[], Sequence[Scene]]
) -> Latency:
    """What the run began with, or what a new one is to have; `trial` gives scenes to measure it in."""
    if begun:
        return begun.latency
    if spec.device_profile:
        return device.of_device(spec.device_profile, spec.device_model, spec.agents)
    declared = latencies.known(spec.latency, spec.agents, models)
    return declared or timing.measured(spec, together(spec.cards, models), trial())


def _opened_all(spec: Spec) -> list[Backend]:
    """This process's backends of a run's agents."""
    return [opened(card, spec.device, spec.dtype, spec.batch_size) for card in spec.cards]


def _written(
    spec: Spec, out: Path, begun: Begun, numbers: tuple[int, ...], walked: Walked, identity: dict[str, Any]
) -> Evaluated:
    """Score a walk and write the run's files, the manifest last."""
    spec, latency = replace(spec, tags=tuple(dict.fromkeys((*begun.tags, *spec.tags)))), begun.latency
    again = spec
    if spec.latency == latencies.MEASURED:  # measured again, the times and so the rows would be others
        again = replace(spec, latency=latencies.as_declared(latency))
    grid = Grid(tuple(point.name for point in spec.points), spec.seeds, numbers)
    episodes = counted(grid, walked.decisions, walked.episodes)
    answers = folder.ordered(walked.answers.values(), walked.decisions)
    summary = scores(spec.source.kind, grid, walked.decisions, episodes, answers)
    manifest = msgspec.convert({
        "format": FORMAT, "name": out.name, "created": begun.created, "command": again.command(out),
        "tags": spec.tags, **spec.settings(), "latency": msgspec.to_builtins(latency),
        "answer_times": msgspec.to_builtins(latencies.times(answers)), "identity": identity,
        "cached_answers": sum(answer.cached for answer in answers),
        "engine_errors": sum(answer.error is not None for answer in answers),
        "retries": sum(answer.retries for answer in answers),
        "versions": versions(),
    }, Manifest)  # fmt: skip
    folder.write(out, manifest, walked.decisions, episodes, answers, summary)
    return Evaluated(out, manifest, summary)


def made(
    spec: Spec, out: Path, progress: Callable[[int], None], cache: Path | None, more: Callable[[int], None],
    opens: Opens, given: Mapping[str, Answer] = NOTHING,
) -> folder.Run:  # fmt: skip
    """One of several runs in a study's folder: read where it is there, else evaluated (see `evaluate`)."""
    if (out / "run.json").is_file() and not (out / WORK).is_dir():
        finished(spec, out)
    else:
        evaluate(spec, out, progress, cache, more, opens=opens, given=given)
        work.tidy(out)
    return folder.read(out)


def finished(spec: Spec, out: Path) -> Evaluated:
    """The run that is there already. Raises UserError if it is another run, or damaged."""
    run = folder.read(out)
    stored = msgspec.json.decode(msgspec.json.encode(run.manifest))
    work.same(out, _compared(spec.settings()), _compared({key: stored[key] for key in spec.settings()}))
    return Evaluated(out, run.manifest, run.scores)


def left(spec: Spec, out: Path) -> Begun | None:
    """What a stopped run in a folder began with. Raises UserError if it, or what is there, is another."""
    begun = work.begun(out, Begun)
    if begun:
        work.same(out, _compared(spec.settings()), _compared(begun.settings))
    return begun


def goes_on(spec: Spec, out: Path) -> bool:
    """Whether this was begun in a folder, stopped there, and nobody is at it."""
    try:
        return left(spec, out) is not None and not work.held(out)
    except UserError:
        return False


def _compared(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as they are compared: those of the world by name, but for the folder where it lies now."""
    world = {f"{key} of the world": value for key, value in settings["world"].items() if key != "path"}
    return {**{key: value for key, value in settings.items() if key != "world"}, **world}


def _begin(spec: Spec, out: Path, begun: Begun | None, identity: dict[str, Any], latency: Latency) -> Begun:
    """What the run began with. Raises UserError if that was another model."""
    if begun is None:
        return Begun(
            settings=spec.settings(), created=datetime.now(UTC).isoformat(timespec="seconds"),
            identity=digest(identity), tags=spec.tags, latency=latency,
        )  # fmt: skip
    if begun.identity != digest(identity):
        names = " or ".join(printable(card.name) for card in dict.fromkeys(spec.cards))
        raise UserError(
            f"--out {printable(out)} was begun with another model behind {names} (its files, package "
            "versions or device differ); delete it, or choose another folder"
        )
    return begun
