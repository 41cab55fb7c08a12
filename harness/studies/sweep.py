"""`harness study sweep`: a run's answers, scored again at every point of a grid."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.coordination.operating_point import OperatingPoint, named_point
from harness.coordination.parts import PLAIN
from harness.core.errors import UserError, printable
from harness.core.versions import versions
from harness.report.document import Table
from harness.runs.leading import IN_WORDS, leading
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
    usual_at,
)
from harness.studies.figures.axes import interval_of, lead_in
from harness.studies.play import PanelResult, Source, joined, play
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Study, percent, refuse_other

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

ESTIMATE = ("mean", "ci_low", "ci_high")
HEADS = {
    "trigger %": ("trigger_rate", 100), "msgs": ("messages_per_episode", 1),
    "latency ms": ("latency_proxy_ms", 1), "late %": ("deadline_miss_rate", 100),
}  # fmt: skip
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
    """Return the grid points of one axis, or of several that are crossed, for each condition.

    A grid of None has the axis's usual values that the condition allows.

    Raises:
        UserError: no such condition, one without a channel or in which an axis changes nothing,
            more vehicles than there are, or too many points.
    """
    runs = [source for source in sources if isinstance(source, ReplayedRun)]
    vehicles = min(run.vehicles for run in runs)
    name, result = CROSS.join(axis.name for axis in axes), list[Setting]()
    for condition in conditions:
        start = point_of(runs, condition)
        lists = [given or usual_at(axis, start) for axis, given in zip(axes, grids, strict=True)]
        for axis, some in zip(axes, lists, strict=True):
            if axis.worded and some in ((), (NONE,)):
                raise UserError(
                    f"--over {axis.name}: {printable(condition)} allows none of its usual values; "
                    "give others with --grid, or another --condition"
                )
            if axis.field is None and (most := max(map(float, some))) > vehicles:
                raise UserError(
                    f"--grid: {most:g} vehicles; the run's scenes have {vehicles} at most"
                )
        idle: list[dict[str, str | None]] = []
        for values in crossed(axes, lists):
            point, size = start, vehicles
            for axis, value in zip(axes, values, strict=True):
                point, size = axis.at(point, value), size if axis.field else int(value)
            idle.append({axis.name: point.idle(axis.field) for axis in axes})
            result.append(
                Setting(condition, point, size, name, values if len(axes) > 1 else values[0])
            )
        for axis in axes:
            if all(point[axis.name] for point in idle):
                raise UserError(
                    f"--over {axis.name}: it changes nothing in {printable(condition)}: "
                    f"{idle[0][axis.name]}; vary another setting or another --condition"
                )
    return tuple(result)


def point_of(runs: Sequence[ReplayedRun], name: str) -> OperatingPoint:
    """Return the runs' operating point of that name, or one of the paper's,
    or a change of one of those.
    """
    theirs = {run.points[name] for run in runs if name in run.points}
    if len(theirs) > 1:
        raise UserError(
            f"--condition {printable(name)} is not the same in all runs; sweep them one by one"
        )
    point = theirs.pop() if theirs else named_point(name)
    if point.radio.profile is None:
        raise UserError(
            f"--condition {printable(name)} has no channel; nothing of it can be varied"
        )
    return point


def usual(runs: Sequence[ReplayedRun], conditions: Sequence[str]) -> dict[str, tuple[Setting, ...]]:
    """Return the paper's panels: the runs' conditions, size under density-coupled loss,
    loss and tau.
    """
    vehicles = min(run.vehicles for run in runs)
    own = {name: point for run in runs for name, point in run.points.items()}
    grids = {
        "size": grid(AXES["size"], f"1:{vehicles}"),
        "loss": grid(AXES["loss"]),
        "tau": grid(AXES["tau"]),
    }
    panels = {
        name: settings(runs, [AXES[name]], [values], conditions) for name, values in grids.items()
    }
    crowded = (
        replace(s, point=s.point.changed(density_coupled=True, loss=None)) for s in panels["size"]
    )
    core = tuple(Setting(name, point, vehicles) for name, point in own.items())
    return {CORE: core, **panels, "size": tuple(crowded)}


def panels_over(
    runs: Sequence[ReplayedRun],
    over: Sequence[str],
    grids: Sequence[str],
    conditions: Sequence[str],
    apart: bool = False,
) -> dict[str, tuple[Setting, ...]]:
    """Return the panels of a sweep by name.

    Args:
        runs: whose answers are scored.
        over: names of axes; without any, the paper's panels are returned.
        grids: the values of each, in the same order;
            the usual ones that a condition allows without any.
        conditions: names of the operating points that are varied.
        apart: whether each axis has a panel of its own, instead of all in one, crossed.

    Raises:
        UserError: as `settings`; or there are more grids than axes.
    """
    axes = [axis_of(name) for name in dict.fromkeys(over)]
    if len(grids) > len(axes):
        raise UserError(
            f"--grid: {len(grids)} given for {len(axes)} of --over; give one for each --over, in "
            "the same order"
        )
    values = [None if text is None else grid(axis, text) for axis, text in zip_longest(axes, grids)]
    parts = [slice(n, n + 1) for n in range(len(axes))] if apart else [slice(None)]
    panels = {
        CROSS.join(axis.name for axis in axes[part]): settings(
            runs, axes[part], values[part], conditions
        )
        for part in parts
        if axes
    }
    return panels or usual(runs, conditions)


def folder_of(run: Path, panels: Iterable[str]) -> Path:
    """Return where a run's sweep lies by default."""
    return run / f"sweep-{'-'.join(panels).replace(CROSS, '-')}"


def run_sweep(
    sources: Sequence[Source],
    panels: Mapping[str, Sequence[Setting]],
    seeds: Sequence[int],
    out: Path,
    progress: Callable[[int], None],
) -> Study:
    """Play every source at every grid point;
    points and sources are paired by common random numbers.

    Raises:
        UserError: the folder holds another sweep.
    """
    stated = {
        "sources": [s.manifest() for s in sources],
        "seeds": list(seeds),
        "panels": described(panels),
    }
    refuse_other(out, "sweep", stated)
    runs = [source for source in sources if isinstance(source, ReplayedRun)]

    def able(source: Source, point: OperatingPoint) -> bool:
        # The proxy has no model that could answer a fusion call, or another question.
        return source in runs or not (point.has_fusion_call or point.question != PLAIN)

    results = {
        panel: [
            play(source, panel, those, seeds, progress)
            for source in sources
            if (those := [setting for setting in points if able(source, setting.point)])
        ]
        for panel, points in panels.items()
    }
    for run in runs:
        run.settle()
    whole = joined([part for parts in results.values() for part in parts])
    summary = whole.summary
    shown = tables(summary)
    return Study(
        "sweep",
        f"{', '.join(source.name for source in sources)} over {', '.join(panels)}",
        [f"{table.title}: {in_a_sentence(table)}." for table in shown],
        [f"{counts(sources, seeds)}. {PAIRED}"],
        shown,
        {"conditions": summary, "episodes": whole.episodes},
        # Anew, since sources state what was left out.
        {**stated, "sources": [s.manifest() for s in sources], "versions": versions()},
        summary,
        lambda: _figures(summary, results),
        [caveat for run in runs for caveat in run.caveats],
    )


def _figures(
    summary: "pd.DataFrame", results: Mapping[str, Sequence[PanelResult]]
) -> "dict[str, Figure]":
    """Draw lines of the axes that are varied alone, bars of the conditions,
    and maps of crossed axes.
    """
    from harness.studies.figures.bars import operating_points
    from harness.studies.figures.lines import along

    lines = [
        summary[summary.panel == panel] for panel in results if panel != CORE and CROSS not in panel
    ]
    figures = {"sweep": along(lines)} if lines else {}
    figures |= {
        f"operating-points-{n}": operating_points(part.summary)
        for n, part in enumerate(results.get(CORE, ()), 1)
    }
    maps = [
        (part.summary, condition)
        for panel, parts in results.items()
        if CROSS in panel
        for part in parts
        for condition in dict.fromkeys(part.summary.condition)
    ]
    return figures | {
        "sweep" if n == 0 else f"sweep-{n + 1}": _map(part[part.condition == condition])
        for n, (part, condition) in enumerate(maps)
    }


def counts(sources: Sequence[Source], seeds: Sequence[int]) -> str:
    """Return how many episodes and seeds each source has, in words."""
    of_sources = (
        f"{source.name}: n = {source.episodes} episodes × {len(seeds)} seeds"
        + (" of their own" if not source.same_episodes else "")
        for source in sources
    )
    return f"{'; '.join(of_sources)} (channel seeds {', '.join(map(str, seeds))})"


def _map(part: "pd.DataFrame") -> "Figure":
    """Draw success of crossed axes: the first down, the second across,
    a panel for each of the others.
    """
    from harness.studies.figures.heat_map import heat_map

    down, across, *panel_axes = part.variable.iloc[0].split(CROSS)
    rows = part[(part.metric == lead_in(part)) & (part.interval == interval_of(part))]
    groups = rows.groupby(panel_axes, sort=False) if panel_axes else [((), rows)]
    panels = {}
    for values, group in groups:
        names = [f"{name} {value}" for name, value in zip(panel_axes, values, strict=True)]
        wide = group.pivot(index=down, columns=across, values="mean")
        wide = wide.reindex(index=group[down].unique(), columns=group[across].unique())
        panels[", ".join([str(group.condition.iloc[0]), *names])] = 100 * wide.to_numpy(dtype=float)
    return heat_map(panels, [*map(_text, wide.index)], [*map(_text, wide.columns)], down, across)


def tables(summary: "pd.DataFrame") -> list[Table]:
    """Return a study's main figures, a table a source and curve."""
    heads, rows = dict[str, tuple[str, str]](), dict[str, list[Sequence[str]]]()
    places = ["source", "panel", "condition", "value"]
    known = summary.assign(value=summary.value.where(summary.panel != CORE, None))
    for (source, panel, condition, value), group in known.groupby(places, sort=False, dropna=False):
        # Over episodes, but where a seed has episodes of its own.
        metrics = group.sort_values("interval", ascending=False, kind="stable").set_index("metric")
        metrics = metrics[~metrics.index.duplicated(keep="last")]
        means = (f"{scale * metrics['mean'][name]:.1f}" for name, scale in HEADS.values())
        core = panel == CORE
        title = str(source) if core else f"{source} · {condition} over {panel}"
        lead = leading(set(metrics.index))
        heads[title] = "condition" if core else str(panel), f"{IN_WORDS[lead]} %, 95 % CI"
        cells = (
            str(condition) if core else _text(value),
            percent(metrics.loc[lead], *ESTIMATE),
            *means,
        )
        rows.setdefault(title, []).append(cells)
    return [
        Table(title, (*head, *HEADS), rows[title], terminal=range(2 + len(HEADS)))
        for title, head in heads.items()
    ]


def in_a_sentence(table: Table) -> str:
    """Say what leads at the ends of an axis and where it is best;
    of crossed axes where worst and best.
    """

    def success(row: Sequence[str]) -> float:
        return float(row[1].split()[0])

    best, (axis, head, *_) = max(table.rows, key=success), table.heads
    words = head.partition(" %")[0]
    around = (
        [min(table.rows, key=success), best]
        if CROSS in axis
        else [table.rows[0], best, table.rows[-1]]
    )
    parts = dict.fromkeys(f"{row[1]} % at {axis} {row[0]}" for row in around)
    return f"{words} {'; '.join(parts)}"


def _text(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}"
