"""Run an evaluation, for `harness eval` and `harness drive`:
walk its chunks, score them, write the run.
"""

import math
import os
import shlex
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import msgspec

from harness.backends.base import Backend, Served, same_model
from harness.backends.registry import open_backend, opened
from harness.backends.swarm import open_each, together
from harness.core import shards, work
from harness.core.at_once import most_at_once
from harness.core.errors import Unanswered, UserError, in_range, printable
from harness.core.files import bytes_of, folder_in, write_whole
from harness.core.formats import CONFIG, WORK
from harness.core.memory import uncollected
from harness.core.parallel import Workers, each, spread
from harness.core.progress import Progress
from harness.core.seals import is_sealed, say_unsealed, write_seal
from harness.core.seeds import LAST_EPISODE
from harness.core.shards import Shard
from harness.core.statistics import cluster_numbers
from harness.core.versions import versions
from harness.dataset.load import Scene
from harness.dataset.select import recorded
from harness.evaluate import costs, questions, servers, timing
from harness.evaluate import latency as latencies
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource, FrozenWorld
from harness.evaluate.kept_answers import KeptAnswers, read_kept
from harness.evaluate.lifecycle import (
    Evaluated,
    RunStart,
    another_model,
    as_finished,
    begin,
    finished,
    finished_with,
    refuse_finished,
    rules,
    unfinished,
)
from harness.evaluate.sources import sources
from harness.evaluate.spec import Spec
from harness.evaluate.table import of_all_seeds, packed, table
from harness.evaluate.texts import refuse_others
from harness.evaluate.walk import walk
from harness.runs import answer_counts, answer_times, folder, run_parts, stopping, writer
from harness.runs import sources as kept_sources
from harness.runs.contradictions import sound
from harness.runs.decisions import Decisions
from harness.runs.difficulty import Layout, adjusted_scores
from harness.runs.formats import FORMAT, LOOKS
from harness.runs.grid import Grid
from harness.runs.metrics import metrics_of
from harness.runs.records import (
    MEASURED,
    Answer,
    AnswerFacts,
    ClosedLoop,
    Episode,
    Latency,
    Manifest,
)
from harness.runs.settings import FILE, Settings, of_words, text_of, words
from harness.runs.stopping import InterimLooks
from harness.runs.summary import Figures, counted
from harness.runs.unanswered import Tally, of_use
from harness.world import scenarios

if TYPE_CHECKING:  # only driving loads the simulator
    from harness.evaluate.live_world import LiveSource, LiveWorld

Opens = Callable[..., Backend]  # as `open_backend` is called
NOTHING: Mapping[str, Answer] = MappingProxyType({})
# fewest episodes of a closed-loop chunk: arrays of few are slow, few chunks leave workers idle
EPISODES_AT_ONCE = 32
TREES_AT_ONCE = 256  # decision trees of a chunk of frozen scenes
# most walks, by layout, seed and condition, that frozen scenes hold in memory
WALKS_AT_ONCE = 1 << 14
LEAST_VIEWERS = 4  # requests at once for each closed-loop episode: the ego and three helpers


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
    """Evaluate a model with a prompt, and write the run's folder.

    Its bytes do not depend on the workers. A stopped run in that folder resumes. The working folder
    stays until the caller calls `work.tidy`; until then the caller may add files to the run.

    Args:
        spec: what is evaluated.
        out: the run's folder.
        progress: called with the number of new answers (frozen scenes) or of episodes just driven
            (closed loop); what an earlier, stopped run kept is included.
        cache: completion cache for language models, a file; None for no cache.
        more: called with the number of requests to be asked next; frozen scenes only.
        workers: processes or a cluster. They drive the closed loop, and walk frozen scenes if rules
            or served models answer; each worker opens its own backend. Other models answer frozen
            scenes in this process. The workers together have as many requests at once at a server
            as one would.
        opens: replaces `open_backend`; it may return a backend that is open already. All is then
            walked in this process.
        given: answers by request id that need not be asked for; frozen scenes only.

    Raises UserError if the folder holds another run or something else, or the model is not
    available; nothing is written then. Raises UserError if what a stopped run kept contradicts
    itself. Raises Unanswered if a question of the ego or a fusion call,
    or too many of the helpers', got no answer; the folder keeps all answers, and the same call asks
    the others again. Where a file answers, the folder gets the questions that it lacks.
    """
    if (out / "run.json").exists() and (out / WORK).is_dir():
        run = finished_run(spec, out)
        return Evaluated(out, run.manifest, run.scores)
    metrics_of(spec.source.kind)  # of packages, which must load before anything is asked
    refuse_finished(out)
    run_start = unfinished(spec, out)
    if spec.ego.can.from_file and not opens:
        questions.settle(spec, out)
    if not run_start and spec.settings.latency == MEASURED:
        timing.refuse_busy()
    if opens or isinstance(spec.source, FrozenSource):
        return _walk_here(spec, out, run_start, progress, cache, more, opens, given, workers)
    return _driven(spec, out, run_start, progress, cache, workers)


def _driven(
    spec: Spec,
    out: Path,
    run_start: RunStart | None,
    progress: Callable[[int], None],
    cache: Path | None,
    workers: Workers,
) -> Evaluated:
    made_of = sources(spec)
    resumes = run_start is not None
    run_start, chunks = _begin_driving(spec, out, run_start, workers)
    with work.working(out, run_start, "run.json") as place:
        _check_measured(out, place, run_start, resumes)
        if resumes:
            _open_unsealed(out, place)
        seen, looked = _walked(
            spec,
            chunks,
            place,
            lambda some: _drive(spec, run_start, some, place, progress, cache, workers),
        )
        return _gather(out, as_finished(spec, run_start, looked), seen, place, made_of)


def evaluate_shard(
    spec: Spec, out: Path, shard: Shard, progress: Progress, workers: Workers = 1
) -> int:
    """Drive one shard of a closed-loop run, or resume it; return its number of episodes.

    A shard is one of several parts of a run that are made apart; `harness run merge` combines them.
    `spec` is the whole run's evaluation, `out` the shard's folder. `progress` is called with
    numbers of episodes, those that a stopped shard kept included; `workers` are processes or a
    cluster. Raises UserError if the folder holds something else, the model is not available, the
    latency is to be measured or the run may stop early.
    """
    metrics_of(spec.source.kind)
    refuse_finished(out)
    if spec.stopping_rule:
        raise UserError(f"--shard {shard}: a run that stops when it has seen enough has no shards")
    made_of = sources(spec)
    earlier = unfinished(spec, out, str(shard))
    run_start, chunks = _begin_driving(spec, out, earlier, workers, str(shard))
    at_once = _at_once(run_start.settings)
    more = f"--episodes {at_once * (shard.of - 1) + 1} or more, {at_once} of which are one part"
    own_chunks = shard.part(chunks, more)
    progress.more(sum(map(len, own_chunks)))
    with work.working(out, run_start, "run.json") as place:
        if earlier:
            _open_unsealed(out, place)
        _drive(spec, run_start, own_chunks, place, progress, None, workers)
        kept_sources.write(place, made_of, place)
        parts = [place / _folder_name(chunk) for chunk in own_chunks]
        facts = chain.from_iterable(map(run_parts.facts_of, parts))
        _settle(parts, facts, run_start.settings)
    return sum(map(len, own_chunks))


def merge(folders: Sequence[Path], out: Path) -> Evaluated:
    """Combine the shards of a closed-loop run into one run, byte for byte as without shards.

    In closed loop a simulator plays the episodes. Raises UserError if the folders are not all the
    shards of one run, a shard is unfinished, two hold different bytes for the same part, or `out`
    holds something else.
    """
    run_starts = shards.read(folders, RunStart)
    with shards.made_whole(folders, out):
        driven = msgspec.convert(run_starts[0].settings["world"], ClosedLoop).scenario
    scenarios.of_manifest(driven["name"], driven["parameters"])  # which the report is of
    with shards.made_whole(folders, out):
        return _merged(run_starts, folders, out)


def _merged(run_starts: Sequence[RunStart], folders: Sequence[Path], out: Path) -> Evaluated:
    """Combine shards, by what they began with."""
    chunks = _chunks_of(run_starts[0].settings)
    chunk_by_folder = {_folder_name(chunk): chunk for chunk in chunks}
    parts = shards.owners(
        folders, run_starts, list(chunk_by_folder), lambda part: _label(chunk_by_folder[part])
    )
    tags = tuple(dict.fromkeys(tag for each in run_starts for tag in each.tags))
    created = min(each.created for each in run_starts)
    # A shard may state any words; the settings are those that all shards have.
    command = words(msgspec.convert(run_starts[0].settings["settings"], Settings))
    whole = msgspec.structs.replace(
        run_starts[0], shard="", tags=tags, created=created, command=command
    )
    made_of = _sources_of(folders, whole.settings)
    if (out / "run.json").exists() and (out / WORK).is_dir():
        # Anybody may have written what a stopped merge finished, and the shards are here.
        finished_with(whole.settings, out)
        write_whole(out / WORK / CONFIG, msgspec.json.encode(whole))
        (out / "run.json").unlink()
    refuse_finished(out)
    if stopped := work.start_of(out, RunStart):
        work.same(out, {**whole.facts(), "shard": ""}, {**stopped.facts(), "shard": stopped.shard})
    with work.working(out, stopped or whole, "run.json") as place:
        shards.collect(parts, place)
        try:
            return _gather(out, whole, chunks, place, made_of, folders)
        except Unanswered as error:
            raise UserError(
                f"{error}; type the commands of the shards again, and merge then"
            ) from None
        except UserError:
            actions = whole.settings["actions"]
            for name, part in parts.items():  # so that a shard's own part is named, and no copy
                for _ in run_parts.read_part(part, chunk_by_folder[name], actions):
                    pass
            raise


def _sources_of(folders: Sequence[Path], settings: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the sources of a run that is merged from shards, each held to the run's settings."""
    prompts = [agent["prompt"] for agent in (settings, *settings["helpers"])]
    of_shards = [kept_sources.read(shard / WORK) for shard in folders]
    for shard, files in zip(folders, of_shards, strict=True):
        if sentence := next(kept_sources.otherwise(files, prompts), None):
            raise UserError(f"{printable(shard)}: {sentence}; make this shard again")
    return of_shards[0]


def _walk_whole(
    spec: Spec, chunk: Sequence[int], asker_of: Callable[[int, Mapping[str, Answer]], Asker]
) -> dict[str, bytes]:
    """Walk a chunk as `_walk` does; garbage is collected meanwhile where a language model answers.

    A chunk fits into memory; what a language model's engine leaves behind in cycles might not.
    """
    with uncollected() if _reproducible(spec) else nullcontext():
        return _walk(spec, chunk, asker_of)


def _walk(
    spec: Spec, chunk: Sequence[int], asker_of: Callable[[int, Mapping[str, Answer]], Asker]
) -> dict[str, bytes]:
    """Walk a chunk's episodes to their ends and return the files of this part of the run, by name.

    One of them says which servers gave answers that are not kept yet; it is no part of the run's
    tables. Frozen scenes are walked for some seeds at a time: the decisions of all would not fit
    into memory. `asker_of` returns the asker of the n-th of these walks, which is given the answers
    so far.
    """
    at_once = len(spec.seeds)
    if isinstance(spec.source, FrozenSource):
        at_once = max(1, WALKS_AT_ONCE // (len(chunk) * len(spec.points)))
    walks = len(spec.seeds) * len(spec.points)
    layouts = _split(sorted(chunk), max(1, WALKS_AT_ONCE // walks))
    answers: Mapping[str, Answer] = {}
    tables, episodes, viewers = list[Decisions](), list[Episode](), dict[str, Sequence[str]]()
    served = list[Served]()
    for n, seeds in enumerate(_split(spec.seeds, at_once)):
        world, asker = _world_of(spec, chunk, seeds), asker_of(n, answers)
        decided = list(chain.from_iterable(walk(world, spec.points, asker, spec.ties)))
        viewers |= {scene.id: scene.viewers for part in decided for scene in part.decision_points}
        served += asker.served
        answers, more = asker.asked_answers(), world.columns()
        if spec.timer:
            more = {**more, **spec.timer.columns(asker.latency, decided, answers)}
        rows = table(decided, more, spec.actions).rounded()
        tables.append(rows if at_once >= len(spec.seeds) else packed(rows, layouts))
        episodes += world.episodes()
    files = run_parts.part_files(
        of_all_seeds(tables, spec.points, layouts), episodes, answers.values(), viewers
    )
    return {**files, servers.FILE: servers.lines(served)} if served else files


def _walk_here(
    spec: Spec,
    out: Path,
    run_start: RunStart | None,
    progress: Callable[[int], None],
    cache: Path | None,
    more: Callable[[int], None],
    opens: Opens | None,
    given: Mapping[str, Answer],
    workers: Workers,
) -> Evaluated:
    source, made_of = spec.source, sources(spec)
    if isinstance(source, FrozenSource):
        chunks = _split(source.dataset.episodes, TREES_AT_ONCE)
    else:
        chunks = _chunks_of(spec.record())
    here = opens or given or spec.stopping_rule or len(chunks) == 1
    spread_over = 1 if here else spreadable(spec, workers)
    if in_workers := spread_over != 1:
        models = list[Backend]()
        identity, latency = _stated_in_worker(spec, run_start, spread_over)
    else:
        models = open_each(spec.cards, partial(opens or open_backend, **spec.opening))
        identity, latency = (
            together(spec.cards, models).identity(),
            _latency(spec, run_start, models),
        )
    resumes = run_start is not None
    run_start = begin(spec, out, run_start, identity, latency)
    with work.working(out, run_start, "run.json") as place:
        _check_measured(out, place, run_start, resumes)
        if resumes:
            _open_unsealed(out, place)

        def walk_here(chunk: Sequence[int]) -> dict[str, bytes]:
            earlier = _answered_file(place, chunk)

            def asker_of(n: int, so_far: Mapping[str, Answer]) -> Asker:
                # Each has a file of its own, so that a resumed run asks in the same chunks.
                kept = place / (f"answers-{n + 1}.jsonl" if n else "answers.jsonl")
                there = {**given, **so_far}
                return Asker(spec, lambda: backend, latency, kept, there, progress, more, earlier)

            return _walk_whole(spec, chunk, asker_of)

        def report_kept(chunk: Sequence[int]) -> None:
            n_answers = run_parts.answers_in(place / _folder_name(chunk))
            more(n_answers)
            progress(n_answers)

        def walk_all(some: Sequence[Sequence[int]]) -> None:
            if in_workers:
                _hand_over(place, some)
                walk_chunk = partial(
                    _walk_chunk, spec, run_start, *_files(spec, cache, place, spread_over)
                )
                _walk_missing(some, place, walk_chunk, report_kept, report_kept, spread_over)
            else:
                _walk_missing(some, place, walk_here, report_kept, lambda chunk: None)

        if not in_workers:
            backend = together(
                spec.cards, costs.metered(spec.cards, models, place, spec.guards), cache
            )
        seen, looked = _walked(spec, chunks, place, walk_all)
        count = sum(map(len, seen))
        layouts = source.layouts(count) if isinstance(source, FrozenSource) else ()
        return _gather(
            out, as_finished(spec, run_start, looked), seen, place, made_of, layouts=layouts
        )


def _check_measured(out: Path, place: Path, run_start: RunStart, resumes: bool) -> None:
    """Raise UserError if a stopped run states measured times that nobody measured here.

    Those of a run that begins are sealed.
    """
    if run_start.latency.source != MEASURED:
        return
    record = place / CONFIG
    if not resumes:
        write_seal(record, {CONFIG: bytes_of(record, "record")})
    elif not is_sealed(record):
        raise _not_measured_here(out)


def _not_measured_here(out: Path) -> UserError:
    return UserError(
        f"--out {printable(out)} states inference times that were not measured here with your key; "
        "begin in another folder"
    )


def _open_unsealed(out: Path, place: Path) -> None:
    """Open the finished parts of a stopped run that were not finished by this user on this machine.

    Anybody may have written them: their episodes are walked again with their answers, and a line on
    stderr says so.
    """
    finished_parts = [part for part in sorted(place.glob("episodes-*")) if part.is_dir()]
    unsealed = [part for part in finished_parts if not is_sealed(part)]
    for part in unsealed:
        _open_again(part)
    if unsealed:
        therefore = "their episodes are walked again with their answers"
        say_unsealed(out, len(unsealed), "finished part", therefore)


def _open_again(part: Path) -> None:
    """Replace a finished part by the answers that it has."""
    answered = read_kept(part / "answers.jsonl")
    write_whole(part.with_suffix(".jsonl"), writer.lines(list(answered.values())))
    gone = part.with_name(f".{part.name}.{os.getpid()}.part")
    os.replace(part, gone)  # so that no part is ever half there
    shutil.rmtree(gone)


def spreadable(spec: Spec, workers: Workers) -> Workers:
    """Return the workers by which recorded scenes can be evaluated, 1 for this process alone.

    `workers` is a number of processes, or a cluster. More than one serve where rules answer (all of
    `workers`), or models on servers, of which there are no more than a server may have requests at
    once (`batch_size`).
    """
    if _reproducible(spec):
        return workers
    asks_servers = all(agent.card.server or not agent.can.language_model for agent in spec.agents)
    return (
        min(workers, most_at_once(spec.settings.batch_size))
        if asks_servers and isinstance(workers, int)
        else 1
    )


def _hand_over(place: Path, chunks: Sequence[Sequence[int]]) -> None:
    """Keep the answers of a run that one process began as those of the chunk that it was at."""
    if todo := [chunk for chunk in chunks if not (place / _folder_name(chunk)).is_dir()]:
        for kept in place.glob("answers*.jsonl"):
            KeptAnswers(_answered_file(place, todo[0])).append(list(read_kept(kept).values()))
            kept.unlink()


def _begin_driving(
    spec: Spec, out: Path, run_start: RunStart | None, workers: Workers, shard: str = ""
) -> tuple[RunStart, list[Sequence[int]]]:
    """Return the record that a closed-loop run begins with, and the chunks of its episodes."""
    if spec.settings.latency == MEASURED and (shard or not isinstance(workers, int)):
        raise UserError(
            f"--latency {MEASURED} is of one machine, and this is driven on several; "
            "measure on one, and declare that: ego=SECONDS,helper=SECONDS,fusion=SECONDS"
        )
    identity, latency = _stated_in_worker(spec, run_start, workers)
    return begin(spec, out, run_start, identity, latency, shard), _chunks_of(spec.record())


def _chunks_of(settings: Mapping[str, Any]) -> list[Sequence[int]]:
    """Split a closed-loop run into chunks: the numbers of the episodes that are driven in step."""
    world = msgspec.convert(settings["world"], ClosedLoop)
    most = world.selection.get("of", world.episodes)
    in_range("episodes of a shard's run", most, 1, LAST_EPISODE + 1)
    numbers: Sequence[int] = range(min(world.episodes, most))
    if selection := recorded(world.selection):
        numbers = selection.choice(range(most), None).numbers
    return _split(numbers, _at_once(settings))


def _at_once(settings: Mapping[str, Any]) -> int:
    """Return how many episodes of a closed-loop run are driven in step."""
    return max(EPISODES_AT_ONCE, math.ceil(most_at_once(settings["batch_size"]) / LEAST_VIEWERS))


def _split(numbers: Sequence[int], size: int) -> list[Sequence[int]]:
    return [numbers[at : at + size] for at in range(0, len(numbers), size)]


def _folder_name(chunk: Sequence[int]) -> str:
    return f"episodes-{chunk[0]:06d}-{chunk[-1]:06d}"


def _answered_file(place: Path, chunk: Sequence[int]) -> Path:
    """Return the file of the answers that a chunk has before it is walked to its end."""
    return place / f"{_folder_name(chunk)}.jsonl"


def _settle(
    parts: Sequence[Path], answers: Iterable[Answer | AnswerFacts], settings: Mapping[str, Any]
) -> None:
    """Raise Unanswered if a run needs answers that it lacks; its parts lose what lacks them."""
    facts = list(answers)
    if settings["ask"] == "all" and any(fact.error is not None for fact in facts):
        decisions = (run_parts.decided_in(part, settings["actions"]) for part in parts)
        facts = list(of_use(facts, decisions))
    tally = Tally(facts)
    if not tally.missing:
        return
    for part in parts:
        answered = read_kept(part / "answers.jsonl")
        if len(answered) < run_parts.answers_in(part):
            _open_again(part)
    raise Unanswered(str(tally))


def _label(chunk: Sequence[int]) -> str:
    whole = chunk == range(chunk[0], chunk[-1] + 1)
    return (
        f"episodes {chunk[0]} to {chunk[-1]}" if whole else f"episodes {', '.join(map(str, chunk))}"
    )


def _walked(
    spec: Spec,
    chunks: Sequence[Sequence[int]],
    place: Path,
    walk_all: Callable[[Sequence[Sequence[int]]], None],
) -> tuple[Sequence[Sequence[int]], InterimLooks | None]:
    """Walk the chunks, or as many layouts as are enough; return the chunks of these, and the looks.

    A resumed run looks at the same layouts again, and so stops where it would have.
    """
    rule = spec.stopping_rule
    if rule is None:
        walk_all(chunks)
        return chunks, None
    numbers, most = spec.source.numbers, max(map(len, chunks))
    names, done, ended = (
        tuple(point.name for point in spec.points),
        list[Sequence[int]](),
        list[Episode](),
    )
    is_enough, at = False, list[int]()
    for layouts in rule.planned_looks(len(numbers)):
        new = _split(numbers[at[-1] if at else 0 : layouts], most)
        walk_all(new)
        parts = [place / _folder_name(chunk) for chunk in new]
        _settle(parts, chain.from_iterable(map(run_parts.facts_of, parts)), spec.record())
        done, at = [*done, *new], [*at, layouts]
        ended += chain.from_iterable(map(run_parts.ends_of, parts))
        grid = Grid(names, spec.seeds, tuple(numbers[:layouts]))
        if is_enough := rule.enough(grid, grid.ordered(ended)):
            break
    return done, InterimLooks(len(numbers), tuple(at), is_enough)


def _drive(
    spec: Spec,
    run_start: RunStart,
    chunks: Sequence[Sequence[int]],
    place: Path,
    progress: Callable[[int], None],
    cache: Path | None,
    workers: Workers,
) -> None:

    def report(chunk: Sequence[int]) -> None:
        progress(len(chunk))

    walk_chunk = partial(_walk_chunk, spec, run_start, *_files(spec, cache, place, workers))
    _walk_missing(chunks, place, walk_chunk, report, report, workers, _reproducible(spec))


def _files(
    spec: Spec, cache: Path | None, place: Path, workers: Workers
) -> tuple[Path | None, Path | None]:
    """Return the completion cache of workers, and the folder where they keep answers;
    None if they have none.

    These are files of this machine, which the nodes of a cluster cannot share.
    """
    if not isinstance(workers, int):
        return None, None
    return cache, None if _reproducible(spec) else place


def _walk_missing(
    chunks: Sequence[Sequence[int]],
    place: Path,
    walk_chunk: Callable[[Sequence[int]], dict[str, bytes]],
    report_kept: Callable[[Sequence[int]], None],
    report_new: Callable[[Sequence[int]], None],
    workers: Workers = 1,
    exact: bool = True,
) -> None:
    """Walk the chunks that are not kept yet, and keep each as soon as it is done."""
    todo = [chunk for chunk in chunks if not (place / _folder_name(chunk)).is_dir()]
    for chunk in chunks:
        if chunk not in todo:
            report_kept(chunk)

    def keep(index: int, files: dict[str, bytes]) -> None:
        chunk = todo[index]
        servers.keep(place, files.pop(servers.FILE, b""))
        run_parts.write_part(place / _folder_name(chunk), files)
        for kept in (*place.glob("answers*.jsonl"), _answered_file(place, chunk)):
            kept.unlink(missing_ok=True)
        report_new(chunk)

    each(walk_chunk, todo, workers, keep, _label, exact)


def _reproducible(spec: Spec) -> bool:
    """Return whether all machines give a question the same answer;
    those of a language model may differ.
    """
    return not any(agent.can.language_model for agent in spec.agents)


def _walk_chunk(
    spec: Spec, run_start: RunStart, cache: Path | None, place: Path | None, chunk: Sequence[int]
) -> dict[str, bytes]:
    """Walk a chunk in a worker process and return its files by name;
    `place` keeps its answers until then.
    """
    kept = place and _answered_file(place, chunk)

    def backend() -> Backend:
        models = costs.metered(spec.cards, _open_all(spec), place, spec.guards)
        combined = together(spec.cards, models, cache)
        if not same_model(run_start.identity, combined.identity()):
            raise UserError(
                f"a worker opens {another_model(spec)} than this run began with; give it the same"
            )
        return combined

    def asker_of(n: int, so_far: Mapping[str, Answer]) -> Asker:
        return Asker(spec, backend, run_start.latency, kept, so_far)

    return _walk_whole(spec, chunk, asker_of)


def _world_of(spec: Spec, chunk: Sequence[int], seeds: Sequence[int]) -> "FrozenWorld | LiveWorld":
    if isinstance(spec.source, FrozenSource):
        episodes = spec.source.dataset.of_episodes(frozenset(chunk))
        return FrozenWorld(episodes, spec.points, seeds)
    from harness.evaluate.live_world import LiveWorld

    source = cast("LiveSource", spec.source)
    return LiveWorld(spec.scenario, source.first_seed, chunk, spec.points, seeds, spec.ego_alone)


def _gather(
    out: Path,
    run_start: RunStart,
    chunks: Sequence[Sequence[int]],
    place: Path,
    made_of: Mapping[str, bytes],
    folders: Sequence[Path] = (),
    layouts: Sequence[Layout] = (),
) -> Evaluated:
    """Score the chunks in a working folder and write the files of the finished run,
    with its sources.

    `place` is the working folder, `made_of` has the sources by name, `folders` are folders that the
    run is merged from, and `layouts` those that its own are a part of.
    """
    settings, parts = run_start.settings, [place / _folder_name(chunk) for chunk in chunks]
    typed = {**settings["settings"], "tag": run_start.tags}
    works = [place, *(shard / WORK for shard in folders)]
    names = tuple(condition["name"] for condition in settings["conditions"])

    seeds = tuple(settings["seeds"])
    by_piece: list[list[Episode]] = []

    def scored() -> Iterator[Figures]:
        """Yield the figures of some layouts: the decisions of all would not fit into memory."""
        for chunk, part in zip(chunks, parts, strict=True):
            for piece in run_parts.read_part(part, chunk, settings["actions"]):
                grid = Grid(names, seeds, tuple(piece.layouts))
                by_piece.append(counted(grid, piece.decisions, piece.episodes))
                yield Figures.of(
                    settings["world"]["kind"], grid, piece.decisions, by_piece[-1], piece.answers
                )

    with uncollected():
        whole = Figures.joined(Grid(names, seeds, tuple(chain.from_iterable(chunks))), scored())
        answers = [answer for answer, _ in whole.answers]
        _settle(parts, answers, settings)
        summary = whole.scores()
        episodes: list[Episode] = []
        n_cells = len(names) * len(seeds)
        for cell in range(n_cells):
            for of_piece in by_piece:
                layouts_here = len(of_piece) // n_cells
                episodes += of_piece[cell * layouts_here : (cell + 1) * layouts_here]
        if rule := stopping.rule_of(settings["world"].get(LOOKS)):
            summary = [*summary, *rule.scores(whole.grid, episodes)]
        if layouts:
            summary = [*summary, *adjusted_scores(whole.grid, episodes, layouts)]
        times = answer_times.times(
            answers, whole.grid.episodes, cluster_numbers(whole.cluster_names)
        )
        del whole  # its values take as much as the episodes
        cost = costs.total(settings, works)
        manifest = msgspec.convert(
            {
                "format": FORMAT,
                "name": out.name,
                "created": run_start.created,
                "command": shlex.join([*run_start.command, "--out", str(out)]),
                "tags": run_start.tags,
                **settings,
                "settings": typed,
                "latency": msgspec.to_builtins(run_start.latency),
                "answer_times": msgspec.to_builtins(times),
                "identity": run_start.identity,
                **answer_counts.counts(answers),
                "versions": run_start.versions,
            },
            Manifest,
        )
        if cost:
            manifest = msgspec.structs.replace(manifest, cost=cost)
        kept_sources.write(out, made_of, place)
        with suppress(UserError):  # a stranger's shard may state any command
            write_whole(out / FILE, text_of(of_words(run_start.command)))
        servers.write(out, works)
        decisions_of_all = run_parts.decisions_of(parts, settings["actions"])
        writer.write(
            out, manifest, decisions_of_all, episodes, run_parts.lines_of(parts), summary, layouts
        )
    return Evaluated(out, manifest, summary)


def _stated_in_worker(
    spec: Spec, run_start: RunStart | None, workers: Workers
) -> tuple[dict[str, Any], Latency]:
    """Return what `_identity_and_latency` does, in a worker:
    a forked one inherits no engine's threads.
    """
    state, exact = partial(_identity_and_latency, run_start=run_start), _reproducible(spec)
    [identity_and_latency] = spread(
        state,
        [spec],
        workers,
        lambda done: None,
        lambda each: f"the model {each.ego.card.name}",
        exact,
    )
    return identity_and_latency


def _identity_and_latency(spec: Spec, run_start: RunStart | None) -> tuple[dict[str, Any], Latency]:
    """Open a run's models; return their identity and the latency of their decisions."""
    models = _open_all(spec)
    return together(spec.cards, models).identity(), _latency(spec, run_start, models)


def _latency(spec: Spec, run_start: RunStart | None, models: Sequence[Backend]) -> Latency:
    """Return the latency of a run: what its settings say, or what is measured.

    A resumed run has what it measured when it began. Raises UserError if it began with another
    latency than its settings say.
    """
    if spec.timer:
        declared: Latency | None = spec.timer.latency(spec.agents)
    else:
        declared = latencies.chosen_latency(spec.settings.latency, spec.agents, models)
    if run_start is None:
        return declared or timing.measured(spec, together(spec.cards, models), _trial(spec))
    began = run_start.latency
    is_measured = declared is None and began.source == MEASURED
    if not is_measured and (declared is None or not latencies.same_times(began, declared)):
        raise UserError(
            f"the run began with times of answers from {printable(began.source)} that its settings "
            "do not give; choose another folder, or delete this one"
        )
    return began if declared is None else declared


def _trial(spec: Spec) -> Sequence[Scene]:
    """Return the scenes in which a latency is measured."""
    if isinstance(spec.source, FrozenSource):
        return timing.spread_over(spec.source.dataset.scenes(spec.source.dataset.courses()))
    return [*cast("LiveSource", spec.source).trial(timing.SCENES, spec.ego_alone)]


def _open_all(spec: Spec) -> list[Backend]:
    """Return the backends of a run's agents, open in this process."""
    return [opened(card, **spec.opening) for card in spec.cards]


def read_or_evaluate(
    spec: Spec,
    out: Path,
    progress: Progress,
    cache: Path | None,
    opens: Opens,
    given: Mapping[str, Answer] = NOTHING,
) -> folder.Run:
    """Return the run in a folder, which is evaluated first unless it is finished.

    For studies of several runs.

    Args:
        spec: what is evaluated.
        out: the run's folder.
        progress: called with the number of new answers, or of episodes just driven.
        cache: completion cache for language models, a file; None for no cache.
        opens: opens a model's backend, the code that runs it, in place of `open_backend`.
        given: answers by request id that need not be asked for.

    Raises UserError if a finished run there is another evaluation or contradicts itself, or what
    `evaluate` refuses; and Unanswered if too many questions got no answer.
    """
    if (out / "run.json").is_file() and not (out / WORK).is_dir():
        return finished_run(spec, out)
    folder_in(out.parent, out.name)
    evaluate(spec, out, progress, cache, progress.more, opens=opens, given=given)
    work.tidy(out)
    return folder.read(out)


def finished_run(spec: Spec, out: Path) -> folder.Run:
    """Return the finished run in a folder, from which work goes on: anybody may have written it.

    Raises UserError if it has other settings than `spec`, or its tables contradict each other, its
    answers or the texts of these.
    """
    from harness.evaluate.recompute import refuse_otherwise  # which evaluates a run again

    folder_in(out.parent, out.name)
    run = sound(out)
    if spec.settings.latency == MEASURED:
        begun_with = work.start_of(out, RunStart)
        if begun_with is None or begun_with.latency != run.manifest.latency:
            raise _not_measured_here(out)
        _check_measured(out, out / WORK, begun_with, resumes=True)
        spec = spec.changed(latency=latencies.as_declared(run.manifest.latency))
    finished(spec, out)
    work.same(out, rules(versions()), rules(run.manifest.versions))
    refuse_others(run)
    refuse_otherwise(run, spec)
    return run
