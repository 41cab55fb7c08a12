"""The published schema, played by hand."""

from typing import Any

import jsonschema
import pytest

from harness.core.errors import UserError
from harness.prompts.answer_schema import answer_schema

ACTIONS = ("LANE_LEFT", "IDLE")
HALVES = {"LANE_LEFT": 0.5, "IDLE": 0.5}
REPORT = {"evidence": "car from the west", "risk": "high"}


def fits(role: str, answer: Any) -> bool:
    return jsonschema.Draft202012Validator(answer_schema(role, ACTIONS)).is_valid(answer)


@pytest.mark.parametrize("role", ["ego", "helper"])
def test_the_schema_is_one_of_draft_2020_12(role: str) -> None:
    jsonschema.Draft202012Validator.check_schema(
        answer_schema(role, ACTIONS, "occluded-intersection")
    )


def test_the_title_names_role_and_scenario() -> None:
    assert (
        answer_schema("ego", ACTIONS, "occluded-intersection")["title"]
        == "ego answer, occluded-intersection"
    )


def test_an_ego_gives_every_action_a_probability_and_nothing_else() -> None:
    assert fits("ego", {"action_distribution": HALVES})
    assert not fits("ego", {"action_distribution": {"IDLE": 1}})
    assert not fits("ego", {"action_distribution": HALVES | {"STOP": 0}})
    assert not fits("ego", {"action_distribution": {"LANE_LEFT": -0.1, "IDLE": 1}})
    assert not fits("ego", {"action_distribution": {"LANE_LEFT": True, "IDLE": 0}})
    assert not fits("ego", {"action_distribution": HALVES} | REPORT)
    assert not fits("ego", HALVES)


def test_a_helper_gives_a_recommendation_or_a_distribution_but_not_both() -> None:
    recommendation = {"recommended_maneuver": "IDLE", "confidence": 0.8}
    assert fits("helper", REPORT | recommendation)
    assert fits("helper", REPORT | {"action_distribution": HALVES})
    assert not fits("helper", REPORT)
    assert not fits("helper", recommendation)
    assert not fits("helper", REPORT | recommendation | {"action_distribution": HALVES})
    assert not fits("helper", REPORT | recommendation | {"recommended_maneuver": "STOP"})
    assert not fits("helper", REPORT | recommendation | {"risk": "critical"})
    assert not fits("helper", REPORT | recommendation | {"evidence": "x" * 201})


def test_an_unknown_role_is_named_with_those_known() -> None:
    with pytest.raises(UserError, match="unknown role 'driver'; known: ego, helper"):
        answer_schema("driver", ACTIONS)
