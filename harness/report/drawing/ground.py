"""What stands still in a picture of a scene: its roads and the buildings around them."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from harness.core.errors import printable
from harness.report.drawing.pictures import INK
from harness.world.scenario import Scenario
from harness.world.state import Building

Array = NDArray[np.float64]

BEYOND_M = 5.0  # roads are drawn so far beyond the picture's edge
ROAD, WALL, PAPER = "#C9CCD1", "#EAE4D6", "#F7F7F4"


def north_up(points: Array) -> Array:
    """Points (..., 2) m of `harness.world.road`'s frame, with y to the north."""
    return points * [1.0, -1.0]


def ground(
    axes: Axes, scenario: Scenario, buildings: Iterable[Building], view_m: float, text_pt: float
) -> None:
    """Draw roads, lane marks, buildings, a scale and where north is, within ±view_m."""
    axes.set_facecolor(PAPER)
    surface = scenario.road().ground(view_m + BEYOND_M)
    for building in buildings:
        corners = north_up(building.corners())
        axes.add_patch(Polygon(corners, facecolor=WALL, edgecolor="#A79F8A", linewidth=0.8))
        x, y = np.sign(corners.mean(axis=0)) * (view_m - 13.0)
        axes.text(x, y, printable(building.id), color="#877E68", size=text_pt, ha="center", va="center")
    axes.add_patch(Polygon(surface.outline, facecolor=ROAD, edgecolor="#8A8F98", linewidth=0.8))
    for mark in surface.marks:
        axes.plot(*mark.T, color="white", linewidth=1.0, dashes=(5, 4))
    for stop in surface.stops:
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
