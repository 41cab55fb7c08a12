"""Which objects go into a CPM: each rule of TS 103 324 on poses written by hand."""

import math

import pytest

from harness.core.errors import UserError
from harness.extensions.streams.inclusion import Sighting, due, interval_of_rate, interval_s

CAR = Sighting(10.0, 100.0, -20.0, 8.0, 0.5, "car")  # when it was last included
DEGREE = math.pi / 180


def after(seconds, then=CAR, **changes):
    """Return what is seen so many seconds after something was included."""
    return then._replace(time_s=then.time_s + seconds, **changes)


# What is seen of a vehicle .3 s after it was included, and whether that is due.
CHANGES = {
    "nothing": ({}, False),
    "just 4 m ahead": ({"x_m": 104.0}, False),
    "just 4 m back": ({"x_m": 96.0}, False),
    "more than 4 m": ({"x_m": 104.01}, True),
    "more than 4 m to the north": ({"y_m": -24.01}, True),
    "3 m and 2 m are 3.61 m": ({"x_m": 103.0, "y_m": -22.0}, False),
    "3 m and 3 m are 4.24 m": ({"x_m": 103.0, "y_m": -23.0}, True),
    "just 0.5 m/s faster": ({"speed_mps": 8.5}, False),
    "0.51 m/s faster": ({"speed_mps": 8.51}, True),
    "0.51 m/s slower": ({"speed_mps": 7.49}, True),
    "turned by 3.99°": ({"heading_rad": 0.5 + 3.99 * DEGREE}, False),
    "turned by 4°, which is enough": ({"heading_rad": 0.5 + 4 * DEGREE}, True),
    "turned by -4°": ({"heading_rad": 0.5 - 4 * DEGREE}, True),
    "a whole turn is none": ({"heading_rad": 0.5 + 2 * math.pi}, False),
    "turned by 356°, which is -4°": ({"heading_rad": 0.5 + 356 * DEGREE}, True),
    "a little of everything": ({"x_m": 103.9, "speed_mps": 8.4, "heading_rad": 0.56}, False),
}


@pytest.mark.parametrize(("changes", "is_due"), CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("kind", ["car", "van", "truck", "motorcycle"])
def test_a_vehicle_is_due_by_what_changed_since_it_was_included(kind, changes, is_due):
    then = CAR._replace(kind=kind)
    assert due({"a": after(0.3, then, **changes)}, {"a": then}) == ["a"] * is_due


@pytest.mark.parametrize("kind", ["pedestrian", "bicycle"])
@pytest.mark.parametrize("changes", [changes for changes, _ in CHANGES.values()], ids=CHANGES)
def test_no_change_of_a_pedestrian_counts(kind, changes):
    then = CAR._replace(kind=kind)
    assert due({"a": after(0.3, then, **changes)}, {"a": then}) == []


@pytest.mark.parametrize(
    ("kind", "seconds", "is_due"),
    [
        ("car", 0.0, False),
        ("car", 0.5, False),
        ("car", 0.9, False),
        ("car", 0.999, False),
        ("car", 1.0, True),
        ("car", 1.1, True),
        ("motorcycle", 0.9, False),
        ("motorcycle", 1.0, True),
        ("pedestrian", 0.4, False),
        ("pedestrian", 0.499, False),
        ("pedestrian", 0.5, True),
        ("bicycle", 0.4, False),
        ("bicycle", 0.5, True),
    ],
)
def test_who_stands_is_due_after_a_second_and_a_pedestrian_after_half_of_it(kind, seconds, is_due):
    still = CAR._replace(kind=kind, speed_mps=0.0)
    assert due({"a": after(seconds, still)}, {"a": still}) == ["a"] * is_due


def test_checks_each_tenth_of_a_second_add_up_to_one():
    """Ten times .1 is less than 1 in binary, and is a second all the same."""
    time_s = CAR.time_s
    for _ in range(10):
        time_s += 0.1
    assert due({"a": CAR._replace(time_s=time_s)}, {"a": CAR}) == ["a"]


def test_new_objects_are_due_and_take_nobody_along():
    walker = CAR._replace(kind="pedestrian")
    seen = {"old": after(0.3), "new": after(0.3), "walker": after(0.3, walker)}
    assert due(seen, {"old": CAR, "walker": walker}) == ["new"]
    seen["another"] = after(0.3, walker)
    assert due(seen, {"old": CAR, "walker": walker}) == ["new", "another"]
    assert due(seen, {}) == list(seen)
    assert due({}, {"old": CAR}) == []


def test_one_pedestrian_overdue_takes_all_along_and_no_vehicle():
    walker = CAR._replace(kind="pedestrian")
    cyclist = walker._replace(kind="bicycle", time_s=CAR.time_s + 0.4)
    seen = {"cyclist": after(0.1, cyclist), "car": after(0.5), "walker": after(0.5, walker)}
    included = {"walker": walker, "cyclist": cyclist, "car": CAR}
    assert due(seen, included) == ["cyclist", "walker"]
    seen["walker"] = after(0.49, walker)
    assert due(seen, included) == []


def times(kind, speed_mps, until_s=3.0):
    """Return at which tenths of a second a road user that goes straight on is included."""
    included, tenths = {}, []
    for tenth in range(round(until_s * 10) + 1):
        time_s = tenth / 10
        now = Sighting(time_s, speed_mps * time_s, 0.0, speed_mps, 0.0, kind)
        if due({"a": now}, included):
            included["a"] = now
            tenths.append(tenth)
    return tenths


@pytest.mark.parametrize(
    ("kind", "speed_mps", "expected"),
    [
        ("car", 0.0, [0, 10, 20, 30]),  # every second
        ("car", 3.9, [0, 10, 20, 30]),  # 3.9 m in a second
        ("car", 5.0, [0, 9, 18, 27]),  # 4 m after .8 s, more after .9
        ("car", 14.0, [0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30]),  # 4.2 m in .3 s
        ("car", 41.0, list(range(31))),  # 4.1 m in a tenth
        ("pedestrian", 0.0, [0, 5, 10, 15, 20, 25, 30]),
        ("bicycle", 7.0, [0, 5, 10, 15, 20, 25, 30]),
    ],
)
def test_how_often_who_goes_straight_on_is_included(kind, speed_mps, expected):
    assert times(kind, speed_mps) == expected


@pytest.mark.parametrize(
    ("allowed_s", "expected_s"),
    [(0.025, 0.1), (0.05, 0.1), (0.1, 0.1), (0.25, 0.25), (1.0, 1.0), (2.0, 1.0)],
)
def test_the_interval_keeps_its_bounds(allowed_s, expected_s):
    assert interval_s(allowed_s) == expected_s


@pytest.mark.parametrize(("rate_hz", "expected_s"), [(1.0, 1.0), (2.5, 0.4), (10.0, 0.1)])
def test_a_rate_is_an_interval(rate_hz, expected_s):
    assert interval_of_rate(rate_hz) == expected_s


@pytest.mark.parametrize("rate_hz", [0.0, 0.99, 10.01, 20.0, -5.0, math.inf, math.nan])
def test_a_rate_that_no_standard_allows_is_refused_with_the_bounds(rate_hz):
    with pytest.raises(UserError, match=r"give 1 to 10 \(ETSI TS 103 324: one every 0.1 to 1 s\)"):
        interval_of_rate(rate_hz)
