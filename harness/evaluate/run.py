"""`harness eval` and `harness drive`: walk a world in chunks, keep each, score and write the run."""

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import msgspec

from harness.backends.base import Backend
from harness.backends.registry import open_backend, opened
from harness.backends.swarm import open_each, together
from harness.core import shards, work
from harness.core.errors import UserError
from harness.core.files import digest
from harness.core.formats import FORMAT, WORK
from harness.core.memory import uncollected
from harness.core.parallel import Workers, each, spread
from harness.core.shards import Shard
from harness.dataset.load import Scene
from harness.dataset.select import drawn
from harness.evaluate import device, timing
from harness.evaluate import latency as latencies
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource, FrozenWorld
from harness.evaluate.lifecycle import (
    Begun,
    Evaluated,
    another_model,
    as_finished,
    begin,
    finished,
    finished_with,
    refuse_finished,
    unfinished,
)
from harness.evaluate.spec import Spec
from harness.evaluate.walk import table, walk
from harness.runs import folder
from harness.runs.decisions import Decisions
from harness.runs.metrics import Grid
from harness.runs.records import Answer, ClosedLoop, Latency, Manifest
from harness.runs.summary import counted, scores

if TYPE_CHECKING:  # only driving loads the simulator
    from harness.evaluate.live_world import LiveSource, LiveWorld

Opens = Callable[..., Backend]  # as `open_backend` is called
NOTHING: Mapping[str, Answer] = MappingProxyType({})
EPISODES_AT_ONCE = 16  # of the closed loop that are driven in step and kept together, at least
TREES_AT_ONCE = 256  # of frozen scenes that are walked and kept together
LEAST_VIEWERS = 4  # asked at once for each of them, the ego and three helpers


def evaluate(
    spec: Spec,
    out: Path,
    progress: Callable[[int], None],
    cache: Path | None = None,
    more: Callable[[int], None] = lambda count: None,
    workers: Workers = 1,
    opens: Opens | None = None,
    given: Mapping[str, Answer] = NOTHING,
) -> Evaluated:
    """Evaluate a model with a prompt and write the run's folder; the same for any workers.

    A run that was stopped there resumes. The working folder stays until the caller, which may add to the run,
    calls `work.tidy`.

    Args:
        spec: what is evaluated.
        out: the run's folder.
        progress: called with the number of new answers, or of episodes just driven, kept ones included.
        cache: file of completions kept between runs, for language models; None for no cache.
        more: called with the number of answers that are owed next, where scenes are frozen.
        workers: processes or a cluster, each worker with a backend of its own: for the closed loop, and for
            frozen scenes that rules answer. A language model answers frozen scenes in this process.
        opens: replaces `open_backend` where scenes are frozen; the backend may be open already.
        given: answers by request id that need no asking, where scenes are frozen.

    Raises:
        UserError: the folder holds something else, or the model is not available. Nothing is written then.
    """
    if (out / "run.json").exists() and (out / WORK).is_dir():
        return finished(spec, out)
    refuse_finished(out)
    begun = unfinished(spec, out)
    if not begun and spec.latency == latencies.MEASURED:
        timing.refuse_busy()
    if isinstance(spec.source, FrozenSource):
        return _frozen(
            spec, spec.source, out, begun, progress, cache, more, opens or open_backend, given, workers
        )
    begun, chunks = _begin_driving(spec, out, begun, workers)
    with work.working(out, begun, "run.json") as place:
        _drive(spec, begun, chunks, place, progress, cache, workers)
        return _gathered(out, as_finished(spec, begun), chunks, place)


def evaluate_shard(
    spec: Spec, out: Path, shard: Shard, progress: Callable[[int], None], more: Callable[[int], None],
    workers: Workers = 1,
) -> int:  # fmt: skip
    """Drive a shard's part of a closed-loop run, for `harness merge`; a stopped shard resumes.

    Args:
        spec: the whole run.
        out: the shard's folder.
        shard: which part.
        progress: called with the number of episodes just driven, kept ones included.
        more: called with the number of episodes that the shard has.
        workers: processes or a cluster.

    Returns:
        How many episodes the shard has.

    Raises:
        UserError: as of `evaluate`, or the latency is to be measured.
    """
    refuse_finished(out)
    begun, chunks = _begin_driving(spec, out, unfinished(spec, out, str(shard)), workers, str(shard))
    mine = shard.part(chunks)
    more(sum(map(len, mine)))
    with work.working(out, begun, "run.json") as place:
        _drive(spec, begun, mine, place, progress, None, workers)
    return sum(map(len, mine))


def merge(folders: Sequence[Path], out: Path) -> Evaluated:
    """Make one closed-loop run of its shards: the bytes of a run that was not split (see `evaluate`).

    Raises:
        UserError: these are not all shards of one run, finished and of the same bytes, or `out` holds
            something else.
    """
    begun = shards.read(folders, Begun)
    chunks = _chunks_of(begun[0].settings)
    of = {_part_of(chunk): chunk for chunk in chunks}
    parts = shards.owners(folders, begun, list(of), lambda part: _named(of[part]))
    if (out / "run.json").exists() and (out / WORK).is_dir():
        return finished_with(begun[0].settings, out)
    refuse_finished(out)
    tags = tuple(dict.fromkeys(tag for each in begun for tag in each.tags))
    created = min(each.created for each in begun)
    whole = msgspec.structs.replace(begun[0], shard="", tags=tags, created=created)
    if there := work.begun(out, Begun):
        work.same(out, {**whole.facts(), "shard": ""}, {**there.facts(), "shard": there.shard})
    with work.working(out, there or whole, "run.json") as place:
        shards.collect(parts, place)
        return _gathered(out, whole, chunks, place)


def _part(spec: Spec, world: "FrozenWorld | LiveWorld", asker: Asker) -> dict[str, bytes]:
    """Walk a world; returns the files of that part of the run by name."""
    decided = list(chain.from_iterable(walk(world, spec.points, asker)))
    decisions = table(decided, world.columns(), spec.actions)
    if spec.device_profile:
        answers = asker.answers.values()
        taken = device.energy(spec.device_profile, asker.latency, spec.points, decisions, answers)
        decisions = decisions.replace(**taken)
    return folder.part_files(decisions.rounded(), world.episodes(), asker.answers.values())


def _frozen(
    spec: Spec, source: FrozenSource, out: Path, begun: Begun | None, progress: Callable[[int], None],
    cache: Path | None, more: Callable[[int], None], opens: Opens, given: Mapping[str, Answer],
    workers: Workers,
) -> Evaluated:  # fmt: skip
    dataset = source.dataset
    options = {"device": spec.device, "dtype": spec.dtype, "batch_size": spec.batch_size}
    models = open_each(spec.cards, partial(opens, **options))
    identity = together(spec.cards, models).identity()
    latency = _latency(spec, begun, models, lambda: timing.spread_over(dataset.scenes(dataset.courses())))
    begun = begin(spec, out, begun, identity, latency)
    chunks = _chunked(dataset.episodes, TREES_AT_ONCE)
    with work.working(out, begun, "run.json") as place:
        asked, kept = together(spec.cards, models, cache), place / "answers.jsonl"
        todo = [chunk for chunk in chunks if not (place / _part_of(chunk)).is_dir()]
        apart = len(todo) > 1 and workers != 1 and _exact(spec) and not given

        def here(chunk: Sequence[int]) -> dict[str, bytes]:
            asker = Asker(spec, lambda: asked, latency, kept, given, progress, more)
            return _part(spec, _world(spec, chunk), asker)

        def count(chunk: Sequence[int]) -> None:
            n = folder.answers_in(place / _part_of(chunk))
            more(n)
            progress(n)

        def took(at: int, files: dict[str, bytes]) -> None:
            folder.write_part(place / _part_of(todo[at]), files)
            kept.unlink(missing_ok=True)
            if apart:
                count(todo[at])

        for chunk in chunks:
            if chunk not in todo:
                count(chunk)
        walked = partial(_walked, spec, begun, None) if apart else here
        each(walked, todo, workers if apart else 1, took, _named)
        return _gathered(out, as_finished(spec, begun), chunks, place)


def _begin_driving(
    spec: Spec, out: Path, begun: Begun | None, workers: Workers, shard: str = ""
) -> tuple[Begun, list[Sequence[int]]]:
    """What a closed-loop run begins with, and the chunks of its episodes."""
    if spec.latency == latencies.MEASURED and (shard or not isinstance(workers, int)):
        raise UserError(
            f"--latency {latencies.MEASURED} is of one machine, and this is driven on several; measure on "
            "one, and declare that: ego=SECONDS,helper=SECONDS,fusion=SECONDS"
        )
    # Engines are opened where they answer: a forked process has none of their threads.
    model = partial(_model, begun=begun)
    [(identity, latency)] = spread(
        model, [spec], workers, lambda done: None, lambda of: f"the model {of.ego.card.name}", _exact(spec)
    )
    return begin(spec, out, begun, identity, latency, shard), _chunks_of(spec.settings())


def _chunks_of(settings: Mapping[str, Any]) -> list[Sequence[int]]:
    """Numbers of the episodes that are driven in step and kept together, of a closed-loop run's settings."""
    world = msgspec.convert(settings["world"], ClosedLoop)
    numbers: Sequence[int] = range(world.episodes)
    if drawn_of := world.selection:
        numbers = drawn(range(drawn_of["of"]), drawn_of["sample"], drawn_of["sample_seed"], drawn_of["of"])
    return _chunked(numbers, max(EPISODES_AT_ONCE, math.ceil(settings["batch_size"] / LEAST_VIEWERS)))


def _chunked(numbers: Sequence[int], size: int) -> list[Sequence[int]]:
    return [numbers[at : at + size] for at in range(0, len(numbers), size)]


def _part_of(chunk: Sequence[int]) -> str:
    """Name of the folder that keeps a chunk."""
    return f"episodes-{chunk[0]:06d}-{chunk[-1]:06d}"


def _named(chunk: Sequence[int]) -> str:
    """A chunk for people."""
    whole = chunk == range(chunk[0], chunk[-1] + 1)
    return f"episodes {chunk[0]} to {chunk[-1]}" if whole else f"episodes {', '.join(map(str, chunk))}"


def _drive(
    spec: Spec, begun: Begun, chunks: Sequence[Sequence[int]], place: Path,
    progress: Callable[[int], None], cache: Path | None, workers: Workers,
) -> None:  # fmt: skip
    """Drive the chunks that are not kept yet, and keep each as it comes."""
    todo = [chunk for chunk in chunks if not (place / _part_of(chunk)).is_dir()]
    progress(sum(map(len, chunks)) - sum(map(len, todo)))

    def took(at: int, files: dict[str, bytes]) -> None:
        folder.write_part(place / _part_of(todo[at]), files)
        progress(len(todo[at]))

    # The cache is a file of one machine.
    walked = partial(_walked, spec, begun, cache if isinstance(workers, int) else None)
    each(walked, todo, workers, took, _named, _exact(spec))


def _exact(spec: Spec) -> bool:
    """Whether the same question gets the same answer anywhere: rules do, and language models need not."""
    return not any(agent.can.language_model for agent in spec.agents)


def _walked(spec: Spec, begun: Begun, cache: Path | None, chunk: Sequence[int]) -> dict[str, bytes]:
    """Walk a chunk in a worker; returns its files by name."""

    def backend() -> Backend:
        asked = together(spec.cards, _opened_all(spec), cache)
        if digest(asked.identity()) != digest(begun.identity):
            raise UserError(
                f"a worker opens {another_model(spec)} than this run began with; give it the same"
            )
        return asked

    return _part(spec, _world(spec, chunk), Asker(spec, backend, begun.latency))


def _world(spec: Spec, chunk: Sequence[int]) -> "FrozenWorld | LiveWorld":
    """The world of a chunk of a run's episodes."""
    if isinstance(spec.source, FrozenSource):
        some = spec.source.dataset.of_episodes(frozenset(chunk))
        return FrozenWorld(some, spec.points, spec.seeds)
    from harness.evaluate.live_world import LiveWorld

    source = cast("LiveSource", spec.source)
    return LiveWorld(spec.scenario, source.first_seed, chunk, spec.points, spec.seeds, spec.ego_alone)


def _gathered(out: Path, begun: Begun, chunks: Sequence[Sequence[int]], place: Path) -> Evaluated:
    """Score all chunks of a run, which lie in a working folder, and write the run's files."""
    settings, parts = begun.settings, [place / _part_of(chunk) for chunk in chunks]
    names = tuple(condition["name"] for condition in settings["conditions"])
    grid = Grid(names, tuple(settings["seeds"]), tuple(chain.from_iterable(chunks)))
    with uncollected():
        read = [folder.read_part(part, settings["actions"]) for part in parts]
        decisions = Decisions.concat([decisions for decisions, _, _ in read])
        answers = [answer for _, _, answers in read for answer in answers]
        episodes = counted(grid, decisions, [episode for _, episodes, _ in read for episode in episodes])
        summary = scores(settings["world"]["kind"], grid, decisions, episodes, answers)
        manifest = msgspec.convert({
            "format": FORMAT, "name": out.name, "created": begun.created,
            "command": shlex.join([*begun.command, "--out", str(out)]), "tags": begun.tags, **settings,
            "latency": msgspec.to_builtins(begun.latency),
            "answer_times": msgspec.to_builtins(latencies.times(answers)), "identity": begun.identity,
            "cached_answers": sum(answer.cached for answer in answers),
            "engine_errors": sum(answer.error is not None for answer in answers),
            "retries": sum(answer.retries for answer in answers),
            "versions": begun.versions,
        }, Manifest)  # fmt: skip
        folder.write(out, manifest, decisions, episodes, folder.lines_of(parts), summary)
    return Evaluated(out, manifest, summary)


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


def read_or_evaluate(
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
