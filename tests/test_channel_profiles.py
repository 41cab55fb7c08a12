"""Channel profiles as files: what ships, a project's own, their settings, and mistakes in them."""

from dataclasses import replace
from pathlib import Path

import pytest

from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError
from harness.radio.constant import Radio
from harness.radio.profiles import CHANNELS
from harness.studies.axes import axis_of, grid

MINE = """
model = "constant"
description = "Mine."
source = "my desk"
status = "measured"
[parameters]
latency_s = 0.01
loss = 0.3
bandwidth_bps = 6e6
access = "serial"
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "channels").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path / "channels"


def test_the_papers_profiles_are_files_that_say_what_they_rest_on():
    assert CHANNELS["v2x"] == Radio(0.025, 0.08, 10e6, "serial")
    assert CHANNELS["6g"] == Radio(0.005, 0.012, 200e6, "parallel", jitter_s=0.0019)
    assert CHANNELS["density-coupled"] == replace(CHANNELS["6g"], density_coupled=True)
    assert CHANNELS.profile("v2x").status == "assumed"
    assert all(CHANNELS.profile(name).source for name in CHANNELS.usable())


def test_a_projects_profile_is_a_condition_and_changes_with_its_file(project: Path):
    (project / "mine.toml").write_text(MINE)
    point = named_point("mine:access=parallel,window=300")
    assert point.radio.profile == "mine"
    assert point.fusion.window_s == pytest.approx(0.3)
    assert point.channel == Radio(0.01, 0.3, 6e6, "parallel")
    assert point == OperatingPoint.from_dict(point.record()), "as a manifest has it"
    before = CHANNELS.record("mine")
    assert before["parameters"]["loss"] == 0.3
    (project / "mine.toml").write_text(MINE.replace("0.3", "0.25"))
    assert CHANNELS.record("mine") != before
    assert named_point("mine").channel == Radio(0.01, 0.25, 6e6, "serial")
    assert point.channel == Radio(0.01, 0.3, 6e6, "parallel"), (
        "a point keeps the channel that it was made with"
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("loss = 0.3", "loss = 3"), "[parameters]: loss = 3; allowed: a probability from 0 to 1"),
        (("loss = 0.3", "los = 0.3"), "did you mean 'loss'?"),
        (('model = "constant"', 'model = "constnat"'), "did you mean 'constant'?"),
        (('status = "measured"', 'status = "sure"'), "known: assumed, cited, measured, modelled"),
        (('source = "my desk"', ""), "has no source; add it"),
        (("[parameters]", "[parameters"), "is no TOML"),
        (
            ("[parameters]", "[limits]\nloss = [0.3, 0.1]\n[parameters]"),
            "[limits]: loss = [0.3, 0.1]; allowed: the least value, then the largest",
        ),
    ],
)
def test_a_mistake_in_a_file_is_one_line(project: Path, change: tuple[str, str], says: str):
    (project / "mine.toml").write_text(MINE.replace(*change))
    with pytest.raises(UserError) as error:
        named_point("mine")
    assert says in str(error.value)
    assert "mine.toml" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("6g:jitter_s=-1", "channel profile 6g: jitter_s = -1.0; allowed: seconds"),
        ("6g:jitter_s=much", "jitter_s = 'much'"),
        ("6g:access=any", "unknown access in channel profile 6g 'any'; known: parallel, serial"),
        ("6g:acces=serial", "did you mean 'access'?"),
        ("6g:jitter_s=0,jitter_s=1", "jitter_s is given twice"),
        ("single-local:jitter_s=1", "unknown setting of operating point single-local 'jitter_s'"),
        ("density-coupled:loss=0.1", "loss is 0.1; it must be left out where density_coupled"),
    ],
)
def test_a_setting_of_a_channel_that_is_not_allowed_is_one_line(text: str, says: str):
    with pytest.raises(UserError) as error:
        named_point(text)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_a_setting_of_a_channel_is_an_axis():
    axis = axis_of("jitter_s")
    swept = [axis.at(named_point("6g:access=serial"), value) for value in grid(axis, "0,0.001")]
    assert [point.channel.jitter_s for point in swept] == [0.0, 0.001]  # type: ignore[attr-defined]
    assert {point.channel.access for point in swept} == {"serial"}  # type: ignore[attr-defined]
    switch = axis_of("access")
    assert grid(switch, "serial,parallel") == ("serial", "parallel")
    with pytest.raises(UserError, match="unknown --over 'jiter_s'; did you mean 'jitter_s'"):
        axis_of("jiter_s")
