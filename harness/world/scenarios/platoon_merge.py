"""Scenario `platoon-merge`: a car merges from a ramp behind a wall into a platoon;
all of them are agents.

The ego comes along the ramp of `blind-merge`, and two or three cars drive on the right lane, a
second or so apart: too close for the ego to merge between two of them without their help. Each has
a seat of its own: it may make room, or close a gap. Without `agent_share` they keep their lane and
speed, as all other traffic does: it brakes only for who is in its lane, ahead and slower.

The row has one place more than cars: before, between or behind them, where a gap seems open. In
most episodes it is taken by a car that is no agent: it neither sends nor makes room. The wall hides
it from the ego, and it may be hidden from an agent by the one between them. A car beside that place
on the left lane is harmless.

When the ego comes to the merge is drawn evenly about that place, so that it is as often before as
behind each of the others; ids tell nobody's place.
"""

from dataclasses import dataclass, replace
from functools import cache
from itertools import accumulate

import numpy as np

from harness.world.lookouts import Draft, placed
from harness.world.parameters import SHARED, Shared
from harness.world.road import PathKey, Road, crossings
from harness.world.scenario import Draws, Layout, Scenario, Seat, Spawn
from harness.world.scenarios import blind_merge
from harness.world.scenarios.blind_merge import BEGIN_M, SECTOR_REACH_M, WALL_M
from harness.world.state import Building, Part

NAME = "platoon-merge"
RAMP, MAIN = ("ramp", "merge"), ("main", "straight")  # where agents begin


@dataclass(frozen=True)
class Parameters(Shared):
    """Hold the settings of `platoon-merge`: the ego merges from a ramp into a row of cars.

    Numbers end in their unit (`_m`, `_mps`, `_s`), and a `_share` is a probability. A pair of
    numbers bounds a uniform draw, made anew for each layout, the start situation of an episode. The
    row has one place more than cars; `offset_s` is when that place is at the merge, in s after a
    cruising ego, one that keeps its speed. A danger is the vehicle that would meet that ego.

    All start at `speed_mps`, the ego `ego_start_m` before the merge; `cleared_m` beyond it is the
    goal. The row's places are `headway_s` apart, and it has a third car with `third_share`. A
    danger takes the free place, and a harmless car (`left_`) may be beside that place on the left
    lane, `left_offset_s` after it. The wall ends `wall_end_m` before the merge.
    """

    # speeds that an agent's actions step through, m/s: up to 54 km/h
    target_speeds_mps: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0)
    speed_mps: float = 15.0  # speed of everybody at the start, m/s
    # distance of the ego's start to the merge, m: where the ramp has run into the right lane
    ego_start_m: tuple[float, float] = (58.0, 70.0)
    cleared_m: float = 12.0  # distance beyond the merge at which an agent has reached its goal, m
    third_share: float = 0.5  # probability of a third car in the platoon, the row of agents
    # seconds from one place of the row to the next, one place more than there are cars
    headway_s: tuple[float, float] = (0.85, 1.05)
    # seconds at which the row's place without an agent is at the merge, after a cruising ego
    offset_s: tuple[float, float] = (-1.1, 1.1)
    danger_share: float = 0.65  # probability of a danger: a car that is no agent, in that place
    left_share: float = 0.5  # probability of a harmless car on the left lane beside that place
    # seconds at which that harmless car is beside the merge, after that place
    left_offset_s: tuple[float, float] = (-0.3, 0.3)
    # distance of the wall's end to the merge, m
    wall_end_m: tuple[float, float] = (30.0, 42.0)


def road() -> Road:
    """Return the road of scenario `blind-merge`: a main road of two lanes and a ramp.

    The ego comes along the ramp.
    """
    return blind_merge.road()


@cache
def main_road() -> Road:
    """Return the road for an agent, a vehicle that decides, on the right lane of the main road.

    The ramp merges into its lane.
    """
    shared = road()
    back_m = shared.zone_arc_m - np.linspace(*SECTOR_REACH_M, 16)
    return replace(
        shared,
        facts={**shared.facts, "ego": "/".join(MAIN)},
        ego=MAIN,
        crossings=crossings(shared.paths, MAIN),
        sectors={"ramp": shared.paths[RAMP].points_at(back_m)},
    )


@cache
def seats() -> dict[PathKey, Seat]:
    """Return the scenario as a car of the platoon plays it: with that car as its ego.

    The key is the path on which these cars start, (approach, route).
    """
    words = {
        "task": "keep to the right lane of a road, in a platoon, "
        "past a ramp that runs into the lane",
        "hiding": SCENARIO.words["hiding"],
    }
    return {
        MAIN: Seat(
            replace(SCENARIO, road=main_road, words=words), {key: key for key in road().paths}
        )
    }


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: the ego on a ramp, a row of cars, and a wall.

    A layout is the start situation of an episode. A danger, with probability `danger_share`, is a
    car that does not decide and takes one place of the row. The layout is the same for equal seeds
    and `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""
    (at,) = road().crossings.values()
    start, offset_s = draws.between("ego_start", p.ego_start_m), draws.between("offset", p.offset_s)
    count = 3 if draws.share("third") < p.third_share else 2
    gaps_s = (draws.between(f"headway {n}", p.headway_s) for n in range(count))
    times_s = list(accumulate(gaps_s, initial=0.0))  # of the row's places, the first one's is 0
    free_s = times_s.pop(int(draws.share("free") * len(times_s)))

    def timed(id_: str, part: Part, approach: str, late_s: float) -> Spawn:
        """Return a car that is at the merge so long after a cruising ego."""
        arc = at.other_arc_m - start - p.speed_mps * late_s
        return Spawn(id_, "car", part, approach, "straight", arc, p.speed_mps)

    helpers = sorted(range(count), key=lambda n: draws.share(f"id {n}"))
    ids = draws.ids(("danger", "left"))
    phantom = timed(ids["danger"], "other", "main", offset_s)
    spawns = [
        Spawn("v1", "car", "ego", *RAMP, at.ego_arc_m - start, p.speed_mps),
        *(
            timed(f"v{2 + number}", "helper", "main", time_s - free_s + offset_s)
            for number, time_s in zip(helpers, times_s, strict=True)
        ),
    ]
    if draws.share("left") < p.left_share:
        late_s = offset_s + draws.between("left_offset", p.left_offset_s)
        spawns.append(timed(ids["left"], "other", "main left", late_s))
    danger = "main" if draws.share("danger") < p.danger_share else None
    if danger:
        spawns.append(phantom)
    wall = Building("b1", BEGIN_M, WALL_M[0], -draws.between("wall_end", p.wall_end_m), WALL_M[1])
    return Draft(Layout.arranged(spawns, danger, ids["danger"], [wall]), (phantom,), ())


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=blind_merge.cleared,
    dials=SHARED,
    seats=seats,
    words={
        "task": "merge from a ramp into the right lane of a road",
        "hiding": "a wall beside the ramp",
    },
    one_sided="the ramp comes from the right",
)
