"""Records of a scene: vehicles, buildings, beacons,
and the state of the whole world at one time.
"""

from functools import lru_cache
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from harness.core.arrays import Floats
from harness.world.fields import Closed, Count, Number, Seed, VehicleId
from harness.world.fields import Kind as Kind
from harness.world.fields import Part as Part

# Length and width; a van has those of SUMO's delivery van, and who is no car, van or truck has
# length, width and height of SUMO's class of that name
# (https://sumo.dlr.de/docs/Vehicle_Type_Parameter_Defaults.html).
SIZES_M: dict[str, tuple[float, float]] = {
    "car": (5.0, 2.0),
    "van": (6.5, 2.16),
    "truck": (10.0, 2.6),
    "bicycle": (1.6, 0.65),
    "motorcycle": (2.2, 0.9),
    "pedestrian": (0.215, 0.478),
}
HEIGHTS_M = {
    "car": 1.5,
    "van": 2.5,
    "truck": 3.6,
    "bicycle": 1.7,
    "motorcycle": 1.5,
    "pedestrian": 1.719,
}
BROAD = ("car", "van", "truck")  # kinds that have the sensors of a helper, and block radio
WITH_LAMPS = (*BROAD, "motorcycle")  # kinds that have turn indicators and brake lamps


def indicator(route: str) -> str:
    """Return what the turn indicator of a vehicle on this route shows: `left`, `right` or `off`.

    A route is what a path does, such as `straight`.
    """
    return route if route in ("left", "right") else "off"


class VehicleState(Closed, frozen=True, omit_defaults=True):
    """Describe one road user at one moment, in the frame of `harness.world.road` (y to the south).

    Bicycles, motorcycles and pedestrians are among the vehicles, too.
    """

    id: VehicleId  # `v1`, `v2`, … by spawn order; the ego is `v1`
    kind: Kind  # kind of road user, which fixes its size
    part: Part  # `ego`, `helper` (takes part in cooperation) or `other`
    x_m: Number  # position of the centre, m to the east
    y_m: Number  # position of the centre, m to the south
    heading_rad: Number  # from +x towards +y
    speed_mps: Number  # speed along the heading
    approach: str  # where its path comes from
    route: str  # what its path does, such as `straight` or `left`
    crashed: bool  # whether it has collided
    braking: bool = False  # whether its brake lamps are on; always false if the scenario has none
    radio: bool = False  # whether one that does not help sends beacons

    @property
    def indicator(self) -> str | None:
        """Return what the turn indicator shows: `left`, `right` or `off`; None if it has none."""
        return indicator(self.route) if self.kind in WITH_LAMPS else None

    @property
    def length_m(self) -> float:
        """Return the length from front to rear, m, which the kind fixes."""
        return SIZES_M[self.kind][0]

    @property
    def width_m(self) -> float:
        """Return the width from side to side, m, which the kind fixes."""
        return SIZES_M[self.kind][1]

    def corners(self) -> NDArray[np.float64]:
        """Return the corners, (4, 2) m: front left first, then clockwise as seen from above.

        x is to the east and y to the south. The array is shared and must not be written to.
        """
        return _corners(self)


@lru_cache(maxsize=256)  # every viewer of a scene looks at the same vehicles
def _corners(v: VehicleState) -> Floats:
    return rectangle(v.x_m, v.y_m, v.heading_rad, v.length_m, v.width_m)


def rectangle(
    x_m: float | Floats,
    y_m: float | Floats,
    heading_rad: float | Floats,
    length_m: float | Floats,
    width_m: float | Floats,
) -> Floats:
    """Return corners of rectangles, (..., 4, 2) m: front left first, then clockwise from above.

    All arguments are of shape (...): `x_m` and `y_m` of the centres, m to the east and south,
    `heading_rad` (from +x towards +y), and the sizes `length_m` and `width_m`.
    """
    cos, sin = np.cos(heading_rad)[..., None], np.sin(heading_rad)[..., None]
    along = np.multiply.outer(length_m, [1.0, 1.0, -1.0, -1.0]) / 2
    right = np.multiply.outer(width_m, [-1.0, 1.0, 1.0, -1.0]) / 2
    x, y = np.asarray(x_m)[..., None], np.asarray(y_m)[..., None]
    return np.stack([x + along * cos - right * sin, y + along * sin + right * cos], axis=-1)


def separation_m(poses: Floats, sizes_m: Floats, others: Floats, their_sizes_m: Floats) -> Floats:
    """Return a lower bound of the gap between n pairs of rectangles, (n,) m, by separating axes.

    A negative value means that they overlap. `poses` and `others` are x and y (m) and heading (rad)
    of the one and the other of each pair, (n, 3); `sizes_m` and `their_sizes_m` their lengths and
    widths, m, (n, 2).
    """
    dx, dy = (others - poses)[:, :2].T
    apart = np.full(len(poses), -np.inf)
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    its_cos, its_sin = np.cos(others[:, 2]), np.sin(others[:, 2])
    dot, cross = np.abs(cos * its_cos + sin * its_sin), np.abs(cos * its_sin - sin * its_cos)
    for c, s, (length, width), (its_length, its_width) in (
        (cos, sin, sizes_m.T, their_sizes_m.T),
        (its_cos, its_sin, their_sizes_m.T, sizes_m.T),
    ):
        along = np.abs(dx * c + dy * s) - (length + its_length * dot + its_width * cross) / 2
        across = np.abs(dy * c - dx * s) - (width + its_length * cross + its_width * dot) / 2
        apart = np.maximum(apart, np.maximum(along, across))
    return apart


class Building(Closed, frozen=True):
    """An axis-parallel box that blocks sight, by the positions of its walls in metres."""

    id: Annotated[str, Meta(pattern="^b[1-9]$")]
    west_m: Number
    north_m: Number
    east_m: Number
    south_m: Number

    def corners(self) -> NDArray[np.float64]:
        """Return the corners, (4, 2) m: north-west first, then clockwise as seen from above."""
        w, n, e, s = self.west_m, self.north_m, self.east_m, self.south_m
        return np.array([[w, n], [e, n], [e, s], [w, s]])


class Beacon(Closed, frozen=True, omit_defaults=True):
    """A vehicle's message about itself, with its errors: see `harness.world.beacons`."""

    sender: VehicleId  # id of the vehicle
    time_s: Number  # when it was sent, since the start of the episode; negative before the start
    arrives_s: Number  # when receivers have it
    x_m: Number  # position of the centre, m to the east
    y_m: Number  # position of the centre, m to the south
    heading_rad: Number  # from +x towards +y
    speed_mps: Number  # speed along the heading
    target_speed_mps: Number | None  # target of the ego's speed controller; None for other senders
    heard_by: tuple[VehicleId, ...]  # ids of the receivers that receive it
    # under the rule `cam`, the interval until the next one if the vehicle does not move enough to
    # send earlier; else None
    interval_s: Number | None = None
    # number of consecutive beacons that were sent because that interval was over; None where there
    # is none
    unmoved: Count | None = None


class WorldState(Closed, frozen=True):
    """Hold the full state of an episode at one moment, whether or not any vehicle sees it."""

    scenario: str  # name of the scenario
    episode_seed: Seed  # seed of the episode's layout
    # index of the decision about to be taken; equals the number of actions taken so far
    step: Count
    time_s: Number  # simulated time since the start of the episode
    target_speed_mps: Number  # target of the ego's speed controller
    # vehicles in spawn order, the ego first
    vehicles: Annotated[tuple[VehicleState, ...], Meta(min_length=1)]
    buildings: tuple[Building, ...]  # obstacles to sight besides vehicles
    # the last one that each receiver has, and those under way, by sender and time; empty under
    # perfect knowledge
    beacons: tuple[Beacon, ...] = ()

    @property
    def ego(self) -> VehicleState:
        """Return the ego: the vehicle whose decisions are evaluated, always the first."""
        return self.vehicles[0]

    @property
    def helpers(self) -> tuple[VehicleState, ...]:
        """Return the vehicles that the ego may ask for messages, in spawn order."""
        return tuple(v for v in self.vehicles if v.part == "helper")

    def vehicle(self, vehicle_id: str) -> VehicleState:
        """Return the vehicle with the id `vehicle_id`, such as `v2`. Raises KeyError if none."""
        for v in self.vehicles:
            if v.id == vehicle_id:
                return v
        raise KeyError(vehicle_id)


class Snapshot(Closed, frozen=True):
    """Hold what the simulator needs besides a `WorldState` to continue the episode exactly."""

    frame: Count  # number of frames simulated so far
    sections: tuple[Count, ...]  # section of its path that each vehicle is in
    speed_index: Count  # index of the ego's target speed


class ActionsTaken(Closed, frozen=True):
    """What leads an environment from its seed to here again:
    the frame and the name of each action.
    """

    frame: Count
    taken: tuple[tuple[Count, Annotated[str, Meta(max_length=200)]], ...]
