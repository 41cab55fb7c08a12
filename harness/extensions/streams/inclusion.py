"""Which objects a station puts into its next CPM, the message that lists what it sees.

The rules are those of ETSI TS 103 324 V2.1.1, 6.1.2.3, with the values that its table F.1
recommends. They were not read in the standard, but where others state them by clause: ms-van3t
(`cpBasicService`) and Artery (`CpService`), which agree but for a new pedestrian.

    vehicles    (type B, motorcycles too) that are new, or since they were last included have moved
                more than 4 m, changed their speed by more than 0.5 m/s or their direction of motion
                by 4° or more, or that were last included 1 s (T_GenCpmMax) ago or longer.
    pedestrians (type A, bicycles too) that are new; and all of them as soon as one was last
                included 0.5 s ago or longer, however little they move. In Artery a new one takes
                all others along; the standard's rule 1 a selects it alone.

A CPM goes every 0.1 to 1 s (T_GenCpmMin to T_GenCpmMax), without objects where none is due for 1 s.
What is left out: the quality that an object's perception must have, and what a station may do
beyond these rules: look ahead to its next message, or leave out what others have told already.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from harness.core.errors import UserError

MOVE_M, CHANGE_MPS, TURN_RAD = 4.0, 0.5, math.radians(4)
SHORTEST_S, LONGEST_S = 0.1, 1.0  # T_GenCpmMin and T_GenCpmMax
OF_TYPE_A = ("pedestrian", "bicycle")  # kinds of road users; all others are of type B
ROUNDING = 1e-9  # s, m, m/s and rad that are no difference


class Sighting(NamedTuple):
    """Hold what a station sees of an object at a time, or saw when it last included it in a CPM."""

    time_s: float  # from the start of the episode
    x_m: float  # position of the centre, m to the east
    y_m: float  # position of the centre, m to the south
    speed_mps: float
    heading_rad: float  # direction of motion, from +x towards +y
    kind: str  # kind of road user, such as `car` or `pedestrian`


def due(seen: Mapping[str, Sighting], included: Mapping[str, Sighting]) -> list[str]:
    """Return the names of the objects that the rules put into a CPM now, in the order of `seen`.

    Args:
        seen: what the station sees now, by the object's name.
        included: what each object was when it was last included, by name. One that is not here is
            new; who loses sight of an object takes it from here.
    """
    ages_s = {}
    for name, now in seen.items():
        if name in included:
            ages_s[name] = now.time_s - included[name].time_s
    of_type_a = {name for name in ages_s if seen[name].kind in OF_TYPE_A}
    all_of_type_a = any(_at_least(ages_s[name], LONGEST_S / 2) for name in of_type_a)
    names = []
    for name, now in seen.items():
        if name not in included:
            is_due = True
        elif name in of_type_a:
            is_due = all_of_type_a
        else:
            is_due = _at_least(ages_s[name], LONGEST_S) or _has_changed(now, included[name])
        if is_due:
            names.append(name)
    return names


def interval_s(allowed_s: float) -> float:
    """Return the seconds from one CPM to the next, given how soon a station may send again.

    `allowed_s` is by congestion control, which makes a station send less where the channel is busy.
    The result is within the bounds of the standard (T_GenCpm between T_GenCpmMin and T_GenCpmMax),
    in whole microseconds, as keys of answers have it.
    """
    return round(min(max(allowed_s, SHORTEST_S), LONGEST_S), 6)


def interval_of_rate(rate_hz: float) -> float:
    """Return the seconds between CPMs that are sent so many times a second.

    Raises UserError for a rate that the standard does not allow.
    """
    slowest_hz, fastest_hz = 1 / LONGEST_S, 1 / SHORTEST_S
    if not slowest_hz <= rate_hz <= fastest_hz:
        raise UserError(
            f"{rate_hz:g} CPMs a second are not allowed; give {slowest_hz:g} to {fastest_hz:g} "
            f"(ETSI TS 103 324: one every {SHORTEST_S:g} to {LONGEST_S:g} s)"
        )
    return 1 / rate_hz


def _has_changed(now: Sighting, then: Sighting) -> bool:
    """Return whether an object of type B moves otherwise than when it was last included."""
    moved_m = math.hypot(now.x_m - then.x_m, now.y_m - then.y_m)
    changed_mps = abs(now.speed_mps - then.speed_mps)
    turned_rad = abs(math.remainder(now.heading_rad - then.heading_rad, math.tau))
    return (
        moved_m > MOVE_M + ROUNDING
        or changed_mps > CHANGE_MPS + ROUNDING
        or _at_least(turned_rad, TURN_RAD)
    )


def _at_least(value: float, least: float) -> bool:
    return value >= least - ROUNDING
