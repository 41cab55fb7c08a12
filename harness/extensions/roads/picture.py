"""Scenes of a recording from above: lanes, buildings, tracks, and the moments chosen there."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from harness.core.arrays import Floats
from harness.core.errors import printable
from harness.core.figures import amount
from harness.extensions.roads.scene import Scene, Track
from harness.extensions.roads.tables import Moment, Recording
from harness.report.drawing.colours import COLOURS, INK, LIGHT, ROLES
from harness.report.drawing.pictures import Format, save, styled
from harness.world.state import rectangle

MOST_PANELS = 4  # scenes that are drawn: those with the most moments
SIDE_IN, BESIDE_IN, BETWEEN_IN, WORDS_IN = 5.8, 0.7, 0.5, 0.8  # of a panel, and around them
FLATTEST, TALLEST = 0.2, 1.2  # height of a panel by its width
MARGIN_M = 10.0
ROOM = 0.02  # of the reach of the lanes, around them
KIND_COLOURS = dict(
    zip(
        ("car", "van", "truck", "bicycle", "motorcycle", "pedestrian"),
        (COLOURS[0], COLOURS[5], COLOURS[4], COLOURS[2], COLOURS[1], INK),
        strict=True,
    )
)
DOT_M = 3.0  # by which two points of a drawn track are apart at least


@styled
def draw(recording: Recording, out: Path) -> None:
    """Draw a recording's scenes, up to four of them, to a file: .svg, .pdf or .png."""
    moments = Counter(moment.scene for moment in recording.moments)
    order = sorted(recording.scenes_stated, key=lambda facts: -moments[facts.name])
    scenes = [recording.scene(facts.name) for facts in order[:MOST_PANELS]]
    boxes = [_box(scene) for scene in scenes]
    shapes = [float(np.clip(high / wide, FLATTEST, TALLEST)) for _, (wide, high) in boxes]
    wide_in = SIDE_IN + BESIDE_IN
    tall_in = sum(SIDE_IN * shape + BETWEEN_IN for shape in shapes) + WORDS_IN
    figure = Figure(figsize=(wide_in, tall_in))
    top_in = tall_in - WORDS_IN / 2
    for scene, (middle, size), shape in zip(scenes, boxes, shapes, strict=True):
        high_in = SIDE_IN * shape
        bottom_in = top_in - BETWEEN_IN / 2 - high_in
        place = (0.55 / wide_in, bottom_in / tall_in, SIDE_IN / wide_in, high_in / tall_in)
        axes = figure.add_axes(place)
        half = max(size[0], size[1] / shape) / 2 * np.array([1.0, shape])
        low, high = middle - half, middle + half
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), facecolor=LIGHT["ground"])
        axes.tick_params(labelsize=6)
        axes.set_xlabel("m to the east", size=6, labelpad=1)
        axes.set_ylabel("m to the north", size=6, labelpad=1)
        _scene(axes, scene, [each for each in recording.moments if each.scene == scene.name])
        top_in = bottom_in - BETWEEN_IN / 2
    figure.text(0.02, 1 - 0.25 / tall_in, _title(recording, len(scenes)), size=9, weight="bold")
    kinds = {track.kind for scene in scenes for track in scene.tracks.values()}
    _legend(figure, kinds, bool(recording.moments))
    save(figure, out, _format(out))


def _format(out: Path) -> Format:
    endings: dict[str, Format] = {".svg": "svg", ".pdf": "pdf"}
    return endings.get(out.suffix, "png")


def _title(recording: Recording, drawn: int) -> str:
    scenes = amount(len(recording.scenes_stated), "scene")
    part = f"{drawn} of {scenes}" if drawn < len(recording.scenes_stated) else scenes
    return f"{printable(recording.name, 50)}: {part}, {amount(len(recording.moments), 'moment')}"


def _box(scene: Scene) -> tuple[Floats, Floats]:
    """Return the middle of a scene's lanes and how far they reach, (2,) m each, with a margin."""
    points = np.concatenate([lane.points for lane in scene.lanes.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    room = MARGIN_M + ROOM * (high - low).max()
    return (low + high) / 2, np.asarray(high - low + 2 * room)


def _scene(axes: Axes, scene: Scene, moments: Sequence[Moment]) -> None:
    lanes = [_strip(lane.points, lane.width_m) for lane in scene.lanes.values()]
    _polygons(axes, lanes, 1.0, facecolor=LIGHT["road"], edgecolor=LIGHT["kerb"], linewidth=0.3)
    houses = [house.outline for house in scene.houses]
    _polygons(
        axes, houses, 1.5, facecolor=LIGHT["building"], edgecolor=LIGHT["wall"], linewidth=0.8
    )
    for kind, colour in KIND_COLOURS.items():
        tracks = [track for track in scene.tracks.values() if track.kind == kind]
        lines = [_thin(track) for track in tracks if not track.still]
        strength = float(np.clip(3 / max(len(lines), 1) ** 0.5, 0.15, 0.8))
        way = LineCollection(lines, colors=colour, linewidths=0.6, alpha=strength, zorder=2)
        axes.add_collection(way, autolim=False)
        still = [_body(track) for track in tracks if track.still]
        _polygons(axes, still, 2.2, facecolor=colour, edgecolor=INK, linewidth=0.3)
    _moments(axes, scene, moments)
    text = f"{printable(scene.name, 60)}: {amount(len(scene.tracks), 'road user')}, "
    text += f"{scene.begin_s:g} to {scene.end_s:g} s, {amount(len(moments), 'moment')}"
    axes.set_title(text, size=7.5, loc="left", pad=3)


def _polygons(axes: Axes, outlines: Sequence[Floats], order: float, **look: Any) -> None:
    axes.add_collection(PolyCollection(outlines, zorder=order, **look), autolim=False)


def _strip(points: Floats, width_m: float) -> Floats:
    """Return the outline of a lane, (2n, 2) m, given its centre line."""
    along = np.gradient(points, axis=0)
    length = np.hypot(*along.T).clip(1e-9)
    aside = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None] * width_m / 2
    return np.concatenate([points + aside, (points - aside)[::-1]])


def _thin(track: Track) -> Floats:
    """Return the points of a track that are not too close to draw, (n, 2) m."""
    points = track.poses[:, :2]
    steps = np.hypot(*np.diff(points, axis=0).T)
    dots = np.floor(np.concatenate([[0.0], np.cumsum(steps)]) / DOT_M)
    keep = np.append(np.diff(dots) > 0, True)
    keep[0] = True
    return np.asarray(points[keep])


def _body(track: Track) -> Floats:
    x_m, y_m, heading_rad, _ = track.poses[0]
    return rectangle(x_m, y_m, heading_rad, track.length_m, track.width_m)


def _moments(axes: Axes, scene: Scene, moments: Iterable[Moment]) -> None:
    """Mark where egos begin, which way they look, and who is hidden from them in conflict."""
    for moment in moments:
        ego = scene.tracks.get(moment.vehicle)
        pose = ego.at(moment.time_s) if ego else None
        if pose is None:
            continue
        other = scene.tracks.get(moment.hidden or "")
        there = other.at(moment.time_s) if other else None
        if there is not None:
            axes.plot(*np.stack([pose[:2], there[:2]]).T, color=ROLES["danger"], linewidth=0.5)
            axes.plot(*there[:2], **DIAMOND)
        turned = (3, 0, np.degrees(pose[2]) - 90)
        axes.plot(*pose[:2], marker=turned, markersize=5, **MARK, color=ROLES["ego"])


MARK: dict[str, Any] = {"markeredgecolor": INK, "markeredgewidth": 0.4, "zorder": 4}
# Hollow, since who is hidden from one ego may be another ego.
DIAMOND: dict[str, Any] = {
    "marker": "D",
    "markersize": 6,
    "markerfacecolor": "none",
    "markeredgecolor": ROLES["danger"],
    "markeredgewidth": 1.0,
    "zorder": 5,
}


def _legend(figure: Figure, kinds: set[str], with_moments: bool) -> None:
    handles: list[Any] = [Patch(facecolor=LIGHT["road"], edgecolor=LIGHT["kerb"], label="lane")]
    for kind, colour in KIND_COLOURS.items():
        if kind in kinds:
            handles.append(Line2D([], [], color=colour, linewidth=1.2, label=kind))
    alone: dict[str, Any] = {"linestyle": "none"}
    way: dict[str, Any] = {"marker": "^", "color": ROLES["ego"], **MARK, **alone}
    ego = Line2D([], [], label="ego at its moment", **way)
    hidden = Line2D([], [], label="hidden, in conflict", **DIAMOND, **alone)
    figure.legend(
        handles=[*handles, ego, hidden] if with_moments else handles,
        loc="lower center",
        ncols=5,
        frameon=False,
        fontsize=7,
        columnspacing=1.4,
    )
