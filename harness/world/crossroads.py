"""highway-env's four-way intersection as a road, for an ego that goes straight over it.

An ego from the south goes north, so for it "left" is the west arm, "right" the east arm and
"oncoming" the north arm. For one from another arm these names are turned; lanes and coordinates
stay. Lane width and radii are those of highway-env 1.12's `IntersectionEnv`; a test holds them
against its road network.
"""

from functools import cache
from typing import Any, Literal

import numpy as np

from harness.core.arrays import Floats
from harness.world.road import STEP_M, Ground, Lane, Path, PathKey, Road, crossings

LANE_WIDTH_M = 4.0
JUNCTION_M = 11.0  # from the centre to where approach lanes end
ARM_M = 100.0  # length of an approach or exit lane
LEFT_TURN_RADIUS_M, RIGHT_TURN_RADIUS_M = 13.0, 9.0
# stretch of the approach lane, from the conflict point, that is looked at
SECTOR_REACH_M = (8.0, 50.0)

# South, west, north, east: highway-env's nodes o0..o3. An arm is a number in this order.
APPROACHES = ("own", "left", "oncoming", "right")
SECTORS = ("left", "right", "oncoming")  # where danger can come from
ROUTES = ("straight", "left")
EXITS = ("exit-own", "exit-left", "exit-ahead", "exit-right")
# Right of way of highway-env's intersection: the road from west to east first, straight before
# left.
PRIORITY = {"straight": (1, 3), "left": (0, 2)}


@cache
def road(arm: int = 0, form: Literal[1, 2] = 1) -> Road:
    """Return the four-way intersection as a `Road`, for an ego from an arm that goes straight.

    Arms are numbered 0 to 3: south, west, north, east. Under `form` 1 scene graphs, what a vehicle
    knows of a scene, list only paths that cross the ego's; under 2 also who is in the ego's lane.
    The conflict zone is the centroid of three conflict points: with straight traffic from the left
    and the right, and with oncoming traffic that turns left.
    """
    ways, ego = paths(arm), ("own", "straight")
    # A path that merges into the ego's lane brings no danger here.
    meetings = {key: at for key, at in crossings(ways, ego).items() if at.kind == "crossing"}
    points = [
        meetings[key] for key in (("left", "straight"), ("right", "straight"), ("oncoming", "left"))
    ]
    return Road(
        facts={
            "kind": "four-way intersection",
            "lane_width_m": LANE_WIDTH_M,
            "junction_m": JUNCTION_M,
            "ego": "/".join(ego),
        },
        paths=ways,
        ego=ego,
        crossings=meetings,
        zone_m=(float(np.mean([p.x_m for p in points])), float(np.mean([p.y_m for p in points]))),
        sectors={sector: _approach(ways[sector, "straight"]) for sector in SECTORS},
        network=network,
        ground=ground,
        form=form,
    )


@cache
def paths(arm: int = 0) -> dict[PathKey, Path]:
    """Return every path over the intersection by its key, as an ego from an arm names it.

    A key is (approach, route): where the path comes from (`own`, `left`, `oncoming` or `right`),
    and what it does (`straight` or `left`). `arm` is 0 to 3: south, west, north, east.
    """
    built = {}
    for corner in range(len(APPROACHES)):
        approach = seen_from(arm, corner)
        turn = np.pi / 2 * corner
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]).round(12)
        for route in ROUTES:
            points = _southern(route) @ rotation.T
            arc = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
            inside = 2 * JUNCTION_M if route == "straight" else LEFT_TURN_RADIUS_M * np.pi / 2
            end = (corner + (2 if route == "straight" else 1)) % 4
            roles = (f"approach-{approach}", "junction", EXITS[(end - arm) % 4])
            lanes: tuple[Lane, ...] = (
                (f"o{corner}", f"ir{corner}", 0),
                (f"ir{corner}", f"il{end}", 0),
                (f"il{end}", f"o{end}", 0),
            )
            ends = (ARM_M, ARM_M + inside)
            built[approach, route] = Path(
                approach, route, points, arc, ends, roles, lanes, PRIORITY[route][corner % 2]
            )
    return built


def seen_from(arm: int, other: int) -> str:
    """Return how an ego from `arm` calls arm `other`: `own`, `left`, `oncoming` or `right`.

    Arms are numbered 0 to 3: south, west, north, east.
    """
    return APPROACHES[(other - arm) % 4]


def _southern(route: str) -> Floats:
    """Return the points of a path that starts on the south arm."""
    half, end = LANE_WIDTH_M / 2, JUNCTION_M + ARM_M
    count = int(ARM_M / STEP_M)
    approach = np.column_stack(
        [np.full(count, half), np.linspace(end, JUNCTION_M, count, endpoint=False)]
    )
    if route == "straight":
        inside = np.linspace(JUNCTION_M, -JUNCTION_M, int(2 * JUNCTION_M / STEP_M), endpoint=False)
        leaving = np.linspace(-JUNCTION_M, -end, count + 1)
        y = np.concatenate([inside, leaving])
        return np.concatenate([approach, np.column_stack([np.full(len(y), half), y])])
    angle = np.linspace(0, np.pi / 2, int(LEFT_TURN_RADIUS_M * np.pi / 2 / STEP_M), endpoint=False)
    radius = LEFT_TURN_RADIUS_M
    arc = np.column_stack(
        [half - radius + radius * np.cos(angle), JUNCTION_M - radius * np.sin(angle)]
    )
    leaving = np.linspace(-JUNCTION_M, -end, count + 1)
    return np.concatenate([approach, arc, np.column_stack([leaving, np.full(count + 1, -half)])])


def _approach(path: Path) -> Floats:
    """Return the watched points of an approach lane, (15, 2) m."""
    back_m = np.linspace(*SECTOR_REACH_M, 15)
    return path.points_at(path.ends_m[0] + JUNCTION_M - back_m)


@cache
def network() -> Any:
    """Build the road network of highway-env's `IntersectionEnv`, always the same object.

    It is a `highway_env.road.road.RoadNetwork`, to the last bit that of the environment, which need
    not be loaded for it.
    """
    from harness.world.highway import CircularLane, LineType, RoadNetwork, StraightLane

    none, edge, middle = LineType.NONE, LineType.CONTINUOUS, LineType.STRIPED
    half, far = LANE_WIDTH_M / 2, ARM_M + JUNCTION_M
    streets = RoadNetwork()
    for arm in range(4):
        turn = np.radians(90 * arm)
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

        def at(x: float, y: float, rotation: Floats = rotation) -> Floats:
            place: Floats = rotation @ np.array([x, y])
            return place

        right, across, left = ((arm + turns) % 4 for turns in (-1, 2, 1))
        way_in = StraightLane(at(half, far), at(half, JUNCTION_M), line_types=(middle, edge))
        to_right = CircularLane(
            at(JUNCTION_M, JUNCTION_M),
            RIGHT_TURN_RADIUS_M,
            turn + np.radians(180),
            turn + np.radians(270),
            line_types=(none, edge),
        )
        to_left = CircularLane(
            at(half - LEFT_TURN_RADIUS_M, LEFT_TURN_RADIUS_M - half),
            LEFT_TURN_RADIUS_M,
            turn + np.radians(0),
            turn + np.radians(-90),
            clockwise=False,
            line_types=(none, none),
        )
        over = StraightLane(at(half, JUNCTION_M), at(half, -JUNCTION_M), line_types=(middle, none))
        way_out = StraightLane(at(JUNCTION_M, half), at(far, half), line_types=(none, edge))
        streets.add_lane(f"o{arm}", f"ir{arm}", way_in)
        streets.add_lane(f"ir{arm}", f"il{right}", to_right)
        streets.add_lane(f"ir{arm}", f"il{left}", to_left)
        streets.add_lane(f"ir{arm}", f"il{across}", over)
        streets.add_lane(f"il{right}", f"o{right}", way_out)
    return streets


def ground(far_m: float) -> Ground:
    """Return what rendered pictures show of both roads: their surface, centre lines and stop lines.

    They are drawn up to `far_m` m from the centre of the crossing. The `Ground` has their points, m
    to the east and the north of it.
    """
    half = LANE_WIDTH_M
    # One corner of the junction, from the north arm to the east arm; a quarter turn gives the next.
    angle = np.linspace(np.pi, 1.5 * np.pi, 9)
    fillet = JUNCTION_M + (JUNCTION_M - half) * np.column_stack([np.cos(angle), np.sin(angle)])
    corner = np.vstack([[half, far_m], fillet, [far_m, half]])
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])  # clockwise, for row vectors
    turns = [np.linalg.matrix_power(quarter, n) for n in range(4)]
    return Ground(
        outlines=(np.vstack([corner @ turn for turn in turns]),),
        marks=tuple(np.array([[0.0, JUNCTION_M], [0.0, far_m]]) @ turn for turn in turns),
        stops=tuple(np.array([[0.0, JUNCTION_M], [-half, JUNCTION_M]]) @ turn for turn in turns),
        boxes=tuple(np.array([[-x, -y], [x, y]]) for x, y in ((half, far_m), (far_m, half))),
    )
