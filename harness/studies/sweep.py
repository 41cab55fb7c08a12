"""`harness study sweep`: a run's answers, scored again at every point of a grid."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.parts import PLAIN
from harness.core.errors import UserError, printable
from harness.core.files import folder_in
from harness.core.versions import versions
from harness.report.document import Table
from harness.runs.headline import IN_WORDS, headline_metric
from harness.studies.axes import (
    AXES,
    CORE,
    CROSS,
    NONE,
    Axis,
    Setting,
    Value,
    axis_of,
    crossed,
    described,
    grid,
    refusal,
    usual_at,
)
from harness.studies.figures.axes import interval_of, lead_in
from harness.studies.figures.described import Draws
from harness.studies.play import PanelResult, Rows, Source, joined, play
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Study, percent, refuse_other

if TYPE_CHECKING:
    import pandas as pd

ESTIMATE = ("mean", "ci_low", "ci_high")
HEADS = {
    "trigger %": ("trigger_rate", 100),
    "msgs": ("messages_per_episode", 1),
    "latency ms": ("latency_proxy_ms", 1),
    "late %": ("deadline_miss_rate", 100),
}
PAIRED = (
    "Stored answers, scored again at other operating points. All points share their random draws, "
    "so a difference shows the setting and not the draws. 95 % intervals are over episodes, those "
    "of the calibrated proxy over seeds; conditions.csv has all figures with their n."
)


def settings(
    sources: Sequence[Source],
    axes: Sequence[Axis],
    grids: Sequence[Sequence[Value] | None],
    conditions: Sequence[str],
) -> tuple[Setting, ...]:
    """Return the points of a sweep's grid over one axis, or several crossed, for each condition.

    `sources` are the runs and models that are swept. A condition is a set of settings by its name;
    `axes` are what varies, such as packet loss, and `grids` has the values of each. A grid of None
    stands for the axis's default values that the condition allows.

    Raises:
        UserError: there is no such condition, it has no channel or an axis changes nothing in it, a
            grid has more vehicles than the scenes, or there are too many points.
    """
    runs = [source for source in sources if isinstance(source, ReplayedRun)]
    vehicles = min(run.vehicles for run in runs)
    name, result = CROSS.join(axis.name for axis in axes), list[Setting]()
    for condition in distinct_names(runs, conditions):
        start = point_of(runs, condition)
        lists = [given or usual_at(axis, start) for axis, given in zip(axes, grids, strict=True)]
        for axis, some in zip(axes, lists, strict=True):
            if axis.worded and some in ((), (NONE,)):
                raise UserError(
                    f"--over {axis.name}: {printable(condition)} allows none of its usual values; "
                    f"give others with --grid, or another --condition ({refusal(axis, start)})"
                )
            if axis.field is None and (most := max(map(float, some))) > vehicles:
                raise UserError(
                    f"--grid: {most:g} vehicles; the run's scenes have {vehicles} at most"
                )
        idle: list[dict[str, str | None]] = []
        for values in crossed(axes, lists):
            point, size = start, vehicles
            for axis, value in zip(axes, values, strict=True):
                point = axis.at(point, value)
                if axis.field is None:
                    size = int(value)
            if point.stream or point.elsewhere:
                _refuse_fewer(runs, condition, size)
            idle.append({axis.name: point.idle(axis.field) for axis in axes})
            value_or_values = values if len(axes) > 1 else values[0]
            result.append(Setting(condition, point, size, name, value_or_values))
        for axis in axes:
            if all(point[axis.name] for point in idle):
                raise UserError(
                    f"--over {axis.name}: it changes nothing in {printable(condition)}: "
                    f"{idle[0][axis.name]}; vary another setting or another --condition"
                )
    return tuple(result)


def _refuse_fewer(runs: Sequence[ReplayedRun], condition: str, size: int) -> None:
    """Raise UserError if fewer vehicles are to be played than some run has in its scenes."""
    most = max(run.vehicles for run in runs)
    if size < most:
        raise UserError(
            f"--condition {printable(condition)}: with {size} of {most} vehicles, those that are "
            "left out would still be heard, as messages come unasked or from elsewhere; leave it "
            "out, or vary another setting than the size"
        )


def point_of(runs: Sequence[ReplayedRun], name: str) -> OperatingPoint:
    """Return a set of settings by the name that a user types: of the runs, or of the paper.

    It may also be a change of one, typed such as `6g:max_helpers=1`. Such a set, an operating
    point, is everything a decision depends on besides scene and model; the paper is the one that
    this harness follows. Raises UserError if there is none, it has no channel, or it differs
    between the runs.
    """
    points = {run.points[name] for run in runs if name in run.points}
    if len(points) > 1:
        raise UserError(
            f"--condition {printable(name)} is not the same in all runs; sweep them one by one"
        )
    point = points.pop() if points else named_point(name)
    if point.radio.profile is None:
        raise UserError(
            f"--condition {printable(name)} has no channel; nothing of it can be varied"
        )
    return point


def distinct_names(runs: Sequence[ReplayedRun], names: Sequence[str]) -> list[str]:
    """Return the names of sets of settings without those that are an earlier one, spelt otherwise.

    `6g:tau=0.70` is `6g:tau=0.7`. Raises UserError as `point_of` does.
    """
    by_settings = dict[OperatingPoint, str]()
    for name in names:
        by_settings.setdefault(point_of(runs, name).changed(name="any"), name)
    return list(by_settings.values())


def usual(runs: Sequence[ReplayedRun], conditions: Sequence[str]) -> dict[str, tuple[Setting, ...]]:
    """Return the points of the sweeps that the repeated paper shows, by the name of the sweep.

    They are the runs' `conditions` (sets of settings, by name), and sweeps of the number of
    vehicles, of packet loss and of tau, the entropy above which the ego asks. In the sweep of
    vehicles, packet loss grows with their density. A point is such settings with a number of
    vehicles.
    """
    vehicles = min(run.vehicles for run in runs)
    points = {name: point for run in runs for name, point in run.points.items()}
    core = tuple(Setting(name, point, vehicles) for name, point in points.items())
    size = []
    sizes = grid(AXES["size"], f"1:{vehicles}")
    for setting in settings(runs, [AXES["size"]], [sizes], conditions):
        coupled = setting.point.changed(density_coupled=True, loss=None)
        size.append(replace(setting, point=coupled))
    loss = settings(runs, [AXES["loss"]], [grid(AXES["loss"])], conditions)
    tau = settings(runs, [AXES["tau"]], [grid(AXES["tau"])], conditions)
    return {CORE: core, "size": tuple(size), "loss": loss, "tau": tau}


def panels_over(
    runs: Sequence[ReplayedRun],
    over: Sequence[str],
    grids: Sequence[str],
    conditions: Sequence[str],
    apart: bool = False,
) -> dict[str, tuple[Setting, ...]]:
    """Return the grid points of a sweep by panel.

    A panel is a named set of grid points, operating points with a number of vehicles; an axis is
    what the sweep varies.

    Args:
        runs: the runs whose answers are scored.
        over: names of axes; without any, the paper's panels are returned.
        grids: texts with the values of each axis, in the same order; a missing one stands for the
            default values that a condition allows.
        conditions: names of the operating points that are varied.
        apart: whether each axis has a panel of its own, instead of all crossed in one.

    Raises:
        UserError: a condition, axis or value is unknown, an axis changes nothing in a condition,
            there are too many grid points, or more grids than axes.
    """
    axes = [axis_of(name) for name in dict.fromkeys(over)]
    if len(grids) > len(axes):
        raise UserError(
            f"--grid: {len(grids)} given for {len(axes)} of --over; give one for each --over, in "
            "the same order"
        )
    if not axes:
        return usual(runs, conditions)
    values = [None if text is None else grid(axis, text) for axis, text in zip_longest(axes, grids)]
    if not apart:
        name = CROSS.join(axis.name for axis in axes)
        return {name: settings(runs, axes, values, conditions)}
    panels = {}
    for axis, of_axis in zip(axes, values, strict=True):
        panels[axis.name] = settings(runs, [axis], [of_axis], conditions)
    return panels


def folder_of(run: Path, panels: Iterable[str]) -> Path:
    """Return the default folder of a run's sweep, in the run's folder and named after panels.

    `panels` are their names, such as what is varied.
    """
    return folder_in(run, f"sweep-{'-'.join(panels).replace(CROSS, '-')}")


def run_sweep(
    sources: Sequence[Source],
    panels: Mapping[str, Sequence[Setting]],
    seeds: Sequence[int],
    out: Path,
    progress: Callable[[int], None],
    say: Callable[[str], None] = lambda line: None,
) -> Study:
    """Score every source at every grid point of all panels, and return the study.

    A source is a run's answers, or what an extension draws; a panel is a named set of grid points,
    operating points with a number of vehicles. All share the channel's random numbers, keyed by
    `seeds`. `out` is the study's folder; `progress` is called with 1 after each grid point, and
    `say` with a line that has its success.

    Raises:
        UserError: the folder holds another sweep.
    """
    manifest = {
        "sources": [s.manifest() for s in sources],
        "seeds": list(seeds),
        "panels": described(panels),
    }
    refuse_other(out, "sweep", manifest)
    runs = [source for source in sources if isinstance(source, ReplayedRun)]

    def able(source: Source, point: OperatingPoint) -> bool:
        # The proxy has no model that could answer a fusion call, or another question.
        return source in runs or not (point.has_fusion_call or point.question != PLAIN)

    results: dict[str, list[PanelResult]] = {panel: [] for panel in panels}
    for panel, points in panels.items():
        for source in sources:
            playable = [setting for setting in points if able(source, setting.point)]
            if playable:
                tell = _Told(say)
                results[panel].append(play(source, panel, playable, seeds, progress, tell))
    for run in runs:
        run.settle()
    whole = joined([part for parts in results.values() for part in parts])
    summary = whole.summary
    main_tables = tables(summary)
    return Study(
        "sweep",
        f"{', '.join(source.name for source in sources)} over {', '.join(panels)}",
        [f"{table.title}: {in_a_sentence(table)}." for table in main_tables],
        [f"{counts(sources, seeds)}. {PAIRED}"],
        main_tables,
        {"conditions": summary, "episodes": whole.episodes},
        # Anew, since sources state what was left out.
        {**manifest, "sources": [s.manifest() for s in sources], "versions": versions()},
        summary,
        lambda draws: _figures(draws, summary, results),
        [caveat for run in runs for caveat in run.caveats],
    )


class _Told:
    """Say each grid point's success when it is known, below a line that says of what it is."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._title = say, ""

    def __call__(self, rows: Rows) -> None:
        [table] = _tables(rows)
        [(place, success, *_)] = table.rows
        if table.title != self._title:
            self._say(f"{printable(table.title)}: {table.heads[1]}")
            self._title = table.title
        self._say(f"  {printable(place)}  {success}")


def _figures(
    draws: Draws[Any], summary: "pd.DataFrame", results: Mapping[str, Sequence[PanelResult]]
) -> dict[str, Any]:
    """Draw lines of the axes that are varied alone, bars of the conditions,
    and maps of crossed axes.
    """
    figures = {}
    varied_alone = [panel for panel in results if panel != CORE and CROSS not in panel]
    if varied_alone:
        figures["sweep"] = draws.along([summary[summary.panel == panel] for panel in varied_alone])
    for n, part in enumerate(results.get(CORE, ()), 1):
        figures[f"operating-points-{n}"] = draws.operating_points(part.summary)
    crossed_panels = [panel for panel in results if CROSS in panel]
    maps = []
    for part in (part for panel in crossed_panels for part in results[panel]):
        for _, of_condition in part.summary.groupby("condition", sort=False):
            maps.append(of_condition)
    for n, of_condition in enumerate(maps, 1):
        figures["sweep" if n == 1 else f"sweep-{n}"] = _map(draws, of_condition)
    return figures


def counts(sources: Sequence[Source], seeds: Sequence[int]) -> str:
    """Return a phrase with the numbers of episodes and seeds of each source, such as a run.

    `seeds` are those of the channel.
    """
    of_sources = []
    for source in sources:
        whose = "" if source.same_episodes else " of their own"
        episodes = f"n = {source.episodes} episodes × {len(seeds)} seeds{whose}"
        of_sources.append(f"{source.name}: {episodes}")
    return f"{'; '.join(of_sources)} (channel seeds {', '.join(map(str, seeds))})"


def _map(draws: Draws[Any], part: "pd.DataFrame") -> Any:
    """Draw success of crossed axes: the first down, the second across,
    a panel for each of the others.
    """
    down, across, *panel_axes = part.variable.iloc[0].split(CROSS)
    rows = part[(part.metric == lead_in(part)) & (part.interval == interval_of(part))]
    groups = rows.groupby(panel_axes, sort=False) if panel_axes else [((), rows)]
    panels = {}
    for values, group in groups:
        names = [f"{name} {value}" for name, value in zip(panel_axes, values, strict=True)]
        wide = group.pivot(index=down, columns=across, values="mean")
        wide = wide.reindex(index=group[down].unique(), columns=group[across].unique())
        panels[", ".join([str(group.condition.iloc[0]), *names])] = 100 * wide.to_numpy(dtype=float)
    rows_of_map = [_text(value) for value in wide.index]
    columns_of_map = [_text(value) for value in wide.columns]
    return draws.heat_map(panels, rows_of_map, columns_of_map, down, across)


def tables(summary: "pd.DataFrame") -> list[Table]:
    """Return the main results of a study as tables, one for each source and curve.

    `summary` has a row for each grid point, metric and kind of interval. A curve is an operating
    point varied over an axis; the operating points themselves share a table.
    """
    return _tables(summary.to_dict("records"))


def _tables(scores: Sequence[Mapping[Any, Any]]) -> list[Table]:
    heads, rows = dict[str, tuple[str, str]](), dict[str, list[Sequence[str]]]()
    of_places: dict[tuple[Any, ...], dict[str, Any]] = {}
    for score in scores:
        value = None if score["panel"] == CORE else score["value"]
        place = score["source"], score["panel"], score["condition"], value
        metrics = of_places.setdefault(place, {})
        # Over episodes, but where a seed has episodes of its own.
        if score["interval"] == "episodes" or score["metric"] not in metrics:
            metrics[score["metric"]] = score
    for (source, panel, condition, value), metrics in of_places.items():
        means = [f"{scale * metrics[name]['mean']:.1f}" for name, scale in HEADS.values()]
        if panel == CORE:
            title, axis, name = str(source), "condition", str(condition)
        else:
            title, axis, name = f"{source} · {condition} over {panel}", str(panel), _text(value)
        metric = headline_metric(set(metrics))
        heads[title] = axis, f"{IN_WORDS[metric]} %, 95 % CI"
        success = percent(metrics[metric], *ESTIMATE)
        rows.setdefault(title, []).append((name, success, *means))
    tables = []
    for title, columns in heads.items():
        table = Table(title, (*columns, *HEADS), rows[title], terminal=range(2 + len(HEADS)))
        tables.append(table)
    return tables


def in_a_sentence(table: Table) -> str:
    """Return a phrase that sums up a sweep: success at both ends of what varies and at its best.

    `table` is one of those that `tables` returns. For crossed axes the phrase is about the worst
    and the best combination of values.
    """

    def success(row: Sequence[str]) -> float:
        return float(row[1].split()[0])

    best, (axis, head, *_) = max(table.rows, key=success), table.heads
    words = head.partition(" %")[0]
    rows = [table.rows[0], best, table.rows[-1]]
    if CROSS in axis:
        rows = [min(table.rows, key=success), best]
    parts = dict.fromkeys(f"{row[1]} % at {axis} {row[0]}" for row in rows)
    return f"{words} {'; '.join(parts)}"


def _text(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}"
