"""Hold the tables of a run against each other:
each follows from others, and a file can state any number.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from msgspec.structs import asdict

from harness import __version__
from harness.coordination.named_points import misnamed
from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.core.formats import SUITE
from harness.core.versions import DECISIONS, FIGURES, PARSER
from harness.dataset.suites import PREFIX, named
from harness.runs import digests, pinned, sources
from harness.runs.difficulty import adjusted_scores
from harness.runs.folder import Run, read, texts_of, whole
from harness.runs.headline import BALANCED, PAIRED
from harness.runs.manifest_contradictions import by_later_rules, of_manifest
from harness.runs.metric_names import BASELINE, GAINS
from harness.runs.metrics import METRICS
from harness.runs.records import Episode, FrozenScenes, Score, Variant
from harness.runs.reliability import SAME
from harness.runs.suite import SUMMARY, SuiteRun
from harness.runs.summary import Figures, counted

_COLUMNS = ("value", "low", "high", "n", "n_excluded")  # the numbers of a figure
# What runs by rules of version 1 may lack, though it follows from what they have
LATER = {
    BALANCED,
    *METRICS.built_in[BALANCED].halves,
    GAINS[BALANCED],
    "optimal_action_rate",
    "optimal_brier",
    "optimal_nll_nats",
    *(name for name, metric in METRICS.built_in.items() if metric.pooled),
    *(name for name in METRICS.built_in if name.startswith("success_dangerous_rate_")),
}
Key = tuple[str, str, str]
CLOSE = 1e-6  # how near numbers stay that were only written and read again


def refuse(run: Run | SuiteRun) -> None:
    """Raise UserError if a table of a run or suite contradicts the tables it is computed from.

    It guards what is computed from files that anybody may have written; such is a mean in
    `summary.csv` that is not that of `episodes.csv`. A suite, a run on each of several scenarios,
    is checked with all of its runs.
    """
    if isinstance(run, SuiteRun):
        for member in run.runs.values():
            refuse(member)
    sentences = list(of_suite(run) if isinstance(run, SuiteRun) else contradictions(run))
    if sentences:
        more = f", and {len(sentences) - 1} more" if len(sentences) > 1 else ""
        name = printable(run.path)
        raise UserError(
            f"{name} contradicts itself: {sentences[0]}{more}; make the run again, or list all by "
            f"`harness run check {name}`"
        )


def sound(folder: Path) -> Run:
    """Read a run, and check it before something is computed from its tables.

    `folder` is the run's. Raises UserError if it is broken, or a table contradicts those that it is
    computed from.
    """
    run = read(folder)
    refuse(run)
    return run


def contradictions(run: Run) -> Iterator[str]:
    """Yield a sentence for each statement of a run's tables that its other tables contradict.

    Such a statement is a score in `summary.csv` that is not what `episodes.csv` gives. Scores are
    computed again by the rules of the version that the run states (`versions.FIGURES`); a run of an
    earlier version may lack figures that only later ones have.
    """
    for name, newest in (("figures", FIGURES), ("parser", PARSER), ("decisions", DECISIONS)):
        version = run.manifest.versions.get(name, "1")
        if version not in map(str, range(1, newest + 1)):
            yield (
                f"run.json has {name} of version {printable(version)}, and this harness has "
                f"{newest}"
            )
    for table in ("episodes.csv", SUMMARY):
        yield from _of_variant(run.path / table, run.manifest.variant, "run.json")
    yield from _of_conditions(run)
    yield from _of_episodes(run)
    answers, reached = list(run.answers), run.decisions.scenes
    yield from of_manifest(run, answers)
    if current(run):
        yield from by_later_rules(run, answers)
    undecided = (answer.scene for answer in answers if answer.scene not in reached)
    if (scene := next(undecided, None)) is not None:
        yield f"answers.jsonl has scene {printable(scene)!r}, which decisions.parquet has not"
    answered = {answer.scene for answer in answers}
    if (scene := next((each for each in reached if each not in answered), None)) is not None:
        yield f"decisions.parquet has scene {printable(scene)!r}, which answers.jsonl has not"
    delays = filter(None, map(run.undeclared_delay, answers))
    if (delay := next(delays, None)) is not None:
        yield f"answers.jsonl has {delay}"
    misattributed = filter(None, map(run.impossible_agent, answers))
    if (phrase := next(misattributed, None)) is not None:
        yield f"answers.jsonl has {phrase}, which states none or another"
    yield from _of_scores(run, _scores(run))
    yield from digests.otherwise(run)
    agents = (run.manifest.agent(0), *run.manifest.helpers)
    yield from sources.otherwise(sources.read(run.path), [agent["prompt"] for agent in agents])


def of_suite(suite: SuiteRun) -> Iterator[str]:
    """Yield a sentence for each mean of a suite's table that its runs' scores contradict.

    A suite is a run for each of several scenarios. Intervals are compared only if all of its runs
    state this harness's version of the rules for figures (`versions.FIGURES`).
    """
    scenes = [run.manifest.world.pinned for run in suite.runs.values()]
    if any(scenes.count(each) > 1 for each in scenes):
        yield f"{SUITE} has two families of the same scenes"
    yield from _of_families(suite)
    yield from _of_variant(suite.path / SUMMARY, suite.variant, "its runs")
    older = _older(suite)
    columns = ("value",) if older else _COLUMNS
    stated_scores = {
        _key(older, score) if older else score.key: score for score in suite.stated_scores
    }
    computed = {score.key: score for score in suite.scores}
    for key in dict.fromkeys((*stated_scores, *computed)):
        if key not in computed:
            yield f"{SUMMARY} has {_figure(stated_scores[key])}, which is no mean over its runs"
        elif key not in stated_scores:
            yield f"{SUMMARY} lacks {key[1]} in {printable(key[0])} ({key[2]})"
        else:
            yield from _otherwise(stated_scores[key], computed[key], columns, "its runs make")


def unchecked_of_suite(suite: SuiteRun) -> Iterator[str]:
    """Yield a sentence if intervals and counts of a suite's table are not compared.

    They are not where one of its runs states figures by the rules of an earlier version.
    """
    if older := _older(suite):
        version = printable(older.manifest.versions.get("figures", "1"))
        yield (
            f"Its means are held by value alone, not their intervals and n: run.json of "
            f"{printable(older.path.name)} states figures by the rules of version {version}."
        )


def _of_variant(table: Path, variant: Variant, whose: str) -> Iterator[str]:
    """Yield whether rows of a CSV file are of another model, prompt or answer mode than `whose`."""
    names = asdict(variant)
    for column, texts in whole(table, lambda file: texts_of(file, names)).items():
        name = names[column]
        for text in sorted(texts - {name}):
            yield f"{table.name} has {column} {printable(text)!r}, and {whose} {printable(name)!r}"


def _older(suite: SuiteRun) -> Run | None:
    """Return a suite's first run by the rules of an earlier version; None if there is none."""
    return next((run for run in suite.runs.values() if not current(run)), None)


def _scores(run: Run) -> Iterator[Score]:
    """Yield the figures that follow from a run's decisions, episodes, layouts and answers,
    by its rules.
    """
    answers = [answer for answer in run.answers if answer.scene in run.decisions.scenes]
    with np.errstate(all="ignore"):  # a file can state any number
        figures = Figures.of(run.world, run.grid, run.decisions, run.episodes, answers)
        yield from figures.scores(older=not current(run))
    if rule := run.manifest.stopping_rule:
        yield from rule.scores(run.grid, run.episodes)
    if run.layouts:
        yield from adjusted_scores(run.grid, run.episodes, run.layouts)
    for score in run.scores:
        gains = score.metric in GAINS.values() and {score.condition, BASELINE} <= {*run.conditions}
        if gains and score.interval == pinned.KIND:  # an older run's
            yield pinned.gain(run, score)


def current(run: Run) -> bool:
    """Return whether a run's figures were computed by the rules that this harness has for them.

    Only then must they be the same if computed again. The run's manifest states the version of the
    rules, a number; one that states none is of version 1, the oldest.
    """
    return run.manifest.versions.get("figures", "1") == str(FIGURES)


def _of_scores(run: Run, computed: Iterable[Score]) -> Iterator[str]:
    """Yield which figures are others than those computed, are none of them, or are not there."""
    of_harness, here = METRICS.of_harness, {score.key: score for score in computed}
    stated_scores = {score.key: score for score in run.scores}
    for key, score in stated_scores.items():
        other = here.get(key)
        if score.metric not in of_harness or (
            other is None and of_harness[score.metric].superseded
        ):
            continue  # `unchecked` says so
        if other is None:
            yield f"{SUMMARY} has {_figure(score)}, which its other tables do not have"
        else:
            none = not current(run) and score.low is None and score.high is None and _narrow(other)
            columns = ("value", "n", "n_excluded") if none else _COLUMNS
            yield from _otherwise(score, other, columns, "its other tables make")
    may_lack = set() if current(run) else LATER - {key[1] for key in stated_scores}
    for key in _lacking(run, here.values()):
        if key[1] not in may_lack:
            yield f"{SUMMARY} lacks {key[1]} in {printable(key[0])} ({key[2]})"


def _lacking(run: Run, computed: Iterable[Score]) -> Iterator[Key]:
    """Yield which figures of the harness a run lacks,
    under their earlier kind of interval as well.
    """
    stated_keys = {_key(run, score) for score in run.scores}
    for score in computed:
        if score.metric in METRICS.of_harness and _key(run, score) not in stated_keys:
            yield score.key


def unchecked(run: Run) -> Iterator[str]:
    """Yield a sentence on those of a run's figures that nobody can compute again here.

    Such are those of another package's metric. Another sentence is on figures that a run by rules
    of an earlier version of the harness is allowed to lack. Nothing is yielded if all can be
    checked.
    """
    figures = {score.key: score for score in run.scores}
    here = {} if current(run) else {score.key: score for score in _scores(run)}
    held = {
        key for key in figures if key[1] in METRICS.of_harness and (current(run) or key in here)
    }
    if names := dict.fromkeys(key[1] for key in figures if key not in held):
        what = "a package's metrics, or an earlier harness's"
        yield f"{_listed(names)}: as summary.csv states, and not checked, since they are {what}."
    yield from digests.unheld(run)
    if (decided_by := run.manifest.versions.get("decisions", "1")) != str(DECISIONS):
        yield (
            f"Its answers are decided by the rules of version {printable(decided_by)}, as run.json "
            f"states, and here by those of version {DECISIONS}."
        )
    worded_by = run.manifest.versions.get("harness", "an earlier version")
    if worded_by != __version__:
        yield f"Not held: the sentence on each answer, that of harness {printable(worded_by)}."
    version = printable(run.manifest.versions.get("figures", "1"))
    for sentence in () if current(run) else by_later_rules(run, list(run.answers)):
        yield f"Not held, since its figures are by the rules of version {version}: {sentence}."
    rule, record = run.manifest.stopping_rule, run.manifest.world.interim_looks
    if rule and record and (open_point := rule.unchecked(record)):
        yield open_point
    if names := dict.fromkeys(key[1] for key in _lacking(run, here.values())):
        yield (
            f"Its figures are made by the rules of version {version}, as run.json states. It lacks "
            f"{_listed(names)}, and whether they were left out cannot be checked."
        )


def _listed(names: Iterable[str]) -> str:
    first, *rest = map(printable, names)
    return " and ".join(filter(None, (", ".join((first, *rest[:-1])), *rest[-1:])))


def _key(run: Run, score: Score) -> Key:
    """Return what a figure is known by;
    of a gain in a run by older rules, whichever interval it has.
    """
    gain = score.metric in GAINS.values() and score.interval == pinned.KIND
    return (score.condition, score.metric, PAIRED) if gain and not current(run) else score.key


def _of_families(suite: SuiteRun) -> Iterator[str]:
    """Yield whether a suite's run lacks datasets of the suite that it names, or has others.

    A suite that is not here is not compared.
    """
    with suppress(UserError):
        here = named(f"{PREFIX}{suite.name}")
        worlds = [run.manifest.world for run in suite.runs.values()]
        datasets = [world.name for world in worlds if isinstance(world, FrozenScenes)]
        if here and sorted(datasets) != sorted(here.datasets):
            count, of = len(set(datasets) & set(here.datasets)), len(here.datasets)
            yield f"{SUITE} has {count} of the {of} datasets of suite {printable(suite.name)}"


def _otherwise(score: Score, other: Score, columns: Sequence[str], whose: str) -> Iterator[str]:
    """Yield which numbers of a figure are others than those computed;
    `whose` these are, in words.
    """
    for what in columns:
        a, b = getattr(score, what), getattr(other, what)
        if not close(a, b):
            yield f"{SUMMARY} has {_figure(score, what)}, and {whose} it {b}"


def _narrow(score: Score) -> bool:
    """Return whether a figure's interval has no width but that of rounding,
    which version 1 left out.
    """
    return score.low is not None and score.high is not None and score.high - score.low < SAME


def _figure(score: Score, what: str = "value") -> str:
    condition, metric, interval = map(printable, score.key)
    of = "" if what == "value" else f", {what},"
    return f"{metric}{of} {getattr(score, what)} in {condition} ({interval})"


def _of_conditions(run: Run) -> Iterator[str]:
    """Yield which settings of conditions are others than the conditions' names say.

    What a name says by a file follows from the run's own, so one that is another here says nothing.
    """
    others = sources.other_files(run)
    for condition in run.manifest.conditions:
        name = printable(str(condition["name"]))
        if any(condition.get(folder.removesuffix("s")) == file for folder, file in others):
            continue
        for key in misnamed(condition):
            value = printable(str(condition.get(key)), 60)
            yield f"run.json has {key} {value} in {name}, whose name says otherwise"


def _of_episodes(run: Run) -> Iterator[str]:
    """Yield which columns of episodes.csv say otherwise than decisions.parquet."""
    computed = counted(run.grid, run.decisions, run.episodes)
    for name, wrong in differing(run.episodes, computed):
        yield f"episodes.csv has another {name} in {amount(wrong, 'row')} than decisions.parquet"
    wrong = sum(
        a.success != b for a, b in zip(run.episodes, _ends(run), strict=True) if b is not None
    )
    if wrong:
        yield (
            f"episodes.csv has another success in {amount(wrong, 'row')} than the last decision "
            "leaves"
        )


def differing(
    stated_rows: Sequence[Episode], computed_rows: Sequence[Episode]
) -> Iterator[tuple[str, int]]:
    """Yield each column in which two tables of episodes differ, and in how many rows it does.

    Both tables have the same episodes in the same order: what a file states, and what is computed.
    Numbers may differ by the rounding of files.
    """
    for name in Episode.__struct_fields__:
        pairs = zip(stated_rows, computed_rows, strict=True)
        wrong = sum(not close(getattr(a, name), getattr(b, name)) for a, b in pairs)
        if wrong:
            yield name, wrong


def _ends(run: Run) -> Sequence[bool | None]:
    """Return whether success is still possible after each episode's last action;
    None where it is unknown.

    After it nothing is decided any more. Only the trees of frozen scenes know.
    """
    decisions, ends = run.decisions, list[bool | None]([None] * len(run.episodes))
    places, steps = run.grid.places(decisions), decisions.whole("step")
    order = np.lexsort((steps, places))
    last = order[np.flatnonzero(np.diff(places[order], append=-1))]
    columns = ["action", *(f"safe_{action}" for action in run.actions)]
    at_end = decisions.selected(columns).take(last)
    safe = at_end.of_actions("safe")
    possible = safe[np.arange(len(safe)), at_end.codes("action", run.actions)]
    for place, of_last in zip(places[last].tolist(), possible.tolist(), strict=True):
        ends[place] = None if math.isnan(of_last) else of_last == 1.0
    return ends


def close(a: object, b: object) -> bool:
    """Return whether two cells of a table are equal, floats up to the rounding of files (`CLOSE`).

    Used to compare what a file states with what is computed again.
    """
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=CLOSE, abs_tol=CLOSE)
    return a == b
