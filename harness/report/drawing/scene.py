"""A scene from above, north up: who is where, and what one vehicle sees of it.

It shows where it is decided (`view`); who is beyond that is named at its edge.
"""

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from harness.core.errors import printable
from harness.dataset.load import Scene
from harness.report.drawing import artists
from harness.report.drawing.artists import HIDDEN, LOOKS, TEXT_PT
from harness.report.drawing.colours import BUILDING_NAME, GREY, INK, LIGHT, ROLES
from harness.report.drawing.geometry import (
    View,
    conflict_points,
    north_up,
    shape_of,
    spots,
    view_of,
)
from harness.report.drawing.labels import Labels
from harness.report.drawing.pictures import Format, save, styled
from harness.world import scenarios
from harness.world.scene_graph import EgoArrival
from harness.world.state import VehicleState

SIDE_IN = 5.8  # how wide the picture is
RING_M = 4.6  # from the middle of the dangerous vehicle to the corners of its diamond

DIAMOND: dict[str, Any] = {
    "marker": "D",
    "markerfacecolor": "none",
    "markeredgecolor": ROLES["danger"],
    "markeredgewidth": 1.4,
}
CROSS: dict[str, Any] = {"marker": "X", "color": INK, "markeredgecolor": INK, "markersize": 7}
NAMES = {"ego": "ego", "helper": "helper", "danger": "dangerous vehicle", "other": "other vehicle"}


@styled
def draw(scene: Scene, out: Path | BinaryIO, format: Format, viewer: str | None = None) -> None:
    """Draw a scene from above and what one of its viewers sees.

    Args:
        scene: the scene, one decision point.
        out: the file to replace, or a binary stream.
        format: `svg`, `pdf` or `png`.
        viewer: id of the ego or of a helper; None for the ego.

    Raises:
        UserError: the vehicle is no viewer of this scene, or the format is unknown.
    """
    viewer = scene.viewer(viewer)
    graph = scene.graphs[viewer]
    seen = {*graph.seen, viewer}

    state = scene.state
    scenario = scene.seat or scenarios.get(state.scenario).at(state.episode_seed)
    road, shape = scenario.road(), shape_of(scenario)
    held = spots(state, road.zone_m, graph, (scene.record.danger.vehicle, *scene.viewers))
    view = view_of(held, shape)
    figure = Figure(figsize=(SIDE_IN + 0.2, SIDE_IN * shape + 1.12))
    height = figure.get_figheight()
    place = 0.1 / (SIDE_IN + 0.2), 0.5 / height, SIDE_IN / (SIDE_IN + 0.2), SIDE_IN * shape / height
    low, high = view.edges
    axes = figure.add_axes(place)
    axes.set(
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
        xticks=[],
        yticks=[],
        facecolor=LIGHT["ground"],
    )
    axes.set_autoscale_on(False)
    # All of it lies under what is plotted, whatever its kind.
    hidden = artists.shade(state, state.vehicle(viewer))
    for order, artist in enumerate(
        [*artists.roads(scenario), hidden, *artists.walls(state.buildings)]
    ):
        artist.set_zorder(0.1 * (1 + order))
        axes.add_artist(artist)
    labels = Labels(axes, SIDE_IN * 72 / view.width_m, TEXT_PT, view)
    for box in road.ground_within(float(np.abs(view.edges).max())).boxes:
        labels.discourage(box)
    lines = artists.sight(
        state, viewer, seen - {viewer}, colors=LIGHT["kerb"], linewidths=0.7, alpha=0.75
    )
    axes.add_artist(lines)
    for vehicle in state.vehicles:
        _vehicle(axes, labels, view, vehicle, _look(scene, vehicle), hidden=vehicle.id not in seen)
    _conflicts(axes, labels, view, scene, viewer)
    _signs(axes, labels, view, scene)
    labels.place()
    _words(figure, scene, viewer, seen)
    save(figure, out, format)


def _look(scene: Scene, vehicle: VehicleState) -> str:
    return "danger" if vehicle.id == scene.record.danger.vehicle else vehicle.part


def _vehicle(
    axes: Axes, labels: Labels, view: View, vehicle: VehicleState, look: str, hidden: bool
) -> None:
    marks = [f"{vehicle.speed_mps:.0f} m/s"]
    marks += [look] if look != "other" else []
    marks += ["hidden"] if hidden else []
    marks += ["crashed"] if vehicle.crashed else []
    text = f"{printable(vehicle.id)} {vehicle.kind}\n{', '.join(marks)}"
    centre, (low, high) = north_up(np.array([vehicle.x_m, vehicle.y_m])), view.edges
    unit, half = view.scale, (high - low) / 2
    away = centre - (low + half)
    beyond_m = float((np.abs(away) - half).max()) + 3.0 * unit
    if beyond_m > 0:
        edge = centre.clip(low + 1.5 * unit, high - 1.5 * unit)
        east, north = away / half
        horizontal, vertical = "<" if east < 0 else ">", "v" if north < 0 else "^"
        marker = horizontal if abs(east) > abs(north) else vertical
        axes.plot(
            *edge, marker=marker, color=ROLES["danger"] if look == "danger" else GREY, markersize=5
        )
        labels.add(edge, 1.5 * unit, f"{text}\n{beyond_m:.0f} m farther", bold=look == "danger")
        return
    corners = north_up(vehicle.corners())
    axes.add_artist(artists.body(vehicle, look, hidden)).set_zorder(3)
    along = north_up(np.array([np.cos(vehicle.heading_rad), np.sin(vehicle.heading_rad)]))
    nose = centre + along * vehicle.length_m / 2
    wings = corners[:2] - along * min(1.2, vehicle.length_m / 4)
    colour = "white" if look == "ego" and not hidden else INK
    axes.plot(*np.vstack([wings[0], nose, wings[1]]).T, color=colour, linewidth=0.8, zorder=3)
    if vehicle.speed_mps > 0.5:
        arrow = {
            "arrowstyle": "-|>,head_width=0.15,head_length=0.3",
            "color": INK,
            "linewidth": 0.8,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        tip = nose + along * vehicle.speed_mps
        way = axes.annotate(
            "", (tip[0], tip[1]), (nose[0], nose[1]), arrowprops=arrow, annotation_clip=False
        )
        if way.arrow_patch:
            way.arrow_patch.set_clip_path(axes.patch)
        labels.block(np.array([nose, tip]))
    radius_m = vehicle.length_m / 2
    if look == "danger":
        ring = centre + RING_M * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
        axes.add_patch(
            Polygon(ring, facecolor="none", edgecolor=ROLES["danger"], linewidth=1.4, zorder=3)
        )
        radius_m = max(radius_m, RING_M)
        labels.block(ring)
    labels.block(corners)
    labels.add(centre, radius_m, text, bold=look in ("ego", "danger"))


def _conflicts(axes: Axes, labels: Labels, view: View, scene: Scene, viewer: str) -> None:
    ego = printable(scene.state.ego.id)
    conflicts, points = conflict_points(scene.state, scene.graphs[viewer])
    for conflict, point in zip(conflicts, points, strict=True):
        if not view.holds(point):
            continue
        axes.plot(*point, markeredgewidth=0.7, zorder=4, **CROSS)
        labels.block(point + 1.5 * view.scale * np.array([[-1, -1], [1, 1]]))
        text = f"{ego} {_when(conflict.ego)}, {printable(conflict.vehicle)} {_when(conflict.other)}"
        # Labels of two points go apart, or their lines would cross.
        labels.add(point, 2.0, text, colour=INK, toward=point - points.mean(axis=0))


def _signs(axes: Axes, labels: Labels, view: View, scene: Scene) -> None:
    """The scale and where north is, each in a corner that no vehicle is in,
    and the names of buildings.
    """
    (west, south), (east, north) = view.edges
    unit = view.scale
    long_m, pad, wide, high, half = artists.scale_m(view), 4 * unit, 24 * unit, 6 * unit, 3 * unit
    low, up, left, right = south + pad, north - pad - high, west + pad, east - pad - wide
    box = labels.free(
        [np.array([[x, y], [x + wide, y + high]]) for x in (left, right) for y in (low, up)]
    )
    start, foot = box[0]
    bar = [start, start + long_m]
    axes.plot(bar, [foot, foot], color=INK, linewidth=1.5, solid_capstyle="butt", zorder=5)
    axes.text(
        start + long_m / 2,
        foot + unit,
        f"{long_m} m",
        size=TEXT_PT,
        ha="center",
        va="bottom",
        zorder=5,
    )
    tall = 13 * unit
    low, up, left, right = south + half, north - half - tall, west + half, east - half - 2 * half
    box = labels.free(
        [
            np.array([[x, y], [x + 2 * half, y + tall]])
            for x, y in ((right, up), (left, up), (right, low))
        ]
    )
    x, (y, top) = box[:, 0].mean(), box[:, 1]
    arrow = {"arrowstyle": "-|>", "color": INK}
    axes.annotate(
        "N", (x, top), (x, y + 2 * unit), size=8, ha="center", va="center", arrowprops=arrow
    )
    for name, left, up in artists.named(scene.state.buildings, view, TEXT_PT / labels.pt_per_m):
        axes.text(
            left + unit, up - unit, name, color=BUILDING_NAME, size=TEXT_PT, ha="left", va="top"
        )


def _when(arrival: EgoArrival) -> str:
    if arrival.arc_m < 0:
        return "is past it"
    return "stands" if arrival.time_s is None else f"in {arrival.time_s:.1f} s"


def _words(figure: Figure, scene: Scene, viewer: str, seen: set[str]) -> None:
    state, graph = scene.state, scene.graphs[viewer]
    left, height = 0.1 / figure.get_figwidth(), figure.get_figheight()
    title = (
        f"Scene {printable(scene.id, 40)} at {state.time_s:.1f} s, ego {state.ego.speed_mps:.1f} "
        "m/s"
    )
    figure.text(left, 1 - 0.24 / height, title, size=10, weight="bold")
    neighbours = [v.id for v in state.vehicles if v.id != viewer]
    parts = [
        f"{viewer} ({graph.role}) sees {_list(v for v in neighbours if v in seen)}",
        f"hidden: {_list(v for v in neighbours if v not in seen)}",
        f"occluded sectors: {_list(graph.occluded)}",
    ]
    figure.text(left, 1 - 0.45 / height, printable("; ".join(parts), 110), size=7.5)

    handles: list[Any] = [Patch(**LOOKS[look], label=NAMES[look]) for look in ("ego", "helper")]
    handles += [
        Line2D([], [], linestyle="none", markersize=7, label=NAMES["danger"], **DIAMOND),
        Patch(**LOOKS["other"], label=NAMES["other"]),
        Patch(**HIDDEN, edgecolor=INK, label=f"hidden from {printable(viewer)}"),
        Line2D([], [], color=LIGHT["kerb"], linewidth=0.9, label="sight line"),
        Line2D([], [], linestyle="none", label="conflict point, time to it", **CROSS),
        Line2D([], [], color=INK, marker=">", markersize=3, linewidth=0.8, label="way in 1 s"),
    ]
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=4,
        frameon=False,
        fontsize=7.5,
        borderpad=0.2,
        columnspacing=1.6,
    )


def _list(names: Any) -> str:
    return ", ".join(names) or "none"
