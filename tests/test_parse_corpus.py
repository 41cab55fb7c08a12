"""Every completion of the corpus gets the status in its name,
and just the repairs that are written down.
"""

import pytest
from corpus import ACTIONS, CASES, Case

from harness.parsing.parse import Repair, Status, parse

MESSAGE = ("evidence", "risk", "recommended_maneuver", "confidence")


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_completion_gives_what_its_name_says(case: Case) -> None:
    parsed = parse(case.text, actions=ACTIONS, **case.asked)
    assert parsed.status is case.status, parsed
    expected = case.expected
    assert list(parsed.repairs) == expected.get("repairs", [])
    if parsed.verdict == "failed":
        assert parsed.faults[0] is case.status
        assert list(parsed.faults) == expected.get("faults", list(parsed.faults))
        assert parsed.intent is None
        assert parsed.message is None
    else:
        assert parsed.faults == ()
        assert sum(parsed.intent) == pytest.approx(1, abs=1e-12)
        assert set(parsed.message or ()) == (
            set(MESSAGE) if case.asked["role"] == "helper" else set()
        )
    if "intent" in expected:
        assert parsed.intent == pytest.approx(expected["intent"], abs=1e-9)
    if "mass" in expected:
        assert parsed.mass == pytest.approx(expected["mass"], abs=1e-9)
    if "message" in expected:
        assert parsed.message == dict.fromkeys(MESSAGE) | expected["message"]
    if "reasoning" in expected:
        assert parsed.reasoning == expected["reasoning"]


def test_the_prefix_of_a_file_tells_whether_it_gives_an_intent() -> None:
    for case in CASES:
        gives = case.status in (Status.STRICT, Status.RECOVERED)
        assert case.name[0] in ("y" if gives else "n", "i"), case.name


def test_every_choice_of_the_parser_says_why() -> None:
    for case in CASES:
        assert ("why" in case.expected) == case.name.startswith("i_"), case.name


def test_every_recovered_completion_has_its_repairs_written_down() -> None:
    for case in CASES:
        assert ("repairs" in case.expected) == (case.status is Status.RECOVERED), case.name


def test_the_corpus_shows_every_status_and_every_repair() -> None:
    # A refusal is not read from an answer's text: a server states it.
    assert {case.status for case in CASES} == {*Status} - {Status.REFUSED}
    assert {repair for case in CASES for repair in case.expected.get("repairs", ())} == set(Repair)


@pytest.mark.parametrize(
    ("name", "detail"),
    [
        ("n_conflicting_answers_evidence_in_two_pieces",
         "beside the answer stands a part of another one, which names no action"),
        ("n_conflicting_answers_two_one_level_deeper",
         "if_not repeats what stands beside it in another object"),
        ("n_conflicting_answers_in_schema_and_beside", 
            "2 answers stand in the "
            "text and they differ"),
        ("n_missing_action_distribution_as_cut_text",
         "what stands for the distribution is a text, and none of JSON"),
    ],
)  # fmt: skip
def test_the_cause_that_is_named_is_true(name: str, detail: str) -> None:
    [case] = [case for case in CASES if case.name == name]
    assert parse(case.text, actions=ACTIONS, **case.asked).detail == detail


@pytest.mark.parametrize(
    ("unit", "status", "detail"),
    [
        ('{"a":', Status.SYNTAX, "more than 3 braces that open no JSON object"),
        ('{\\"a\\":', Status.SYNTAX, "more than 4 braces that open no JSON object"),
        ("{}", Status.SYNTAX, "more than 5000 JSON objects"),
        ("</think>", Status.EMPTY, "there is no answer in the text"),
        ("<think>x</think>", Status.EMPTY, "there is no answer in the text"),
        ("\\", Status.NO_JSON, "there is no JSON object in the text"),
    ],
)
def test_a_megabyte_of_noise_is_given_up_before_it_takes_minutes(
    unit: str, status: Status, detail: str
) -> None:
    """Seconds by size: benchmarks/campaigns/sizes.py. Here: tries are few where each is long."""
    parsed = parse(unit * (1_000_000 // len(unit)), role="ego", actions=ACTIONS)
    assert (parsed.status, parsed.detail) == (status, detail)


@pytest.mark.parametrize(
    "opening", ["<think>", "<thinking>\n", "[think] ", "<|channel|>analysis ", "```\n<reasoning>"]
)
@pytest.mark.parametrize("thinking", [True, False])
def test_a_thought_after_an_answer_is_not_called_one_before_it(
    opening: str, thinking: bool
) -> None:
    answer = '{"action_distribution": {"SLOWER": 0.7, "IDLE": 0.2, "FASTER": 0.1}}'
    parsed = parse(f"{answer}\n{opening}hm", role="ego", actions=ACTIONS, thinking=thinking)
    assert parsed.status is Status.TRUNCATED_REASONING
    assert parsed.detail.endswith("it may overturn what stands before it")
    begun = parse(
        f"{opening.removeprefix('```')}hm", role="ego", actions=ACTIONS, thinking=thinking
    )
    assert begun.detail == "the thought was not closed, so no answer was begun"
