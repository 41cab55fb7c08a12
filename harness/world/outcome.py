"""The outcome of an episode, and who was at fault in a collision."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from msgspec import Struct
from shapely import Polygon
from shapely.ops import nearest_points

from harness.world.parameters import Parameters
from harness.world.road import Path, PathKey
from harness.world.state import VehicleState

Result = Literal["running", "cleared", "late", "collision", "time_out", "off_road"]
Rating = Literal["success", "late", "unsafe", "stuck"]
# Every result of an episode that has ended, in one of the four words in which outcomes are counted.
RATINGS: Mapping[str, Rating] = {
    "cleared": "success",
    "late": "late",
    "collision": "unsafe",
    "off_road": "unsafe",
    "time_out": "stuck",
}

SAME_WAY = np.sqrt(0.5)  # the cosine of 45°, up to which one drives into the other's back
ROUNDING_S = 0.01  # half a frame: keeps rounding out of comparing times


@dataclass(frozen=True)
class Outcome:
    """Describe how an episode ended for one agent (usually the ego), or that it still runs.

    An agent is a vehicle that decides for itself.
    """

    # `cleared` (the ego reached its goal, the only success), `collision`, or a forced failure:
    # `time_out` (never), `late` (too long after the full-view driver) or `off_road`; `running`
    # while undecided
    result: Result = "running"
    time_s: float | None = None  # seconds from the start until it was decided; None while running
    # id of the vehicle that the ego collided with; None without a collision
    partner: str | None = None
    # whose front hit the other: `ego`, `other`, `both` or `neither` (a side swipe); None without a
    # collision
    striker: str | None = None
    # who should have given way, or drove into the other's back: `ego` or `other`; None without a
    # collision
    fault: str | None = None
    # smallest distance so far between the ego's outline and any other vehicle's, m
    least_gap_m: float = 1000.0
    other_crashes: int = 0  # number of vehicles that crashed without the ego

    @property
    def ended(self) -> bool:
        return self.result != "running"

    @property
    def success(self) -> bool:
        """Return whether the ego reached its goal in time and without a collision."""
        return self.result == "cleared"

    def judged(self, reference: "Outcome", danger: str | None, parameters: Parameters) -> "Outcome":
        """Return this outcome, changed to `late` if the ego reached its goal too late.

        That is later, by more than `parameters.allowance_s(danger)`, than the reference driver that
        sees everything, whose outcome from the same start is `reference`. `danger` is the sector
        (direction) that a vehicle on collision course comes from, None without one.
        """
        if (
            not self.success
            or not reference.success
            or self.time_s is None
            or reference.time_s is None
        ):
            return self
        late = self.time_s - reference.time_s > parameters.allowance_s(danger) + ROUNDING_S
        return replace(self, result="late") if late else self

    def ending(self, result: Result, time_s: float, **how: str) -> "Outcome":
        gap = 0.0 if result == "collision" else self.least_gap_m
        return replace(self, result=result, time_s=time_s, least_gap_m=gap, **how)  # type: ignore[arg-type]


class End(Struct, frozen=True, array_like=True):
    """Describe how one agent's drive in an episode ended; an agent is a vehicle that decides.

    `result` is `cleared` at the goal, else how the drive failed, decided at `time_s`, s from the
    start. `lost_s` is how many s later than on an empty road it arrived; None unless it did.
    `partner` is the id of the vehicle that it collided with, None without one, and `met` whether
    that is an agent, too.
    """

    agent: str  # the agent's vehicle id
    result: str  # `cleared` if it reached its goal, else how it failed
    time_s: float | None  # when that was decided, s from the start
    # how many s later than alone on the road it arrived; None unless it did
    lost_s: float | None
    partner: str | None  # id of the vehicle that it collided with; None without one
    met: bool  # whether `partner` is another agent


def rating(failure: str, parameters: Parameters) -> Rating | None:
    """Return `success`, `late`, `unsafe` or `stuck` for the result of an ended episode.

    `failure` is empty for a success, else `late`, `collision`, `off_road` (both unsafe) or
    `time_out` (stuck). `parameters` are the scenario's: None is returned if their `limits` is 1,
    under which outcomes are not put into these words.
    """
    return None if parameters.limits == 1 else RATINGS[failure or "cleared"]


def outline(v: VehicleState) -> Polygon:
    """Return the outline of vehicle `v` as a shapely polygon, in m to the east and the south."""
    return Polygon(v.corners())


def striker(ego: VehicleState, other: VehicleState) -> str:
    """Return whose front bumper hit the other vehicle: `ego`, `other`, `both` or `neither`.

    The front is its first metre, at most a quarter of its length. The states are those at the
    moment of the collision.
    """
    contact = nearest_points(outline(ego), outline(other))[0]
    overlap = outline(ego).intersection(outline(other))
    if not overlap.is_empty:
        contact = overlap.centroid
    strikers = []
    for name, v in (("ego", ego), ("other", other)):
        ahead = (contact.x - v.x_m) * np.cos(v.heading_rad) + (contact.y - v.y_m) * np.sin(
            v.heading_rad
        )
        if ahead > v.length_m / 2 - min(1.0, v.length_m / 4):
            strikers.append(name)
    return "both" if len(strikers) == 2 else strikers[0] if strikers else "neither"


def fault(ego: VehicleState, other: VehicleState, paths: Mapping[PathKey, Path]) -> str:
    """Return who is at fault in a collision, `ego` or `other`.

    In a rear-end collision (headings within 45°) it is the one behind, else the one whose path has
    the lower right of way. The states are those at the moment of the collision, and `paths` are the
    road's, by approach and route.
    """
    if np.cos(ego.heading_rad - other.heading_rad) > SAME_WAY:
        dx, dy = other.x_m - ego.x_m, other.y_m - ego.y_m
        ahead = dx * np.cos(ego.heading_rad) + dy * np.sin(ego.heading_rad)
        return "ego" if ahead > 0 else "other"
    ego_path, other_path = paths[ego.approach, ego.route], paths[other.approach, other.route]
    return "ego" if ego_path.priority < other_path.priority else "other"
