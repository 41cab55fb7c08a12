"""Scenario `roundabout-entry`: the ego enters a roundabout past a hedge that hides who is on it.

The ego comes from the south at 8 m/s and enters a roundabout of one lane to go straight on. A hedge
on the splitter island beside it, and a planted mound in the middle, hide who comes round from the
left. In most episodes one vehicle is dangerous: it has come from the west or the north arm, goes on
past the ego's arm, and is timed to be where the ego enters. What matters is where it goes: a car
just like it that leaves at the ego's arm is harmless. Three helpers, one that has just left at the
ego's arm, one that has left at the west arm and one that has just entered ahead of the ego, see
parts of the ring. Traffic keeps its lane and speed and yields to nobody; the ego alone decides.

What the ego can see before it is too late (hedge, mound, helpers, a car that leaves first, a car
that comes later) is drawn without knowing of the danger.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.lookouts import Draft, placed, queue
from harness.world.parameters import WITNESSED, Witnessed
from harness.world.road import PathKey, Road, crossings
from harness.world.roundabouts import ARM_M, LANE_WIDTH_M, Roundabout
from harness.world.scenario import Draws, Layout, Scenario, Spawn
from harness.world.state import Building

NAME = "roundabout-entry"
# The middle of the ring's lane has a radius of 20 m: 44 m from kerb to kerb, 27 to 55 m are usual.
PLACE = Roundabout(ring_m=20.0, entry_m=18.0, beside_m=4.0)
SECTORS = ("left", "oncoming")  # the arm that a danger has come from
SECTOR_REACH_M = (8.0, 45.0)  # stretch before the point of entry that is looked at
# Where witnesses are declared, the third lookout is a second car that leaves at the west arm, this
# far behind the first.
SECOND_M = 8.0, 10.0
# Blind seats: slow cars behind the ego, which they never reach; from centre to centre.
SEATS_M = (14.0, 18.0), (9.0, 11.0), (9.0, 11.0)
SEATS_MPS = (1.0, 2.0)


@dataclass(frozen=True)
class Parameters(Witnessed):
    """Hold the settings of `roundabout-entry`: the ego enters a roundabout past a hedge.

    Numbers end in their unit (`_m`, `_mps`, `_s`), and a `_share` is a probability. A pair of
    numbers bounds a uniform draw, made anew for each layout, the start situation of an episode.
    `sector_shares` are no such pair, but probabilities of the arms that a danger comes from: left,
    oncoming. An `_offset_s` is when a car is at the ego's entry, in s after a cruising ego, one
    that keeps its speed. A danger is the vehicle that would meet that ego.

    The ego starts `ego_start_m` before its entry. Cars on the ring drive at `ring_mps`: a danger,
    else one that leaves before the ego's entry (`leaver_share`), and harmless ones shortly before
    (`before_`) and long after (`late_`). Sight is blocked by a mound on the island, of radius
    `mound_m`, and by a hedge that ends `hedge_end_m` from the centre and is `hedge_half_m` wide on
    each side. Helpers drive at `helper_mps` and start behind the ring's edge on the south and west
    arm, and beyond the entry (`helper_south_m`, `helper_west_m`, `helper_ahead_m`).
    """

    # speeds that the ego's actions step through, m/s
    target_speeds_mps: tuple[float, ...] = (0.0, 4.0, 8.0)
    # speed of the ego at the start, m/s: 29 km/h, which a circle of 22 m allows (NCHRP 672: 8.76
    # R^0.386)
    ego_speed_mps: float = 8.0
    # distance of the ego's start to its entry, m: where its way joins the ring
    ego_start_m: tuple[float, float] = (33.0, 39.0)
    # probability of a danger: a car on the ring that is at the entry when the ego is
    danger_share: float = 0.65
    # probability that a danger comes from the left arm, from the oncoming arm
    sector_shares: tuple[float, float] = (0.5, 0.5)
    # seconds at which a danger passes the entry, after a cruising ego would
    danger_offset_s: tuple[float, float] = (0.0, 0.6)
    # speed of everybody on the ring, m/s (NCHRP 672: 7.7 m/s for a circle of 20 m)
    ring_mps: tuple[float, float] = (6.8, 7.8)
    # probability, without a danger, of a harmless car in its place that leaves at the ego's arm
    leaver_share: float = 0.6
    before_share: float = 0.4  # probability of a car that leaves at the ego's arm shortly before
    # seconds at which that car would pass the entry if it went on, after a cruising ego would
    before_offset_s: tuple[float, float] = (-1.8, -1.3)
    # probability of a car that comes as a danger would, but later than the critical headway of 4.98
    # s (HCM 7, equation 22-1) allows the ego to be in its way
    late_share: float = 0.4
    # seconds at which that later car passes the entry, after a cruising ego would
    late_offset_s: tuple[float, float] = (5.0, 7.0)
    mound_m: tuple[float, float] = (12.0, 15.0)  # radius of the planted part of the island, m
    # distance of the ring's centre to the end of the hedge, m
    hedge_end_m: tuple[float, float] = (24.0, 32.0)
    # half the width of the hedge, m; the splitter island is 4 m wide at its narrowest
    hedge_half_m: float = 1.5
    # how far behind the ring's edge the helper that left at the ego's arm starts, m
    helper_south_m: tuple[float, float] = (16.0, 22.0)
    # how far behind the ring's edge the helper that left at the west arm starts, m
    helper_west_m: tuple[float, float] = (6.0, 12.0)
    # how far beyond the entry the helper that entered before the ego starts, m
    helper_ahead_m: tuple[float, float] = (8.0, 14.0)
    helper_mps: tuple[float, float] = (5.5, 7.0)  # speed of helpers, m/s


@cache
def road() -> Road:
    """Return the roundabout as a `Road`, for an ego from the south.

    The conflict zone is where the ego joins the ring.
    """
    ego = ("own", "straight")
    # Routes are named at the ego's arm: `right` leaves there and shows it, `straight` goes on past
    # it.
    paths = {
        ego: PLACE.path(*ego, "s", "n", 0),
        ("own", "left"): PLACE.path("own", "left", "s", "w", 0),
        ("left", "straight"): PLACE.path("left", "straight", "w", "e", 1),
        ("left", "right"): PLACE.path("left", "right", "w", "s", 1),
        ("oncoming", "straight"): PLACE.path("oncoming", "straight", "n", "e", 1),
        ("oncoming", "right"): PLACE.path("oncoming", "right", "n", "s", 1),
    }
    meetings = crossings(paths, ego)
    at = meetings["left", "straight"]
    back_m = np.linspace(*SECTOR_REACH_M, 15)
    watched = {
        sector: paths[sector, "straight"].points_at(
            meetings[sector, "straight"].other_arc_m - back_m
        )
        for sector in SECTORS
    }
    return Road(
        facts={
            "kind": "roundabout",
            "lane_width_m": LANE_WIDTH_M,
            "ring_m": PLACE.ring_m,
            "ego": "/".join(ego),
        },
        paths=paths,
        ego=ego,
        crossings=meetings,
        zone_m=(at.x_m, at.y_m),
        sectors=watched,
        network=PLACE.network,
    )


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: the ego, three helpers, a hedge, and who is on the ring.

    A layout is the start situation of an episode. A danger, with probability `danger_share`, is a
    car that passes the ego's entry when the ego is there. The layout is the same for equal seeds
    and `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""
    paths, meetings = road().paths, road().crossings

    def arm(what: str) -> str:
        return SECTORS[int(draws.share(what) >= p.sector_shares[0])]

    start = draws.between("ego_start", p.ego_start_m)
    ring_mps = draws.between("ring_speed", p.ring_mps)

    def helper(
        id_: str, key: PathKey, begin_m: float, what: str, beyond_m: tuple[float, float]
    ) -> Spawn:
        arc = begin_m + draws.between(f"helper_{what}", beyond_m)
        speed = draws.between(f"helper_{what}_speed", p.helper_mps)
        return Spawn(id_, "car", "helper", *key, arc, speed)

    leaves, crosses, enters = ("oncoming", "right"), ("own", "left"), ("own", "straight")
    spawns = [
        Spawn("v1", "car", "ego", *enters, road().zone_arc_m - start, p.ego_speed_mps),
        helper("v2", leaves, paths[leaves].ends_m[-2], "south", p.helper_south_m),
        helper("v3", crosses, paths[crosses].ends_m[-2], "west", p.helper_west_m),
        helper("v4", enters, road().zone_arc_m, "ahead", p.helper_ahead_m),
    ]
    if draws.seats:
        second = spawns[2].arc_m - draws.between("second", SECOND_M)
        spawns[3] = replace(spawns[2], id="v4", arc_m=second)

    def car(name: str, sector: str, route: str, bounds: tuple[float, float]) -> Spawn:
        """Return a car that is, or would be, where the ego enters so long after a cruising ego."""
        late_s = draws.between(f"{name}_offset", bounds)
        arc = meetings[sector, "straight"].other_arc_m - ring_mps * (
            start / p.ego_speed_mps + late_s
        )
        return Spawn(ids[name], "car", "other", sector, route, arc, ring_mps)

    ids = draws.ids(("round", "before", "late"))
    danger = arm("sector") if draws.share("danger") < p.danger_share else None
    phantoms = {sector: car("round", sector, "straight", p.danger_offset_s) for sector in SECTORS}
    if danger:
        spawns.append(phantoms[danger])
    elif draws.share("leaver") < p.leaver_share:
        spawns.append(car("round", arm("sector"), "right", p.danger_offset_s))
    if draws.share("before") < p.before_share:
        spawns.append(car("before", arm("before_sector"), "right", p.before_offset_s))
    if draws.share("late") < p.late_share:
        spawns.append(car("late", arm("late_sector"), "straight", p.late_offset_s))

    half, mound = p.hedge_half_m, draws.between("mound", p.mound_m)
    hedge = -half, draws.between("hedge_end", p.hedge_end_m), half, PLACE.arc_y_m + ARM_M
    buildings = [Building(f"b{n}", *box) for n, box in enumerate([hedge, *PLACE.mound(mound)], 1)]
    made = Layout.arranged(spawns, danger, ids["round"], buildings)
    return Draft(made, (*phantoms.values(),), queue(draws, ids, spawns[0], SEATS_M, SEATS_MPS))


def cleared(xy_m: Floats, approaches: Texts, parameters: Parameters) -> Bools:
    """Return whether the ego is past the first exit after its entry.

    `xy_m`, (..., V, 2), are the centres of the V vehicles of each of any number of episodes at one
    moment, m in highway-env's frame, the ego first. `approaches`, (..., V), where their paths come
    from, and `parameters` are not read. The result is (...).
    """
    x, y = xy_m[..., 0, 0], xy_m[..., 0, 1]
    return np.asarray((x > 0) & (np.arctan2(y, x) < PLACE.ring_rad(1)))


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=cleared,
    dials=WITNESSED,
    words={
        "task": "enter a roundabout and go straight on",
        "hiding": "a hedge and a planted island",
    },
    one_sided="traffic goes round one way and comes from the left",
)
