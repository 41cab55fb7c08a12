"""Compute a run again from its answers alone; no model is asked, and rules, which are here, are."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from msgspec import UNSET, structs, to_builtins
from msgspec.structs import astuple

from harness import __version__
from harness.backends.base import Backend, Completion, Request
from harness.backends.card import Card
from harness.backends.registry import open_backend
from harness.backends.replay import Kept, LacksAnswer
from harness.core import work
from harness.core.errors import Unanswered, UserError, printable
from harness.core.extensions import part_of
from harness.core.figures import amount
from harness.dataset import select
from harness.dataset.load import Dataset
from harness.evaluate import latency as latencies
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.of_run import (
    DRIVER,
    card_here,
    check_prompts,
    model_of,
    points_of,
    records_otherwise,
    sees_all,
    spec_of,
)
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Source, Spec
from harness.evaluate.stated_times import times_otherwise
from harness.evaluate.texts import OF_TEXTS, others, same
from harness.prompts import versions
from harness.runs.contradictions import close, contradictions, current, differing
from harness.runs.folder import Run, read
from harness.runs.records import Episode, FrozenScenes, Latency
from harness.runs.run_dataset import OTHER_EPISODES, choice_of, count_to_select_of
from harness.runs.settings import FrozenSettings
from harness.runs.stopping import looked_otherwise
from harness.runs.unanswered import tally
from harness.world import scenarios

RULES = (DRIVER, "proxy")  # engines that are no models
# Of an answer, what only a way of asking leaves: the setting of an agent, and its value then.
SHOWN_BY: Mapping[str, tuple[str, object]] = {
    "flipped": ("flip", True),
    "letter_share": ("letters", "cyclic"),
}


class Held:
    """Ask a rule-based model in a run's place, and count the run's answers that differ: a backend.

    A backend is the code that gives answers. `wrong` is that count. Identity and latency are the
    run's.
    """

    is_record = True

    def __init__(self, rule: Backend, kept: Kept) -> None:
        self._rule, self._kept, self.wrong = rule, kept, 0

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        kept_completions, here = self._kept.complete(requests), self._rule.complete(requests)
        self.wrong += sum(a.text != b.text for a, b in zip(kept_completions, here, strict=True))
        return here

    def identity(self) -> dict[str, Any]:
        return self._kept.identity()

    def latency(self) -> Latency:
        return self._kept.latency()


def computed(run: Run, spec: Spec, out: Path, progress: Callable[[int], None]) -> tuple[Run, int]:
    """Compute a run again from its stored answers into folder `out`.

    Returns the new run, and how many stored answers differ from those of the rule-based model
    installed here; 0 for other models. `spec` is the run's evaluation, and `progress` is called
    with the number of answers that were read.
    """
    kept, held = Kept(run), list[Held]()

    def opens(card: Card, **options: Any) -> Backend:
        if card.engine not in RULES:
            return kept
        held.append(Held(open_backend(card, **options), kept))
        return held[-1]

    try:
        evaluate(spec, out, progress, opens=opens)
    except LacksAnswer as lack:
        lack.otherwise = sum(each.wrong for each in held)
        raise
    except KeyboardInterrupt as stop:
        stop.__notes__ = []  # that the folder keeps what is done: it is deleted
        raise
    work.tidy(out)
    return read(out), sum(each.wrong for each in held)


def differences(
    run: Run, dataset: Dataset | None, out: Path, progress: Callable[[int], None]
) -> tuple[list[str], list[str]]:
    """Compute a run again, in an empty folder, and compare; a driven one is driven again.

    Returns two lists of sentences: what the run's tables say otherwise than the new ones, and which
    columns it lacks, as a run by older rules may.

    Args:
        run: the run, which is not changed.
        dataset: the dataset that the run is of; None for a driven run.
        out: the folder, which is written.
        progress: called with the number of answers that were read again.

    Raises UserError if a prompt, a channel or the like is not here as it was.
    """
    source = _source(run, dataset)
    if tuple(source.numbers) != run.grid.episodes:
        return [OTHER_EPISODES], []
    stored_spec, manifest = spec_of(run, source), run.manifest
    check_prompts(run, stored_spec)
    timer = manifest.timer
    ego = replace(stored_spec.ego, card=card_here(stored_spec.ego.card))
    latency = None if manifest.latency.speeds else latencies.as_declared(manifest.latency)
    stored_settings = manifest.settings
    settings = structs.replace(stored_spec.settings, ask=stored_settings.ask, latency=latency)
    points = tuple(points_of(run).values())
    spec = replace(stored_spec, ego=ego, points=points, timer=timer, settings=settings)
    alone = [*contradictions(run), *_of_manifest(run, stored_spec.ego.card)]
    try:
        ours, otherwise = computed(run, spec, out, progress)
    except Unanswered:
        return [*alone, _unanswered(run)], []
    except LacksAnswer as lack:
        lacks = f"answers.jsonl has no answer to {lack.question}, asked by what run.json states"
        return [*alone, *_of_rule(lack.otherwise), lacks], []
    wrong = [
        *alone,
        *_of_tables(run, ours, ("path",)),
    ]
    if list(map(astuple, run.layouts)) != list(map(astuple, ours.layouts)) and run.layouts:
        wrong.append("difficulty.csv is not what the trees of the dataset say of its layouts")
    wrong += _of_rule(otherwise)
    return wrong, [*_lacking(run, ours), *_unchecked_choice(manifest.world.selection)]


def _source(run: Run, dataset: Dataset | None) -> Source:
    """Return the scenes of a run: those of `dataset`, or for None those of layouts to drive."""
    world = run.manifest.world
    if isinstance(world, FrozenScenes):
        assert dataset is not None
        choice = choice_of(run, dataset.episodes, dataset)
        numbers = choice.numbers if choice else dataset.episodes
        part = dataset.of_episodes(frozenset(numbers[: world.limit]))
        return FrozenSource(part, world.limit, choice)
    from harness.evaluate.live_world import LiveSource  # a base install has no simulator

    most = count_to_select_of(run)
    choice = choice_of(run, range(most), None)
    if choice:
        choice = replace(choice, numbers=choice.numbers[: world.episodes])
    return LiveSource(world.first_seed, most, scenarios.argument(run.manifest.scenario), choice)


def _unchecked_choice(record: Mapping[str, Any]) -> Iterator[str]:
    if owner := select.lacking(record):
        yield f"Whether these are the episodes to select is not checked: that is {part_of(owner)}."


def refuse_otherwise(run: Run, spec: Spec) -> None:
    """Raise UserError if a finished run's tables are not what its answers make, computed again.

    For a run that work goes on from, and that anybody may have written. `spec` is its evaluation.
    No model is asked; a driven run is driven again.
    """
    looks = run.manifest.interim_looks
    evaluated = spec.stopped(looks) if looks else spec
    stays = replace(evaluated, stopping_rule=None, guards=())
    with TemporaryDirectory(prefix="harness-") as folder:
        try:
            ours, otherwise = computed(run, stays, Path(folder) / "run", lambda done: None)
        except LacksAnswer as lack:
            wrong = [f"answers.jsonl has no answer to {lack.question}"]
        except Unanswered:
            wrong = [_unanswered(run)]
        else:
            wrong = [
                *_of_manifest(run, spec.ego.card),
                *_of_tables(run, ours, ("path", "interim_looks")),
                *_of_rule(otherwise),
            ]
    if spec.stopping_rule and looks:
        wrong += looked_otherwise(spec.stopping_rule, looks, run.grid, run.episodes)
    if wrong:
        raise UserError(f"{printable(run.path)}: {wrong[0]}; delete that folder, and type it again")


def _unanswered(run: Run) -> str:
    return f"answers.jsonl has no answer to {tally(run).counts()}: too many for a result"


def _of_rule(otherwise: int) -> Iterator[str]:
    if otherwise:
        yield f"answers.jsonl has {amount(otherwise, 'answer')} otherwise than the rule here"


def _lacking(run: Run, ours: Run) -> Iterator[str]:
    """Yield, in a sentence, the columns that are empty in a run by older rules,
    and are not here.
    """
    if current(run):
        return
    table, here = run.decisions.rows, ours.decisions.rows
    names = [
        *(
            name
            for name in Episode.__struct_fields__
            if _empty(run, name) and not _empty(ours, name)
        ),
        *(name for name in here.column_names if _null(table, name) and not _null(here, name)),
    ]
    if names := list(dict.fromkeys(names)):
        yield (
            f"Columns are empty that its answers fill: {', '.join(names)}. Older runs do not have "
            "them."
        )


def _empty(run: Run, name: str) -> bool:
    return all(getattr(episode, name) is None for episode in run.episodes)


def _null(table: Any, name: str) -> bool:
    return name not in table.column_names or table[name].null_count == len(table)


def texts_otherwise(run: Run) -> Iterator[str]:
    """Yield a sentence for each field of answers that is not what parsing their texts again gives.

    Raises UserError if a prompt of the run is neither here nor kept in it.
    """
    wrong_by_field = Counter(field for _, field in others(run))
    for field, wrong in wrong_by_field.items():
        yield f"answers.jsonl has another {field} in {amount(wrong, 'answer')} than its texts say"


def _of_manifest(run: Run, card: Card) -> Iterator[str]:
    """Yield what run.json, with this card of the ego's model, states otherwise than is here."""
    if (timer := run.manifest.timer) and (change := timer.changed()):
        yield change
    yield from times_otherwise(run, card)
    yield from _of_limit(run)
    yield from _of_agents(run)
    yield from _of_calls(run)
    yield from records_otherwise(run)


def _of_tables(run: Run, ours: Run, besides: Collection[str]) -> Iterator[str]:
    """Yield what a run states of its scenes and in its tables otherwise than the one made here.

    `besides` are fields of its scenes that are not compared.
    """
    yield from _of_scenes(run, ours, besides)
    yield from _of_episodes(run, ours)
    yield from _of_decisions(run, ours)
    yield from _of_answers(run, ours)


def _of_scenes(run: Run, ours: Run, besides: Collection[str]) -> Iterator[str]:
    """Yield what run.json states of its scenes otherwise than they are.

    `besides` are fields that are not compared.
    """
    what = "the dataset" if run.world == "frozen" else "the simulator"
    world, here = (to_builtins(each.manifest.world) for each in (run, ours))
    for name in here.keys() - {*besides}:
        if world.get(name) != here[name]:
            yield f"run.json has another {name} of its scenes than {what}"


def _of_limit(run: Run) -> Iterator[str]:
    """Yield whether run.json has more or fewer scenes asked for than its settings.

    A run that stopped early states those that it came to, and an older one states no settings.
    """
    if "settings" not in run.record:
        return
    world, settings = run.manifest.world, run.manifest.settings.world
    if isinstance(world, FrozenScenes) and isinstance(settings, FrozenSettings):
        is_stopped = world.interim_looks is not None and world.limit == world.episodes
        if world.limit != settings.limit and not is_stopped:
            yield "run.json has another limit of its scenes than its settings"


def _of_agents(run: Run) -> Iterator[str]:
    """Yield what run.json says otherwise of what its models see, and of what they cost."""
    manifest = run.manifest
    for record in (manifest.agent(0), *manifest.helpers):
        card = model_of(run, record)
        if card.privileged != sees_all(record["model"]):
            yield f"run.json says of {printable(card.name)} that it sees other than it does"
        cost = (manifest.cost or {}).get(card.name)
        if cost and card.price:
            amount_here = card.price.of(cost.read_tokens, cost.written_tokens)
            if not close(cost.amount, amount_here):
                yield f"run.json has another cost of {printable(card.name)} than its tokens make"


def _of_calls(run: Run) -> Iterator[str]:
    """Yield how run.json says that its agents were asked otherwise than what is here shows.

    Its answers show whether lists were read reversed and in several orders, and prompts that are
    here whether they are released. An agent is a model, its prompt and how it is asked.
    """
    for record in (run.manifest.agent(0), *run.manifest.helpers):
        version, sha256 = record["prompt"]["version"], record["prompt"]["sha256"]
        prompt = versions.as_it_was(version, sha256)
        if prompt and record["prompt"].get("released") and not prompt.released:
            yield f"run.json calls prompt {printable(version)} released, and here it is a draft"
    agents = dict[int, dict[str, Any]]()
    with_it, without = Counter[tuple[int, str]](), Counter[tuple[int, str]]()
    for answer in run.answers:
        agent = run.agent(answer)
        agents[id(agent)] = agent
        for name in SHOWN_BY:
            is_there = getattr(answer, name) is not UNSET
            with_it[id(agent), name] += is_there
            without[id(agent), name] += answer.intent is not None and not is_there
    for place, agent in agents.items():
        for name, (setting, value) in SHOWN_BY.items():
            if agent[setting] != value and with_it[place, name]:
                yield f"answers.jsonl has {name}, which {setting} {agent[setting]} gives to none"
            elif agent[setting] == value and without[place, name] and not with_it[place, name]:
                yield f"answers.jsonl has no {name}, which {setting} {agent[setting]} gives"


def _of_episodes(run: Run, ours: Run) -> Iterator[str]:
    """Yield which columns of episodes.csv differ; a column that an older run lacks does not."""
    for name, wrong in differing(run.episodes, ours.episodes):
        if current(run) or not _empty(run, name):
            yield f"episodes.csv has another {name} in {amount(wrong, 'row')} than its answers make"


def _of_answers(run: Run, ours: Run) -> Iterator[str]:
    """Yield what answers.jsonl says otherwise of its texts,
    from which the rates of parsing follow.
    """
    here = {(each.scene, each.viewer, each.heard, each.role): each for each in ours.answers}
    answer_pairs = [
        (each, here.get((each.scene, each.viewer, each.heard, each.role))) for each in run.answers
    ]
    # Words may be others in another version, and its parser the same.
    is_worded_here = run.manifest.versions.get("harness") == __version__
    for name in (*OF_TEXTS, *(["detail"] if is_worded_here else [])):
        wrong = sum(b is not None and not same(name, a, b) for a, b in answer_pairs)
        if wrong:
            yield (
                f"answers.jsonl has another {name} in {amount(wrong, 'answer')} than its texts say"
            )
    stated_agents = [(a, b) for a, b in answer_pairs if b and a.agent is not UNSET]
    if wrong := sum(a.agent != b.agent for a, b in stated_agents):
        yield f"answers.jsonl has another agent in {amount(wrong, 'answer')} than were asked"
    of_rules = [(a, b) for a, b in answer_pairs if b and run.agent(a)["model"]["engine"] in RULES]
    if wrong := sum(not close(a.slow_s, b.slow_s) for a, b in of_rules):
        yield f"answers.jsonl has another delay in {amount(wrong, 'answer')} than the rule here"
    for name in ("prompt_tokens", "completion_tokens", "seconds", "first_token_s", "token_s"):
        if wrong := sum(getattr(a, name) != getattr(b, name) for a, b in of_rules):
            answers = amount(wrong, "answer")
            yield f"answers.jsonl has another {name} in {answers} than the rule here"
    if more := sum(b is None for _, b in answer_pairs):
        yield f"answers.jsonl has {amount(more, 'answer')} to questions that nobody asked"


def _of_decisions(run: Run, ours: Run) -> Iterator[str]:
    """Yield which columns of decisions.parquet differ."""
    if len(run.decisions) != len(ours.decisions):
        yield (
            f"decisions.parquet has {amount(len(run.decisions), 'row')}, and its answers make "
            f"{len(ours.decisions)}"
        )
        return
    table, here = run.decisions.rows, ours.decisions.rows
    for name in (name for name in here.column_names if name in table.column_names):
        if table[name].equals(here[name]) or (_null(table, name) and not current(run)):
            continue
        pairs = zip(table[name].to_pylist(), here[name].to_pylist(), strict=True)
        if wrong := sum(not close(a, b) for a, b in pairs):
            yield (
                f"decisions.parquet has another {name} in {amount(wrong, 'row')} than its answers "
                "make"
            )
