"""What stands still in a picture of a scene: the junction's roads and the buildings around it."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from harness.core.errors import printable
from harness.report.drawing.pictures import INK
from harness.world.road import JUNCTION_M, LANE_WIDTH_M
from harness.world.state import Building

Array = NDArray[np.float64]

ROAD, WALL, PAPER = "#C9CCD1", "#EAE4D6", "#F7F7F4"


def north_up(points: Array) -> Array:
    """Points (..., 2) m of `harness.world.road`'s frame, with y to the north."""
    return points * [1.0, -1.0]


def ground(axes: Axes, buildings: Iterable[Building], view_m: float, text_pt: float) -> None:
    """Draw roads, lane marks, buildings, a scale and where north is, within ±view_m."""
    axes.set_facecolor(PAPER)
    far = view_m + 5.0
    for building in buildings:
        corners = north_up(building.corners())
        axes.add_patch(Polygon(corners, facecolor=WALL, edgecolor="#A79F8A", linewidth=0.8))
        x, y = np.sign(corners.mean(axis=0)) * (view_m - 13.0)
        axes.text(x, y, printable(building.id), color="#877E68", size=text_pt, ha="center", va="center")
    outline, marks, stops = roads(far)
    axes.add_patch(Polygon(outline, facecolor=ROAD, edgecolor="#8A8F98", linewidth=0.8))
    for mark, stop in zip(marks, stops, strict=True):
        axes.plot(*mark.T, color="white", linewidth=1.0, dashes=(5, 4))
        axes.plot(*stop.T, color="white", linewidth=2.0, solid_capstyle="butt")
    axes.plot([-76, -56], [-76, -76], color=INK, linewidth=1.5, solid_capstyle="butt")
    axes.text(-66, -74.8, "20 m", size=text_pt, ha="center", va="bottom")
    axes.annotate(
        "N",
        (75, 76),
        (75, 67),
        size=8,
        ha="center",
        va="center",
        arrowprops={"arrowstyle": "-|>", "color": INK},
    )


def roads(far: float) -> tuple[Array, list[Array], list[Array]]:
    """Outline of the roads up to `far` m, centre line and stop line of each arm; (n, 2) m, y to the north."""
    half = LANE_WIDTH_M
    # One corner of the junction, from the north arm to the east arm; a quarter turn gives the next.
    angle = np.linspace(np.pi, 1.5 * np.pi, 9)
    fillet = JUNCTION_M + (JUNCTION_M - half) * np.column_stack([np.cos(angle), np.sin(angle)])
    corner = np.vstack([[half, far], fillet, [far, half]])
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])  # clockwise, for row vectors
    turns = [np.linalg.matrix_power(quarter, n) for n in range(4)]
    outline = np.vstack([corner @ turn for turn in turns])
    marks = [np.array([[0.0, JUNCTION_M], [0.0, far]]) @ turn for turn in turns]
    stops = [np.array([[0.0, JUNCTION_M], [-half, JUNCTION_M]]) @ turn for turn in turns]
    return outline, marks, stops
