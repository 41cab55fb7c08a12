"""What stands still in a picture of a scene: its roads and the buildings around them."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path

from harness.core.errors import printable
from harness.report.drawing.colours import INK
from harness.report.drawing.geometry import VIEW_M, ground_of, north_up
from harness.world.scenario import Scenario
from harness.world.state import Building

TEXT_PT = 6.5
ROAD, WALL, PAPER = "#C9CCD1", "#EAE4D6", "#F7F7F4"


def ground(
    figure: Figure,
    place: tuple[float, float, float, float],
    scenario: Scenario,
    buildings: Iterable[Building],
) -> Axes:
    """Axes at a place of the figure, with roads, lane marks, buildings, a scale and where north is."""
    axes = figure.add_axes(place)
    axes.set(xlim=(-VIEW_M, VIEW_M), ylim=(-VIEW_M, VIEW_M), xticks=[], yticks=[], facecolor=PAPER)
    for building in buildings:
        corners = north_up(building.corners())
        if np.abs(corners).min(axis=0).max() > VIEW_M:
            continue
        axes.add_patch(Polygon(corners, facecolor=WALL, edgecolor="#A79F8A", linewidth=0.8))
        x, y = np.sign(corners.mean(axis=0)) * (VIEW_M - 13.0)
        axes.text(x, y, printable(building.id), color="#877E68", size=TEXT_PT, ha="center", va="center")
    surface = ground_of(scenario)
    edges = Path.make_compound_path(*(Path(edge, closed=True) for edge in surface.outlines))
    axes.add_patch(PathPatch(edges, facecolor=ROAD, edgecolor="#8A8F98", linewidth=0.8))
    for mark in surface.marks:
        axes.plot(*mark.T, color="white", linewidth=1.0, dashes=(5, 4))
    for stop in surface.stops:
        axes.plot(*stop.T, color="white", linewidth=2.0, solid_capstyle="butt")
    axes.plot([-76, -56], [-76, -76], color=INK, linewidth=1.5, solid_capstyle="butt")
    axes.text(-66, -74.8, "20 m", size=TEXT_PT, ha="center", va="bottom")
    arrow = {"arrowstyle": "-|>", "color": INK}
    axes.annotate("N", (75, 76), (75, 67), size=8, ha="center", va="center", arrowprops=arrow)
    return axes
