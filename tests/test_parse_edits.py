"""Damaged, cut and doubled answers: a changed intent is never passed off as the model's."""

import json

from corpus import ACTIONS
from hypothesis import given
from hypothesis import strategies as st
from judging import ego, hundredths, judged_strict, unhurried

from harness.parsing.parse import Status
from harness.prompts.answer_schema import Shape

# The sum is the checksum. One edited character changes a distribution in hundredths by 0.01 or
# more, or by a third decimal, which is at most 0.009. So a changed intent is never exact, but for
# that decimal's 0.001.


def mutants(text: str, at: int, character: str) -> list[str]:
    return [
        text[:at] + text[at + 1 :],
        text[:at] + character + text[at + 1 :],
        text[:at] + character + text[at:],
    ]


EDITS = st.one_of(st.sampled_from("0123456789.,:{}[]\"-+eE%#/ \n\\x'"), st.characters())


@unhurried
@given(hundredths(), st.data(), EDITS)
def test_one_edited_character_never_changes_an_intent_unseen(
    distribution: dict[str, float], data: st.DataObject, character: str
) -> None:
    text = json.dumps({"action_distribution": distribution}, separators=(",", ":"))
    at = data.draw(st.integers(0, len(text) - 1))
    original = ego(text).intent
    assert original is not None
    for mutant in mutants(text, at, character):
        parsed = ego(mutant)
        if parsed.intent is None:
            continue
        if parsed.status is Status.STRICT:
            assert judged_strict(mutant, Shape("ego", ACTIONS))
        change = max(abs(p - q) for p, q in zip(parsed.intent, original, strict=True))
        assert change <= (0.026 if "renormalised" in parsed.repairs else 0.0011), mutant


@unhurried
@given(hundredths(), st.data())
def test_an_answer_cut_anywhere_by_the_token_limit_gives_no_intent(
    distribution: dict[str, float], data: st.DataObject
) -> None:
    text = json.dumps({"action_distribution": distribution})
    cut = text[: data.draw(st.integers(1, len(text) - 1))]
    assert ego(cut, finish_reason="length").status is Status.TRUNCATED_JSON


@unhurried
@given(
    hundredths(), st.text(alphabet="ab {}\"'\n.", max_size=20), st.text(max_size=20), st.booleans()
)
def test_a_draft_in_an_open_thought_is_never_an_answer(
    distribution: dict[str, float], before: str, after: str, thinking: bool
) -> None:
    draft = json.dumps({"action_distribution": distribution})
    for tag in ("<think>", "<THINK>", "<thinking>", "< think>", "<|think|>", "[THINK]"):
        text = f"{tag}{before}{draft}{after.replace('<', '').replace('[', '')}"
        assert ego(text, thinking=thinking).status is Status.TRUNCATED_REASONING


@unhurried
@given(hundredths(), hundredths())
def test_two_answers_are_one_only_if_they_are_the_same(
    first: dict[str, float], second: dict[str, float]
) -> None:
    parsed = ego(
        f"Initially {json.dumps(first)} but finally {json.dumps({'action_distribution': second})}"
    )
    if first == second:
        assert "repeated_answer" in parsed.repairs
    else:
        assert parsed.status is Status.CONFLICTING_ANSWERS
