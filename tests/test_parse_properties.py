"""What holds for every text, not only for those somebody thought of."""

import json
import math
from typing import Any

import pytest
from corpus import ACTIONS, CASES
from hypothesis import given
from hypothesis import strategies as st
from judging import ROLES, hundredths, unhurried

from harness.core.errors import UserError
from harness.parsing.parse import Parsed, Status, parse

PIECES = st.sampled_from(
    [
        *(
            '{"action_distribution": ',
            "{",
            "}",
            "[",
            "]",
            ",",
            ":",
            '"',
            "'",
            "“",
            "```json\n",
            "```",
            "\n",
            " ",
        ),
        *(
            '"SLOWER"',
            '"IDLE"',
            '"FASTER"',
            "SLOWER",
            "slower",
            '"evidence": "car"',
            '"risk": "high"',
            "｛",
        ),
        *(
            '"recommended_maneuver": "IDLE"',
            '"confidence": 0.8',
            "0.7",
            "0.2",
            "0.1",
            "1",
            "0",
            "-0.1",
            "0.",
            "1e",
        ),
        *(
            "<think>",
            "</think>",
            "<THINK",
            "<|im_end|>",
            "<|channel|>analysis",
            "NaN",
            "true",
            "null",
            "1e400",
        ),
        *(
            "70%",
            "20",
            "1/3",
            "//",
            "/*",
            "*/",
            "#",
            "\\",
            '\\"',
            "&quot;",
            "\ufeff",
            "\u200b",
            "\xa0",
            "\ud83d",
            "９",
        ),
        *(
            '{"SLOWER":0.7,"IDLE":0.2,"FASTER":0.1}',
            '{"SLOWER":0.1,"IDLE":0.2,"FASTER":0.7}',
            "p1",
            "...",
            "<x>",
        ),
    ]
)
ANY_TEXT = st.one_of(
    st.text(),
    st.text(st.characters(exclude_categories=())),
    st.lists(PIECES, max_size=25).map("".join),
)


def check_is_one_outcome(parsed: Parsed) -> None:
    failed = parsed.status not in (Status.STRICT, Status.RECOVERED)
    assert failed == (parsed.intent is None)
    assert bool(parsed.repairs) == (parsed.status is Status.RECOVERED)
    assert parsed.detail.isprintable()
    assert len(parsed.detail) < 800
    if parsed.intent is not None:
        assert all(0 <= p <= 1 for p in parsed.intent)
        assert math.isclose(sum(parsed.intent), 1, abs_tol=1e-12)
    if parsed.message is not None:
        json.dumps(parsed.message, ensure_ascii=False).encode()


@unhurried
@given(ANY_TEXT, ROLES, st.booleans(), st.sampled_from(["stop", "length"]))
def test_any_text_has_one_outcome(text: str, role: str, thinking: bool, finish_reason: str) -> None:
    check_is_one_outcome(
        parse(text, role=role, actions=ACTIONS, thinking=thinking, finish_reason=finish_reason)
    )


@unhurried
@given(st.sampled_from(CASES), st.data())
def test_any_piece_of_the_corpus_has_one_outcome(case: Any, data: st.DataObject) -> None:
    text = case.text[:3000]
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, len(text)))
    middle = data.draw(PIECES)
    for mutant in (text[start:end], text[:start] + text[end:], text[:start] + middle + text[end:]):
        check_is_one_outcome(parse(mutant, actions=ACTIONS, **case.asked))


@unhurried
@given(hundredths(), st.text(max_size=200), st.sampled_from(["low", "medium", "high"]))
def test_a_helper_distribution_recommends_its_most_probable_action(
    distribution: dict[str, float], evidence: str, risk: str
) -> None:
    text = json.dumps({"evidence": evidence, "risk": risk, "action_distribution": distribution})
    parsed = parse(text, role="helper", actions=ACTIONS)
    assert parsed.status is Status.STRICT
    assert parsed.message is not None
    assert parsed.message["evidence"] == evidence
    assert parsed.message["risk"] == risk
    assert parsed.message["confidence"] == pytest.approx(max(distribution.values()))
    assert distribution[parsed.message["recommended_maneuver"]] == max(distribution.values())


def test_an_unknown_role_is_the_callers_mistake() -> None:
    with pytest.raises(UserError, match="unknown role 'egg'; did you mean 'ego'"):
        parse("", role="egg", actions=ACTIONS)
