"""Grids as typed."""

import pytest

from harness.coordination.named_points import POINTS, named_point
from harness.coordination.rules import POOLS
from harness.core.errors import UserError
from harness.studies.axes import AXES, axis_of, grid, usual_at


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0,10,20", (0, 10, 20)),
        ("0:50:10", (0, 10, 20, 30, 40, 50)),
        ("0:0.3:0.1", (0, 0.1, 0.2, 0.3)),
        ("5", (5,)),
        ("1:3", (1, 2, 3)),
        ("0, 20:30:5, 20", (0, 20, 25, 30)),
    ],
)
def test_lists_and_ranges_with_both_ends(text: str, values: tuple[float, ...]) -> None:
    assert grid(AXES["loss"], text) == pytest.approx(values)


@pytest.mark.parametrize("text", ["", "a", "1:2:0", "3:1", "1:2:3:4", "nan", "0:inf", "0:1e9:1"])
def test_what_is_no_grid_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="--grid"):
        grid(AXES["loss"], text or ",")


def test_vehicles_are_whole() -> None:
    with pytest.raises(UserError, match="whole numbers of vehicles"):
        grid(AXES["size"], "1.5")


def test_every_axis_has_a_usual_grid_that_its_point_allows() -> None:
    for axis in AXES.values():
        values = usual_at(axis, POINTS["6g"])
        assert len(values) > (axis.name != "content")  # the core has one that helpers send
        for value in values:
            axis.at(POINTS["6g"], value)


OF_SCENES = (
    "liar", "liar+spoof", "liar:says=permuted", "brake", "brake+spoof", "silent", "overconfident", "spoof",
)  # fmt: skip


@pytest.mark.parametrize(
    ("condition", "name", "usual"),
    [
        ("6g:content=objects", "attack", ("none", "ghost", "hide", "shift")),
        ("6g:content=both", "attack", ("none", *OF_SCENES, "ghost", "hide", "shift")),
        ("6g:content=oracle", "attack", ("none",)),
        ("6g:consensus=ego-prompt", "attack", ("none", *OF_SCENES)),
        ("6g:content=both,consensus=ego-prompt", "content", ("intent", "both")),
        ("mode4", "latency", (0, 5, 10, 25, 50, 100)),
    ],
)
def test_usual_words_are_those_that_a_point_allows(
    condition: str, name: str, usual: tuple[float | str, ...]
) -> None:
    assert usual_at(axis_of(name), named_point(condition)) == usual


def test_of_intents_no_attack_on_objects_is_usual() -> None:
    attacks = usual_at(axis_of("attack"), POINTS["6g"])
    assert len(attacks) == 18
    assert not {"ghost", "hide", "shift"} & {*attacks}


def test_values_take_the_axis_unit() -> None:
    point = POINTS["6g"]
    assert AXES["loss"].at(point, 0.1).radio.loss == pytest.approx(0.1)
    assert AXES["window"].at(point, 250.0).fusion.window_s == pytest.approx(0.25)
    assert AXES["latency"].at(point, 25.0).radio.latency_s == pytest.approx(0.025)
    assert AXES["consensus"].at(point, "median").fusion.consensus == "median"


def test_any_setting_is_an_axis_in_its_own_unit() -> None:
    point = POINTS["6g"]
    for name, text, settings in (
        ("radius_m", "20,50", (20.0, 50.0)),
        ("max_helpers", "0:3", (0, 1, 2, 3)),
        ("on_demand", "false,true", (False, True)),
        ("fallback", "uniform,brake", ("uniform", "brake")),
    ):
        axis = axis_of(name)
        swept = [axis.at(point, value).setting(name) for value in grid(axis, text)]
        assert swept == list(settings)
        assert list(map(type, swept)) == [type(setting) for setting in settings]
    with pytest.raises(UserError, match=r"max_helpers is 1\.5"):
        axis_of("max_helpers").at(point, 1.5)
    with pytest.raises(UserError, match="on_demand is 'perhaps'"):
        axis_of("on_demand").at(point, "perhaps")
    with pytest.raises(UserError, match="--over radius_m: no grid is usual"):
        grid(axis_of("radius_m"))


def test_unknown_axes_and_rules_name_what_there_is() -> None:
    with pytest.raises(UserError, match="--over"):
        axis_of("speed")
    with pytest.raises(UserError, match=next(iter(POOLS))):
        grid(AXES["consensus"], "mode")
