"""A metric over the runs of a folder, by date. Runs of the same scenes make a group;
no others compare.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from harness.core.errors import UserError, printable, unknown
from harness.report.compare.page import Place, beside
from harness.report.compare.pair import where
from harness.report.document import Section, Table, document, forest, linked, reach
from harness.report.page import save
from harness.report.words import cell
from harness.runs.folder import Run, read
from harness.runs.headline import headline_of
from harness.runs.listing import runs as listed
from harness.runs.metric_names import ALL
from harness.runs.metrics import entry
from harness.runs.records import ClosedLoop, Score


@dataclass(frozen=True)
class Line:
    """Hold one run in a history: a list of runs on the same scenes, with one metric, by date.

    `name` is its folder, relative to the folder of all runs, `date` is when it began, and `score`
    its value of the metric under the list's condition (settings of radio, asking and fusion); None
    where it has none.
    """

    name: str  # its folder, relative to the folder of all runs
    date: datetime  # when it began, UTC
    run: Run  # the run as it was read
    # its value of the metric in the group's condition (settings of radio, asking and fusion); None
    # where it has none
    score: Score | None


@dataclass(frozen=True)
class Group:
    """Hold the runs of the same scenes, by date, and the metric and condition of their values.

    A condition is an operating point by its name: settings of radio, asking and fusion.
    """

    of: str  # the scenes, for people: a dataset with its digest, or a scenario with its layouts
    # condition of the values: the given one, or the last of those that most of the runs have;
    # `all` of a metric that depends on none
    condition: str
    metric: str  # metric of the values, such as `success_rate`
    lines: tuple[Line, ...]  # by date, the oldest first


def history(
    folder: Path,
    metric: str | None,
    condition: str | None = None,
    dataset: str | None = None,
    wrong: Callable[[str, UserError], object] = lambda name, error: None,
) -> list[Group]:
    """Return the finished runs in a folder in groups of the same scenes, by date.

    So one sees how a metric went from run to run. The group with the newest run comes first.

    Args:
        folder: is searched for runs, with folders below it.
        metric: a metric of `summary.csv`; None for each group's headline success.
        condition: name of settings of radio, asking and fusion in the runs; None for the last of
            those that most of a group's runs have.
        dataset: name of the dataset, or of the scenario of driven runs; None for all.
        wrong: called with the name of a run that is left out since a file of it is broken, and the
            error.

    Raises:
        UserError: there is no such folder, metric, condition or dataset.
    """
    lines: dict[object, list[Line]] = {}
    for listing in reversed(listed(folder)):
        if listing.state == "finished" and listing.kind in ("eval", "drive"):
            try:
                run = read(folder / listing.name)
                assert run.scores is not None  # they are read from a file of their own
            except UserError as error:
                wrong(listing.name, error)
                continue
            line = Line(listing.name, listing.date, run, None)
            lines.setdefault(repr(_alike(run)), []).append(line)
    if not lines:
        raise UserError(f"no finished runs in {printable(folder)}; `harness eval` makes one")
    runs = [line.run for of in lines.values() for line in of]
    for what, name, names in (
        ("metric", metric, {score.metric for run in runs for score in run.scores}),
        ("condition", condition, {name for run in runs for name in run.conditions}),
        ("dataset", dataset, {_scenes(run) for run in runs}),
    ):
        if name is not None and name not in names:
            raise unknown(f"{what} of these runs", name, names)
    groups = [
        _group(of, metric, condition)
        for of in lines.values()
        if dataset in (None, _scenes(of[0].run))
    ]
    return sorted(groups, key=lambda group: group.lines[-1].date, reverse=True)


def _alike(run: Run) -> object:
    """Return what runs of a group have alike: their scenes, and what vehicles hear in beacons."""
    world = run.manifest.world
    return world.pinned, world.scenario if isinstance(world, ClosedLoop) else None


def _scenes(run: Run) -> str:
    return run.source.partition(" (")[0]


def _group(lines: Sequence[Line], metric: str | None, condition: str | None) -> Group:
    if condition is None:
        count = Counter(name for line in lines for name in line.run.conditions)
        most = max(count.values())
        condition = next(name for name in reversed(list(count)) if count[name] == most)

    metric = metric or headline_of(*(line.run for line in lines))
    scored = tuple(
        replace(line, score=line.run.score(condition, metric) or line.run.score(ALL, metric))
        for line in lines
    )
    if {line.score.condition for line in scored if line.score} == {ALL}:
        condition = ALL
    return Group(where(lines[-1].run), condition, metric, scored)


def write(groups: Sequence[Group], out: Path) -> None:
    """Write a history, groups of runs on the same scenes by date, to `out` as an HTML page.

    Raises UserError if the file cannot be written.
    """
    place, labels = beside(out), dict.fromkeys(entry(group.metric).label for group in groups)
    about = (
        "Runs by date, the oldest first, with 95 % intervals; n is the number of episodes or "
        "answers that a value is the mean of. Only runs in one table compare, since they have the "
        "same scenes; a run with fewer episodes has other scenes."
    )
    tables = [_table(group, place) for group in groups]
    title = f"{' or '.join(labels)} over runs"
    save([document([Section(title, about=[about], tables=tables)])], out, "--html")


def _table(group: Group, place: Place) -> Table:
    label = entry(group.metric).label
    scale = reach(line.score for line in group.lines if line.score)
    heads = ("run", "started", "model", "prompt", "answer", label, "interval, on one scale", "n")
    rows = []
    for line in group.lines:
        variant, score = line.run.manifest.variant, line.score
        drawn = (forest(score, *scale), str(score.n)) if score else ("", "")
        rows.append(
            (
                linked(line.name, place(line.run)),
                f"{line.date:%Y-%m-%d %H:%M} UTC",
                variant.model,
                variant.prompt,
                variant.answer,
                cell(score),
                *drawn,
            )
        )
    return Table(f"{group.of}, {group.condition}", heads, rows, left=True)
