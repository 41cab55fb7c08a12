"""The calibrated proxy: its story played by hand, and what must hold of it whatever its parameters."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from harness.coordination.operating_point import POINTS, OperatingPoint
from harness.coordination.trigger import entropy_nats
from harness.core.arrays import Bools, Floats
from harness.studies.calibrated import ACTIONS, STEPS, Calibrated, Parameters, peaked, spread
from harness.studies.fit import fit
from harness.studies.play import Walked

SURE = OperatingPoint("6g", "6g", loss=0.0)  # nothing is lost


def walked(source: Calibrated, point: OperatingPoint, vehicles: int = 4, seed: int = 0) -> Walked:
    return next(source.walked(point, vehicles, [seed]))


def success(source: Calibrated, point: OperatingPoint, vehicles: int = 4, seed: int = 0) -> Bools:
    return ends(walked(source, point, vehicles, seed))


def ends(made: Walked) -> Bools:
    return made.ends["success_rate"][0] == 1.0


def by_episode(made: Walked, name: str) -> Floats:
    """A column of the decisions, (E, S)."""
    in_order = np.argsort(made.places, kind="stable")  # decisions of an episode come in their order
    return made.columns[name][in_order].reshape(len(made.episodes), STEPS)


def test_the_shipped_parameters_are_what_the_fit_gives():
    assert fit() == Parameters()


@pytest.mark.parametrize("nats", [0.1, 0.45, 0.82, 1.05])
def test_an_intent_has_the_entropy_that_was_asked_for(nats: float):
    p = peaked(np.array([nats, nats]), np.array([0, 2]))
    assert entropy_nats(p) == pytest.approx([nats, nats], abs=1e-3)
    assert p.argmax(axis=1).tolist() == [0, 2]


def test_draws_keep_to_their_range():
    drawn = spread(0.82, 0.045, np.linspace(0.0, 1.0, 10_001))
    assert drawn.min() >= 0.82 - 2.45 * 0.045 - 1e-9
    assert drawn.max() <= 0.82 + 2.45 * 0.045 + 1e-9
    assert drawn.mean() == pytest.approx(0.82, abs=1e-3)


def test_an_ego_that_never_guesses_right_is_saved_by_the_witness_alone():
    """Every danger comes from the first approach: one helper saves everyone, and only that one."""
    fools = Parameters(left_share=1.0, right_share=0.0, guess_right=0.0, know_right=1.0)
    source = Calibrated(200, fools)
    assert not success(source, POINTS["single-local"]).any()
    assert success(source, SURE, vehicles=2).all()
    assert success(source, SURE, vehicles=4).all()
    elsewhere = Calibrated(200, replace(fools, left_share=0.0, right_share=1.0))
    assert not success(elsewhere, SURE, vehicles=2).any()
    assert success(elsewhere, SURE, vehicles=3).all()


def test_what_nobody_reads_rightly_no_message_saves():
    source = Calibrated(200, Parameters(guess_right=0.0, know_right=0.0))
    assert not success(source, SURE).any()


def test_on_a_serial_channel_the_third_reply_is_late():
    """145 + 3 x 25 ms: whoever depends on the third helper is not saved."""
    third = Calibrated(100, Parameters(left_share=0.0, right_share=0.0, guess_right=0.0, know_right=1.0))
    serial = replace(POINTS["v2x"], loss=0.0)
    assert not success(third, serial).any()
    assert success(third, replace(serial, window_s=0.25)).all()


def test_an_ego_that_has_heard_keeps_what_it_learnt():
    """It hears the witness while it asks; in the last decision it asks nobody, and is right."""
    source = Calibrated(300, Parameters(guess_right=0.0, know_right=1.0))
    made = walked(source, replace(SURE, tau_nats=0.85))
    asked = by_episode(made, "triggered") == 1.0
    quiet_at_last = asked[:, :-1].any(axis=1) & ~asked[:, -1]
    assert quiet_at_last.any()
    assert ends(made)[quiet_at_last].all()
    assert not ends(made)[~asked.any(axis=1)].any()


def test_alone_in_the_swarm_is_alone():
    source = Calibrated(300)
    crowded = replace(POINTS["6g"], density_coupled=True)
    assert (success(source, crowded, vehicles=1) == success(source, POINTS["single-local"])).all()


def test_a_threshold_above_the_largest_entropy_is_as_good_as_no_channel():
    source = Calibrated(300)
    deaf = replace(POINTS["6g"], tau_nats=float(np.log(ACTIONS)))
    made = walked(source, deaf)
    assert not made.columns["triggered"].any()
    assert (ends(made) == success(source, POINTS["single-local"])).all()


def test_more_loss_saves_nobody_who_was_lost_with_less():
    source = Calibrated(400)
    saved = [success(source, replace(POINTS["6g"], loss=loss)) for loss in (0.0, 0.1, 0.3, 0.6, 1.0)]
    for less, more in pairwise(saved):
        assert (less >= more).all()


def test_more_helpers_change_nothing_of_the_first_ones_draws():
    source = Calibrated(50)
    two, four = (source._draw(3, helpers, 0) for helpers in (2, 4))
    assert np.array_equal(two.draws.link, four.draws.link[:, :2])
    assert np.array_equal(two.intents.helpers, four.intents.helpers[:, :2])
    assert np.array_equal(two.intents.own, four.intents.own)


def test_helpers_that_are_unsure_load_the_channel():
    """Below every entropy four vehicles transmit: 6.6 %; above the helpers' only the ego does."""
    source = Calibrated(50)
    busy = replace(POINTS["6g"], helper_rounds=True)
    low = walked(source, replace(busy, tau_nats=0.2))
    high = walked(source, replace(busy, tau_nats=0.7))
    assert low.columns["effective_loss"] == pytest.approx(np.full(50 * STEPS, 0.066))
    assert high.columns["effective_loss"] == pytest.approx(np.full(50 * STEPS, 0.012))
