"""`harness study sweep`: stored answers at every point of a grid."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.coordination.operating_point import OperatingPoint, named_point
from harness.core.errors import UserError, printable
from harness.core.figures import PERCENT
from harness.core.files import bytes_of, write_whole
from harness.core.versions import versions
from harness.report.library import picture
from harness.report.page import environment
from harness.studies import figures
from harness.studies.axes import AXES, CORE, Axis, Setting, Value, described, grid
from harness.studies.folder import refuse_other, write, write_manifest
from harness.studies.play import Source, joined, play
from harness.studies.stored import Stored

if TYPE_CHECKING:
    import pandas as pd

TEMPLATES = Path(__file__).parent / "templates"
COLUMNS = (
    ("trigger %", "trigger_rate", 100),
    ("msgs", "messages_per_episode", 1),
    ("latency ms", "latency_proxy_ms", 1),
    ("late %", "deadline_miss_rate", 100),
)


def settings(
    sources: Sequence[Stored], axis: Axis, values: Sequence[Value], conditions: Sequence[str]
) -> tuple[Setting, ...]:
    """The grid points of one axis, for each condition.

    Raises:
        UserError: no such condition, one without a channel or in which the axis changes nothing, or more
            vehicles than there are.
    """
    vehicles = min(source.vehicles for source in sources)
    if axis.field is None and max(map(float, values)) > vehicles:
        raise UserError(
            f"--grid: {max(map(float, values)):g} vehicles; the run's scenes have {vehicles} at most"
        )
    found = []
    for name in conditions:
        points = [axis.at(point_of(sources, name), value) for value in values]
        idle = [point.idle(axis.field) for point in points]
        if idle and all(idle):
            raise UserError(
                f"--over {axis.name}: it changes nothing in {printable(name)}: {idle[0]}; vary another "
                "setting or another --condition"
            )
        found += [
            Setting(name, point, vehicles if axis.field else int(value), axis.name, value)
            for point, value in zip(points, values, strict=True)
        ]
    return tuple(found)


def point_of(sources: Sequence[Stored], name: str) -> OperatingPoint:
    """The runs' operating point of that name, or one of the paper's, or a change of one of those."""
    theirs = {source.points[name] for source in sources if name in source.points}
    if len(theirs) > 1:
        raise UserError(f"--condition {printable(name)} is not the same in all runs; sweep them one by one")
    point = theirs.pop() if theirs else named_point(name)
    if point.profile is None:
        raise UserError(f"--condition {printable(name)} has no channel; nothing of it can be varied")
    return point


def usual(sources: Sequence[Stored], conditions: Sequence[str]) -> dict[str, tuple[Setting, ...]]:
    """The paper's panels for runs: their own conditions, swarm size under density-coupled loss, loss, tau."""
    vehicles = min(source.vehicles for source in sources)
    own = {name: point for source in sources for name, point in source.points.items()}
    sizes = settings(sources, AXES["size"], grid(AXES["size"], f"1:{vehicles}"), conditions)
    return {
        "core": tuple(Setting(name, point, vehicles) for name, point in own.items()),
        "size": tuple(replace(s, point=replace(s.point, density_coupled=True, loss=None)) for s in sizes),
        **{name: settings(sources, AXES[name], grid(AXES[name]), conditions) for name in ("loss", "tau")},
    }


def run_sweep(
    sources: Sequence[Source], panels: Mapping[str, Sequence[Setting]], seeds: Sequence[int], out: Path,
    progress: Callable[[int], None],
) -> "pd.DataFrame":  # fmt: skip
    """Play every source at every grid point; points and sources are paired by common random numbers.

    Writes `index.html`, `conditions` and `episodes` as CSV and JSON Lines, `sweep.json`, and the panels as
    SVG, PDF and PNG: `sweep` along the axes, and a source's operating points, where they are among the
    panels.

    Returns:
        The summary: a row a source, grid point and metric.

    Raises:
        UserError: the folder holds another sweep.
    """
    stated = {
        "sources": [source.manifest() for source in sources],
        "seeds": list(seeds),
        "panels": described(panels),
    }
    refuse_other(out, "sweep", stated)
    played = {
        panel: [
            play(source, panel, able, seeds, progress)
            for source in sources
            # The proxy has no model that could answer a fusion call, or blindly.
            if (able := [s for s in points if isinstance(source, Stored) or not _asks(s.point)])
        ]
        for panel, points in panels.items()
    }
    for source in sources:
        if isinstance(source, Stored):
            source.settle()
    whole = joined([part for parts in played.values() for part in parts])
    along = [whole.summary[whole.summary.panel == panel] for panel in panels if panel != CORE]
    drawn = {"sweep": figures.along(along)}
    for n, part in enumerate(played.get(CORE, ()), 1):
        drawn[f"operating-points-{n}"] = figures.composite_a(part.summary)
    write(out, drawn, {"conditions": whole.summary, "episodes": whole.episodes})
    asked = [source.manifest() for source in sources]  # anew: it says what was left out
    write_manifest(out, "sweep", {**stated, "sources": asked, "versions": versions()})
    found = tables(whole.summary)
    page = environment(TEMPLATES).get_template("sweep.html.j2").render(
        pictures={name: picture(bytes_of(out / f"{name}.svg", "picture")) for name in drawn},
        tables=found, sentences=[f"{name}: {in_a_sentence(rows)}." for name, rows in found.items()],
        seeds=seeds, axes=len(along),
        title=f"{', '.join(source.name for source in sources)} over {', '.join(panels)}",
    )  # fmt: skip
    write_whole(out / "index.html", page)
    return whole.summary


@dataclass(frozen=True)
class Row:
    """One grid point as text: where `at` on which `axis`, success with its interval, others by name."""

    axis: str
    at: str
    success: str
    others: dict[str, str]


def _asks(point: OperatingPoint) -> bool:
    return point.asks_again or point.asks_blind


def tables(summary: "pd.DataFrame") -> dict[str, list[Row]]:
    """A study's main figures, a table a source and curve, by its title."""
    found: dict[str, list[Row]] = {}
    places: dict[tuple[Any, ...], list[dict[Any, Any]]] = {}
    for row in summary.to_dict("records"):
        value = None if row["panel"] == CORE else row["value"]
        places.setdefault((row["source"], row["panel"], row["condition"], value), []).append(row)
    for (source, panel, condition, value), rows in places.items():
        title = str(source) if panel == CORE else f"{source} · {condition} over {panel}"
        # Over episodes, but where a seed has episodes of its own.
        of = {row["metric"]: row for row in sorted(rows, key=_over_episodes)}
        success = of["success_rate"]
        ends = (success[name] for name in ("mean", "ci_low", "ci_high"))
        others = {name: f"{scale * of[metric]['mean']:.1f}" for name, metric, scale in COLUMNS}
        at = str(condition if panel == CORE else value if isinstance(value, str) else f"{value:g}")
        axis = "condition" if panel == CORE else str(panel)
        found.setdefault(title, []).append(Row(axis, at, PERCENT.interval(*ends), others))
    return found


def in_a_sentence(rows: Sequence[Row]) -> str:
    """What came out along an axis: success at both ends, and where it is best if that lies between."""
    shown = {row.at: f"{row.success} % of episodes succeed at {row.axis} {row.at}" for row in rows}
    best = max(rows, key=lambda row: float(row.success.split()[0]))
    return "; ".join(dict.fromkeys([shown[rows[0].at], shown[best.at], shown[rows[-1].at]]))


def _over_episodes(row: dict[Any, Any]) -> bool:
    return bool(row["interval"] == "episodes")
