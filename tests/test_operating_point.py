"""What an operating point may hold, and what the user reads when it may not."""

import math
from dataclasses import replace

import pytest

from harness.coordination.named_points import POINTS, SHORT, named_point
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError
from harness.radio.profiles import CHANNELS
from harness.studies.axes import AXES


def test_the_paper_has_three_operating_points_that_differ_only_in_the_channel():
    assert {name: point.radio.profile for name, point in POINTS.items()} == {
        "single-local": None,
        "v2x": "v2x",
        "6g": "6g",
    }
    assert len({point.changed(name="x", profile=None) for point in POINTS.values()}) == 1


def test_the_cloud_is_the_lone_ego_with_a_round_trip():
    assert named_point("cloud") == POINTS["single-local"].changed(name="cloud", round_trip_s=0.51)
    assert named_point("cloud:round_trip_s=0.3").cloud.round_trip_s == 0.3
    assert named_point("6g:round_trip_s=0.3").cloud.round_trip_s == 0.3


@pytest.mark.parametrize("point", POINTS.values(), ids=POINTS)
def test_a_point_survives_its_own_dictionary(point):
    assert OperatingPoint.from_dict(point.record()) == point


def test_a_table_without_a_profile_disables_v2v():
    assert OperatingPoint.from_dict({"name": "alone"}).radio.profile is None


def test_one_and_one_point_zero_are_the_same_setting():
    assert repr(OperatingPoint.of("x", "6g", tau_nats=1)) == repr(
        OperatingPoint.of("x", "6g", tau_nats=1.0)
    )


def test_zero_threshold_zero_loss_and_zero_helpers_are_allowed():
    point = OperatingPoint.of("x", "6g", tau_nats=0, loss=0, max_helpers=0)
    assert (point.ask.tau_nats, point.radio.loss, point.ask.max_helpers) == (0.0, 0.0, 0)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"tau_nat": 0.7}, "unknown operating point setting 'tau_nat'; did you mean 'tau_nats'?"),
        ({"profile": "v2v"}, "unknown channel profile 'v2v'; did you mean 'v2x'? known: 6g, "),
        ({"profile": ["v2x"]}, "profile is ['v2x']; it must be a text"),
        ({"fallback": "break"}, "unknown fallback 'break'; did you mean 'brake'?"),
        ({"consensus": "log"}, "unknown consensus 'log'"),
        ({"tau_nats": -0.1}, "tau_nats is -0.1; it must be a finite number of nats, 0 or more"),
        ({"tau_nats": math.nan}, "tau_nats is nan"),
        ({"tau_nats": math.inf}, "tau_nats is inf"),
        ({"tau_nats": 1e30}, "nats, 0 or more, and no larger than 9.2e+18"),
        ({"tau_nats": 10**400}, "tau_nats is 1000"),
        ({"tau_nats": True}, "tau_nats is True"),
        ({"tau_nats": "0.7"}, "tau_nats is '0.7'"),
        ({"window_s": 0}, "window_s is 0; it must be seconds above 0"),
        ({"radius_m": 0.0}, "radius_m is 0.0; it must be metres above 0"),
        ({"min_distance_m": 0}, "min_distance_m is 0; it must be metres above 0"),
        ({"ego_distance_m": 0}, "ego_distance_m is 0; it must be metres above 0"),
        ({"loss": 1.01}, "loss is 1.01; it must be a probability from 0 to 1"),
        ({"max_helpers": 2.0}, "max_helpers is 2.0; it must be a whole number, 0 or more"),
        ({"max_helpers": True}, "max_helpers is True"),
        ({"max_helpers": -1}, "max_helpers is -1"),
        ({"density_coupled": 1}, "density_coupled is 1; it must be true or false"),
        ({"name": " "}, "operating point name ' ': give it some text"),
    ],
)
def test_a_setting_that_is_not_allowed_is_one_line_that_names_it(settings, says):
    with pytest.raises(UserError) as error:
        OperatingPoint.from_dict({"name": "mine", "profile": "6g", **settings})
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_a_point_needs_a_name():
    with pytest.raises(UserError, match="without a name"):
        OperatingPoint.from_dict({"profile": "6g"})


def test_an_unknown_point_is_told_the_nearest():
    assert named_point("6g") is POINTS["6g"]
    with pytest.raises(UserError, match="did you mean 'v2x'"):
        named_point("v2xx")


def test_every_other_channel_profile_is_a_point_of_its_own_name(monkeypatch):
    fog = replace(CHANNELS["6g"], loss=0.5)
    monkeypatch.setitem(CHANNELS._loaded, "fog", fog)
    assert named_point("fog") == OperatingPoint.of("fog", "fog")
    assert named_point("fog:loss=0.2") == OperatingPoint.of("fog:loss=0.2", "fog", loss=0.2)
    assert named_point("fog:window_s=0.3").channel == fog
    with pytest.raises(
        UserError, match="setting of operating point fog 'windows_s'; did you mean 'window_s'"
    ):
        named_point("fog:windows_s=0.3")


def test_a_change_of_a_point_is_called_by_its_text():
    point = named_point("6g:consensus=median,window_s=0.4,max_helpers=2,on_demand=true,loss=0.1")
    assert point == OperatingPoint.of(
        "6g:consensus=median,window_s=0.4,max_helpers=2,on_demand=true,loss=0.1", "6g",
        consensus="median", window_s=0.4, max_helpers=2, on_demand=True, loss=0.1,
    )  # fmt: skip
    assert named_point("single-local:fallback=brake").fusion.fallback == "brake"


@pytest.mark.parametrize("name", SHORT)
def test_a_name_of_a_sweeps_axis_means_the_same_in_a_condition(name):
    asked, swept = named_point(f"6g:{name}=0.3"), AXES[name].at(POINTS["6g"], 0.3)
    assert replace(asked, name="6g") == swept != POINTS["6g"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("6g:", "unknown setting of operating point 6g ''"),
        ("6g:windows_s=0.3", "did you mean 'window_s'?"),
        ("6g:profile=v2x", "unknown setting of operating point 6g 'profile'"),
        ("6g:tau_nats", "tau_nats has no value; give it one, as in 6g:window_s=0.3"),
        ("6g:max_helpers=1.5", "max_helpers is '1.5'; it must be a whole number"),
        ("6g:on_demand=yes", "on_demand is 'yes'; it must be true or false"),
        ("6g:loss=nan", "loss is nan; it must be a probability"),
        ("6g:loss=0.1,loss=0.2", "loss is given twice"),
        ("6g:consensus=linear:tau=0", "joined by commas, as in 6g:consensus=linear,tau=0"),
        ("6g:window=300,window_s=0.2", "window_s is given twice"),
        ("6g:consensus=vote", "unknown consensus 'vote'"),
        ("6g:messages=none", "unknown messages 'none'"),
        ("cloud:round_trip=lte", "unknown round_trip 'lte'; known: 5g-city, us-drive"),
        ("6g:content=word", "unknown content 'word'"),
        ("6g:rounds=4", "rounds is 4; it must be a whole number from 1 to 3"),
    ],
)
def test_a_change_that_is_not_allowed_is_one_line(text, says):
    with pytest.raises(UserError) as error:
        named_point(text)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_only_a_point_with_a_channel_asks_again():
    assert named_point("v2x:consensus=ego-prompt").has_fusion_call
    assert not named_point("v2x").has_fusion_call
    assert not named_point("single-local:consensus=ego-prompt").has_fusion_call


@pytest.mark.parametrize("setting", ["loss=.1", "latency_s=0.1", "density_coupled=true"])
def test_a_setting_of_the_channel_is_refused_where_there_is_none(setting: str) -> None:
    with pytest.raises(
        UserError, match=r"single-local has no channel, so .* changes nothing; leave it out"
    ):
        named_point(f"single-local:{setting}")


TABLE = "distance_m,reception,latency_ms\n0,1,20\n400,0,30\n"


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project with channels of tables,
    one of which has latencies and ends where nothing is received.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "channels").mkdir()
    for name, table in (("timed", TABLE), ("untimed", "distance_m,reception\n0,1\n400,0.5\n")):
        (tmp_path / f"channels/{name}.csv").write_text(table)
        (tmp_path / f"channels/{name}.toml").write_text(
            f'model = "trace"\ndescription = "x"\nsource = "x"\nstatus = "assumed"\n'
            f'[parameters]\nfile = "{name}.csv"\n'
        )


IDLE = [
    ("timed", "latency_s", "its table timed.csv has latencies of its own"),
    ("timed", "beyond", "its table timed.csv ends where nothing is received"),
    ("untimed:loss=0.1", "beyond", "its loss is given"),
    ("timed", "helper_rounds", "the load of its channel does not depend on it"),
    ("6g:schedule=margin", "tau_nats", "schedule margin has a threshold of its own"),
    ("6g:schedule=never", "loss", "schedule never asks nobody"),
    ("6g:schedule=never", None, "schedule never asks nobody"),
    ("6g:max_helpers=0", "consensus", "max_helpers is 0, so it asks nobody"),
    ("6g:consensus=ego-prompt", "weight_cap", "consensus ego-prompt weighs no distances"),
    ("6g:consensus=bayes", "min_distance_m", "consensus bayes weighs no distances"),
    ("cloud", "tau_nats", "it has no channel"),
    *(
        (f"6g:content={content}", setting, f"content {content} holds no intents")
        for content, setting in (
            ("objects", "consensus"), ("objects", "weight_cap"), ("objects", "min_distance_m"),
            ("objects", "ego_distance_m"), ("objects", "on_demand"), ("oracle", "consensus"),
            ("oracle", "helper_rounds"),
        )
    ),
]  # fmt: skip


@pytest.mark.parametrize(("condition", "setting", "why"), IDLE)
def test_a_setting_that_changes_nothing_says_why(project, condition, setting, why):
    assert named_point(condition).idle(setting) == why


@pytest.mark.parametrize(
    ("condition", "setting"),
    [
        ("untimed", "latency_s"), ("untimed", "beyond"), ("6g", "latency_s"),
        ("6g:schedule=margin,helper_rounds=true", "tau_nats"),
        ("6g:schedule=never", "schedule"), ("6g:max_helpers=0", "max_helpers"), ("6g", None),
        ("6g:schedule=never", "fallback"), ("6g", "weight_cap"), ("cloud", "round_trip_s"),
        ("6g:content=both", "consensus"), ("6g:content=objects", "fallback"),
        ("6g:content=objects", "content"),
    ],
)  # fmt: skip
def test_a_setting_that_may_change_something_says_nothing(project, condition, setting):
    assert named_point(condition).idle(setting) is None
