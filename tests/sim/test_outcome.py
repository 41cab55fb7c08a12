"""Who hit whom, who was to blame, and when clearing is too late."""

import math
from typing import get_args

import pytest
from msgspec.structs import replace

from harness.world.outcome import RATINGS, Outcome, Result, fault, outline, rating, striker
from harness.world.scenarios.occluded_intersection import SCENARIO, Parameters
from harness.world.state import VehicleState

NORTH, EAST, SOUTH, WEST = -math.pi / 2, 0.0, math.pi / 2, math.pi


def car(x, y, heading, approach="own", route="straight"):
    return VehicleState("v5", "car", "other", x, y, heading, 5.0, approach, route, False)


EGO = car(2.0, 0.0, NORTH)

# Cars are 5 m by 2 m. What the other does, where it stands, who struck, who should have given way.
HITS = {
    "my front into the side of one from the left": (car(2.0, -3.4, EAST, "left"), "ego", "ego"),
    "my front into the side of one from the right": (car(2.0, -3.4, WEST, "right"), "ego", "ego"),
    "its front into my left side": (car(-1.4, 0.0, EAST, "left"), "other", "ego"),
    "its front into my right side": (car(5.4, 0.0, WEST, "right"), "other", "ego"),
    "front to front with one that turns left across me": (
        car(-0.6, -4.2, SOUTH - math.pi / 4, "oncoming", "left"), "both", "other",
    ),
    "my front into its right side, as it turns left across me": (
        car(2.0, -3.4, EAST, "oncoming", "left"), "ego", "other",
    ),
    "my front into the back of the one ahead": (car(2.0, -4.9, NORTH), "ego", "ego"),
    "its front into my back": (car(2.0, 4.9, NORTH), "other", "other"),
}  # fmt: skip


@pytest.mark.parametrize("hit", HITS)
def test_who_hit_whom(hit):
    other, who, blamed = HITS[hit]
    assert outline(EGO).intersects(outline(other))
    assert striker(EGO, other) == who
    assert fault(EGO, other, SCENARIO.road().paths) == blamed


def test_nobody_strikes_in_a_side_swipe():
    assert striker(EGO, car(3.9, 0.0, NORTH)) == "neither"


@pytest.mark.parametrize("kind", ["bicycle", "motorcycle", "pedestrian"])
def test_who_is_short_strikes_with_its_front_alone(kind):
    """It crosses before the ego, whose front bumper lies at -2.5 m, or runs into its left side."""
    crosses = replace(car(2.0, -2.6, EAST, "left"), kind=kind)
    comes = replace(car(1.0, 0.0, EAST, "left"), kind=kind)
    comes = replace(comes, x_m=1.05 - comes.length_m / 2)
    assert (striker(EGO, crosses), striker(EGO, comes)) == ("ego", "other")


@pytest.mark.parametrize("hit", [h for h in HITS if "back" not in h])
def test_blame_goes_by_right_of_way_and_not_by_who_struck(hit):
    other, _, blamed = HITS[hit]
    assert blamed == ("ego" if other.approach in ("left", "right") else "other")


def test_an_ego_that_clears_within_the_allowance_of_the_full_view_driver_succeeds():
    reference = Outcome("cleared", 6.0)
    assert Outcome("cleared", 7.0).judged(reference, None, Parameters(limits=1)).success
    assert Outcome("cleared", 5.0).judged(reference, None, Parameters(limits=1)).success


def test_an_ego_that_clears_one_frame_beyond_the_allowance_is_late():
    late = Outcome("cleared", 7.02).judged(Outcome("cleared", 6.0), "left", Parameters())
    assert (late.result, late.success, late.ended) == ("late", False, True)


@pytest.mark.parametrize("result", ["collision", "time_out", "off_road"])
def test_a_failure_stays_what_it_is_and_makes_nobody_late(result):
    failed = Outcome(result, 3.0)
    assert failed.judged(Outcome("cleared", 1.0), None, Parameters()) == failed
    assert Outcome("cleared", 9.0).judged(failed, None, Parameters(limits=2)).success


@pytest.mark.parametrize(
    ("limits", "danger", "allowed_s"),
    [(1, None, 1.0), (1, "left", 1.0), (2, None, 0.25), (2, "left", 1.0)],
)
def test_the_second_limits_forgive_less_where_there_is_no_danger(limits, danger, allowed_s):
    p = Parameters(limits=limits)
    for over_s, result in ((allowed_s, "cleared"), (allowed_s + 0.02, "late")):
        outcome = Outcome("cleared", 6.0 + over_s).judged(Outcome("cleared", 6.0), danger, p)
        assert outcome.result == result


def test_every_end_has_one_of_four_ratings():
    assert RATINGS.keys() == {*get_args(Result)} - {"running"}
    failures = ("", "late", "collision", "off_road", "time_out")
    ratings = [rating(failure, Parameters(limits=2)) for failure in failures]
    assert ratings == ["success", "late", "unsafe", "unsafe", "stuck"]
    assert {rating(failure, Parameters(limits=1)) for failure in failures} == {None}
