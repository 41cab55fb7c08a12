"""The audit finds a scenario that gives its danger away, and lets one be that does not."""

import json
import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import one_way_crossing
import pytest

from harness.core.errors import UserError
from harness.dataset.build import build
from harness.dataset.load import load
from harness.extensions.audit.tells import FOLDS, HiddenPoints, Ranks, _hidden, audit, judge
from harness.world import scenarios
from harness.world.scenarios.occluded_intersection import NAME, SCENARIO, Parameters, layout

pytestmark = pytest.mark.skipif(find_spec("sklearn") is None, reason="needs the audit extra")


def moments(numbers, danger):
    """One moment a layout."""
    n, names = len(danger), tuple(f"number {k}" for k in range(numbers.shape[1]))
    return HiddenPoints(np.arange(n), np.zeros(n, dtype=int), np.array(danger), names, numbers)


def quiet(done):
    pass


# -- ranks, by hand --------------------------------------------------------------------------------


def test_an_auc_is_the_share_of_pairs_in_their_order_and_a_tie_is_half():
    score, there = np.array([0.9, 0.4, 0.4, 0.1, 0.95]), np.array([True, True, False, False, False])
    ranks = Ranks.compare(np.arange(5), np.zeros(5, dtype=int), score, there)
    assert ranks.auc == pytest.approx((2 + 1.5) / 6)
    assert ranks.estimate().n == 5


def test_only_points_that_are_alike_are_compared():
    """Late moments rank high whatever is hidden: that fewer dangers are left then is no tell."""
    score, there = np.array([0.2, 0.1, 0.8, 0.9]), np.array([True, False, True, False])
    assert Ranks.compare(np.arange(4), np.array([0, 0, 1, 1]), score, there).auc == 0.5


def test_no_interval_has_zero_width():
    there = np.array([True, False] * 10)
    found = Ranks.compare(
        np.arange(20), np.zeros(20, dtype=int), there.astype(float), there
    ).estimate()
    assert (found.value, found.high) == (1.0, 1.0)
    assert found.low == pytest.approx(10 / (10 + 1.96**2), abs=1e-4)  # Wilson, 10 of 10


def test_layouts_are_drawn_whole():
    """Ten moments that are copies of one say no more than it does."""
    layout, there, score = (
        np.arange(40),
        np.arange(40) % 2 == 0,
        np.random.default_rng(0).random(40),
    )
    once = Ranks.compare(layout, np.zeros(40, dtype=int), score, there).estimate()
    copies = (np.repeat(of, 10) for of in (layout, score, there))
    often = Ranks.compare(next(copies), np.tile(np.arange(10), 40), *copies).estimate()
    assert (often.low, often.high) == pytest.approx((once.low, once.high))


# -- the classifier on numbers whose answer is known -----------------------------------------------


@pytest.fixture
def known():
    """200 made-up layouts: eight numbers of noise; danger from two sectors, or none."""
    rng = np.random.default_rng(1)
    return rng.normal(size=(200, 8)), rng.choice(["left", "right", "", ""], 200)


@pytest.mark.slow
def test_noise_tells_nothing(known):
    auc, told_by = judge(moments(*known), ("left", "right"))
    assert set(auc) == {"danger", "left", "right"}
    assert all(found.low < 0.5 < found.high for found in auc.values())
    assert told_by == {}


@pytest.mark.slow
def test_a_number_that_tells_is_found_and_named(known):
    table, danger = known
    table[:, 5] += 4.0 * (danger == "left")
    auc, told_by = judge(moments(table, danger), ("left", "right"))
    assert auc["left"].value > 0.95
    assert auc["right"].value < auc["danger"].value < auc["left"].value
    assert next(iter(told_by)) == "number 5"


@pytest.mark.slow
def test_what_is_known_only_where_there_is_danger_tells_too(known):
    table, danger = known
    table[danger == "", 2] = np.nan
    auc, told_by = judge(moments(table, danger), ("left", "right"))
    assert auc["danger"].value == 1.0
    assert list(told_by) == ["number 2"]


@pytest.mark.exhaustive
def test_a_number_of_which_one_fold_alone_knows_anything_is_left_out(known):
    """Where that fold's model learns, scikit-learn would have nothing to bin."""
    from sklearn.model_selection import StratifiedGroupKFold

    table, danger = known
    splits = StratifiedGroupKFold(FOLDS, shuffle=True, random_state=0).split(
        table, danger, np.arange(200)
    )
    learnt, _ = next(iter(splits))
    table[learnt, 2] = np.nan
    auc, _ = judge(moments(table, danger), ("left", "right"))
    assert auc == judge(moments(np.delete(table, 2, axis=1), danger), ("left", "right"))[0]


# -- scenarios -------------------------------------------------------------------------------------


def telling(seed, parameters):
    """As the scenario once was: where a danger comes from a side,
    the truck in sight is farther away.
    """
    found = layout(seed, parameters)
    moved = [
        replace(s, arc_m=s.arc_m - 45.0) if s.kind == "truck" and found.danger else s
        for s in found.spawns
    ]
    return replace(found, spawns=tuple(moved))


@pytest.mark.exhaustive
def test_a_truck_that_is_elsewhere_where_there_is_danger_is_found():
    dials = Parameters(
        danger_share=0.5, sector_shares=(0.5, 0.5, 0.0), decisions=2, time_limit_s=2.0
    )
    found = audit(replace(SCENARIO, layout=telling, parameters=dials), 40, 0, quiet)
    assert found.tells
    assert found.auc["danger"].value > 0.95
    assert found.auc["danger"].low > 0.75
    # what a truck that is farther away hides
    assert list(found.told_by) == ["oncoming: seen_share"]


@pytest.mark.slow
def test_a_car_that_is_heard_to_be_harmless_is_no_tell(monkeypatch):
    """What is judged is the same, to the last number, whether or not traffic says where it is."""
    judged = []

    def noted(points, sectors):
        judged.append(points)
        return {}, {}

    monkeypatch.setattr("harness.extensions.audit.tells.judge", noted)
    silent, loud = (scenarios.get(f"hard-brake-ahead:radio_share={share}") for share in (0, 1))
    for each in (silent, loud):
        audit(
            replace(each, parameters=replace(each.parameters, decisions=1, time_limit_s=1.0)),
            14,
            10,
            quiet,
        )
    for name in ("layout", "step", "danger", "names", "numbers"):
        np.testing.assert_array_equal(*(getattr(points, name) for points in judged))


@pytest.mark.slow
def test_a_scenario_that_hides_nothing_has_nothing_to_audit():
    with pytest.raises(UserError, match=r"one-way-crossing hides no danger: most are in sight"):
        audit(one_way_crossing.SCENARIO, 10, 0, quiet)


@pytest.mark.slow
def test_too_few_layouts_are_refused(harness):
    code, out, err = harness("dataset", "scenario", "audit", NAME, "--layouts", 4, "--workers", 1)
    assert (code, out) == (2, "")
    assert "an audit needs 5, give more with --layouts" in err
    code, _, err = harness("dataset", "scenario", "audit", NAME, "--layouts", 0)
    assert (code, err) == (2, "harness: --layouts 0 is out of range; give 1 to 100000\n")


def test_without_scikit_learn_one_line_says_what_to_install(harness, monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn", None)
    code, out, err = harness("dataset", "scenario", "audit", NAME)
    assert (code, out) == (2, "")
    install = "pip install 'swarmdrive-harness[audit]'"
    assert err == f"harness: an audit needs scikit-learn, which is not installed; run `{install}`\n"


@pytest.mark.slow
def test_the_command_says_the_same_to_people_and_to_machines(harness, monkeypatch):
    """Each layout is driven once, for both."""
    driven = {}

    def remembered(scenario, seed):
        if seed not in driven:
            driven[seed] = _hidden(scenario, seed)
        return driven[seed]

    monkeypatch.setattr("harness.extensions.audit.tells._hidden", remembered)
    words = ("dataset", "scenario", "audit", NAME, "--layouts", 20, "--seed", 42, "--workers", 1)
    code, out, err = harness(*words, "--json")
    found = json.loads(out)
    assert err == ""
    assert (found["layouts"], found["seed"], found["steps"][0]) == (20, 42, 0)
    assert set(found["auc"]) <= {"danger", "left", "right", "oncoming"}
    assert found["auc"]["danger"]["n"] == 20
    assert found["tells"] == (found["auc"][found["worst"]]["value"] > 0.6) == (code == 1)
    again, text, _ = harness(*words)
    assert again == code
    assert "n = 20 layouts, layout seeds 42 to 61 (tune);" in text
    assert f"{found['auc']['danger']['value']:.2f} [" in text
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.exhaustive
def test_the_card_of_a_dataset_says_what_its_audit_found(tmp_path, monkeypatch):
    dials = Parameters(
        danger_share=0.5, sector_shares=(1.0, 0.0, 0.0), decisions=1, time_limit_s=1.0
    )
    scenario, counted = replace(SCENARIO, parameters=dials), []
    monkeypatch.setattr("harness.dataset.build.LEAST_AUDITED", 20)
    build(scenario, tmp_path / "audited", 20, 0, 1, quiet, more=counted.append)
    auc = audit(scenario, 20, 0, quiet).auc["danger"]
    card = (tmp_path / "audited/README.md").read_text()
    assert f"with an AUC of {auc.value:.2f} [{auc.low:.2f}, {auc.high:.2f}]\n" in card
    assert "n = 20 layouts" in card
    assert "--no-audit" not in card
    assert card.startswith("# audited\n")
    assert load(tmp_path / "audited").manifest.name == "audited"
    assert counted == [20]
    monkeypatch.setattr("harness.dataset.build.AUDITS", {})
    build(scenario, tmp_path / "unaudited", 20, 0, 1, quiet, more=counted.append)
    card = (tmp_path / "unaudited/README.md").read_text()
    assert "\nNot audited for tells.\n" in card
    assert "--no-audit" in card
    assert counted == [20], "without the extension there is no audit"
