"""What lies in a picture of a scene and in a video:
roads, buildings, shade, vehicles, sight lines.
"""

from collections.abc import Collection, Iterable, Iterator
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.collections import LineCollection
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path

from harness.core.arrays import Floats
from harness.core.errors import printable
from harness.report.drawing.colours import BAD, HATCHED, INK, LIGHT, ROLES
from harness.report.drawing.geometry import VIEW_M, View, ground_of, north_up, shadows
from harness.world.scenario import Scenario
from harness.world.state import Building, VehicleState, WorldState

TEXT_PT = 6.5
FAR_M = 4 * VIEW_M  # from an eye to the end of what is in shadow
LOOKS: dict[str, dict[str, Any]] = {
    "ego": {"facecolor": ROLES["ego"], "edgecolor": INK, "linewidth": 1.0},
    "helper": {
        "facecolor": HATCHED[0],
        "edgecolor": HATCHED[1],
        "hatch": "//////",
        "linewidth": 0.8,
    },
    "danger": {"facecolor": ROLES["danger"], "edgecolor": INK, "hatch": "xxxxxx", "linewidth": 0.8},
    "other": {"facecolor": "white", "edgecolor": INK, "linewidth": 0.8},
}
HIDDEN: dict[str, Any] = {"facecolor": "none", "linestyle": (0, (2, 1.2))}


def roads(scenario: Scenario) -> Iterator[Artist]:
    """Yield matplotlib's artists of a scenario's roads: surface, lane marks and stop lines."""
    surface = ground_of(scenario)
    yield PathPatch(
        _closed(surface.outlines), facecolor=LIGHT["road"], edgecolor=LIGHT["kerb"], linewidth=0.8
    )
    yield LineCollection(surface.marks, colors="white", linewidths=1.0, linestyles=[(0, (5, 4))])
    yield LineCollection(surface.stops, colors="white", linewidths=2.0, capstyle="butt")


def shade(state: WorldState, eye: VehicleState) -> Artist:
    """Return matplotlib's artist of the area that walls and vehicles hide from the vehicle `eye`.

    `state` has where everything is.
    """
    return PathPatch(
        _closed(shadows(state, eye, FAR_M)), facecolor=LIGHT["shade"], edgecolor="none", alpha=0.22
    )


def walls(buildings: Iterable[Building]) -> Iterator[Artist]:
    """Yield matplotlib's artists of buildings; overlapping ones have one common outline."""
    outlines = _closed([north_up(building.corners()) for building in buildings])
    yield PathPatch(outlines, facecolor="none", edgecolor=LIGHT["wall"], linewidth=1.6)
    yield PathPatch(outlines, facecolor=LIGHT["building"], edgecolor="none")


def body(vehicle: VehicleState, look: str, hidden: bool) -> Artist:
    """Return the artist of a vehicle, in the style `LOOKS[look]`, that of its role.

    It is red if the vehicle has crashed, and dashed if it is hidden from the viewer (`hidden`).
    """
    style = dict(LOOKS[look])
    if hidden:
        edge = ROLES["danger"] if look == "danger" else style["edgecolor"]
        style = HIDDEN | {"edgecolor": edge, "linewidth": 1.1}
    elif vehicle.crashed:
        style["facecolor"] = BAD
    return Polygon(north_up(vehicle.corners()), **style)


def sight(state: WorldState, viewer: str, seen: Collection[str], **look: Any) -> Artist:
    """Return the artist of lines from a viewer to the vehicles whose ids are in `seen`.

    `state` has where vehicles are, and `viewer` is an id. `look` is passed to matplotlib's
    `LineCollection`; vehicles no longer there are left out.
    """
    at = {v.id: north_up(np.array([v.x_m, v.y_m])) for v in state.vehicles}
    there = [place for name, place in at.items() if name in seen and viewer in at]
    return LineCollection([np.array([at[viewer], place]) for place in there], **look)


def named(
    buildings: Iterable[Building], view: View, tall_m: float
) -> Iterator[tuple[str, float, float]]:
    """Yield name, x and y of each building's label, where the building is larger than `tall_m`.

    x and y are the north-west corner of its part in view, m to the east and to the north.
    """
    for building in buildings:
        corners = north_up(building.corners())
        low, high = np.array([corners.min(axis=0), corners.max(axis=0)]).clip(*view.edges)
        if np.all(high - low > tall_m):
            yield printable(building.id), float(low[0]), float(high[1])


def scale_m(view: View) -> int:
    """Return how long the scale bar of a picture of this view is, m: a round number."""
    return 20 if view.width_m > 100 else 10


def _closed(outlines: Iterable[Floats]) -> Path:
    paths = [Path(np.concatenate([o, o[:1]]), closed=True) for o in outlines]
    return Path.make_compound_path(*paths) if paths else Path(np.empty((0, 2)))
