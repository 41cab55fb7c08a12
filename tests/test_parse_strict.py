"""Strict is what the published schema and the sum say, and nothing else."""

import json
import math
from typing import Any

import pytest
from corpus import ACTIONS, CASES
from hypothesis import given
from hypothesis import strategies as st
from judging import PLACEHOLDERS, ROLES, hundredths, judged_strict, unhurried

from harness.parsing.answer import read
from harness.parsing.parse import Parsed, Repair, Status, parse
from harness.parsing.strict import fitting
from harness.prompts.answer_schema import FORMS, Shape

NAMES = st.lists(
    st.from_regex(r"[A-Z]{2,6}(_[A-Z]{2,6})?", fullmatch=True), min_size=2, max_size=6, unique=True
)
NUMBERS = st.one_of(
    st.sampled_from([0, 1, 0.5, 0.25, 0.2, 0.3, -0.0, -0.1, 1.1, 100, 70, 20, 10]),
    st.sampled_from([True, False, None, "0.5", "50%", [], {}, math.nan, math.inf]),
    st.floats(),
)
OBJECTS = st.one_of(
    hundredths(),
    st.dictionaries(st.sampled_from([*ACTIONS, "slower", "STOP"]), NUMBERS, max_size=5),
    st.none(),
    st.text(max_size=5),
)
ANSWERS = st.fixed_dictionaries(
    {},
    optional={
        "action_distribution": OBJECTS,
        "evidence": st.one_of(
            st.sampled_from(PLACEHOLDERS),
            st.text(min_size=195, max_size=205),
            st.text(),
            st.none(),
            st.integers(),
        ),
        "risk": st.sampled_from(["low", "medium", "high", "High", "none", None, 1, []]),
        "recommended_maneuver": st.one_of(
            st.sampled_from([*ACTIONS, "idle", "STOP", None]), OBJECTS
        ),
        "maneuver": st.one_of(st.sampled_from([*ACTIONS, "idle", "STOP", None]), OBJECTS),
        "confidence": NUMBERS,
        "note": NUMBERS,
    },
)


SHAPES = st.sampled_from(
    [Shape(role, ACTIONS, form) for role in FORMS for form in (None, *FORMS[role])]
)


@unhurried
@given(ANSWERS, SHAPES)
def test_strict_is_what_the_published_schema_and_the_sum_say_of_any_object(
    value: Any, shape: Shape
) -> None:
    text = json.dumps(value)
    strict = parse(text, **shape._asdict()).status is Status.STRICT
    assert strict == judged_strict(text, shape)


@unhurried
@given(
    st.fixed_dictionaries(
        {
            "evidence": st.text(max_size=205) | st.sampled_from(PLACEHOLDERS),
            "risk": st.sampled_from(["low", "high", "High"]),
        },
        optional={
            "action_distribution": hundredths(),
            "recommended_maneuver": st.sampled_from([*ACTIONS, "idle"]),
            "confidence": st.one_of(st.floats(0, 1), NUMBERS),
        },
    ),
    SHAPES,
)
def test_strict_is_what_the_published_schema_says_of_near_valid_messages(
    value: Any, shape: Shape
) -> None:
    if shape.role == "ego":
        value = {
            key.removeprefix("recommended_"): v for key, v in value.items() if key not in REPORT
        }
    text = json.dumps(value)
    strict = parse(text, **shape._asdict()).status is Status.STRICT
    assert strict == judged_strict(text, shape)


REPORT = ("evidence", "risk")
ONLY_JSON = [c for c in CASES if not c.asked.get("thinking") and not c.asked.get("reasons_first")]


@pytest.mark.parametrize("case", ONLY_JSON, ids=lambda c: c.name)
def test_strict_is_what_the_published_schema_and_the_sum_say_of_the_corpus(case: Any) -> None:
    if case.status is Status.ENGINE_ERROR:
        return  # not judged by its text
    text = case.text.removeprefix("<think>\n\n</think>")
    asked = {name: case.asked[name] for name in ("form", "extension") if name in case.asked}
    shown = tuple(case.asked.get("placeholders", ()))
    shape = Shape(case.asked["role"], ACTIONS, **asked, placeholders=shown)
    assert (case.status is Status.STRICT) == judged_strict(text, shape)


PROSE = st.text(st.characters(exclude_characters="{｛<＜[&\\`~", codec="utf-8"), max_size=60)


@unhurried
@given(PROSE.map(lambda prose: f"So: {prose}\n"), ANSWERS, ROLES)
def test_reasons_that_were_asked_for_change_nothing_of_a_verdict(
    reasons: str, value: Any, role: str
) -> None:
    """Whatever they say and whatever stands behind them; unasked they are a repair more."""
    text = json.dumps(value)
    bare = parse(text, role=role, actions=ACTIONS)
    asked = parse(reasons + text, role=role, actions=ACTIONS, reasons_first=True)
    unasked = parse(reasons + text, role=role, actions=ACTIONS)
    if bare.verdict != "failed":
        assert (asked.status, asked.repairs, asked.intent) == (
            bare.status,
            bare.repairs,
            bare.intent,
        )
        assert unasked.status is Status.RECOVERED
        assert {*unasked.repairs} - {*bare.repairs} >= {Repair.PROSE_AROUND}
    assert (
        (asked.verdict == "failed") == (unasked.verdict == "failed") == (bare.verdict == "failed")
    )


@unhurried
@given(ANSWERS, SHAPES, st.data())
def test_strict_is_what_the_published_schema_says_of_a_text_with_a_slip(
    value: Any, shape: Shape, data: st.DataObject
) -> None:
    text = json.dumps(value, ensure_ascii=data.draw(st.booleans()))
    at = data.draw(st.integers(0, len(text)))
    added = data.draw(
        st.sampled_from(["", " ", ",", '"risk":"low",', "\\u003a", ":", "0", "1e0", "\n"])
    )
    check_readings_agree(text[:at] + added + text[at:], shape)


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_the_strict_reading_of_the_corpus_is_the_librarys(case: Any) -> None:
    for role, forms in FORMS.items():
        for form in (None, *forms):
            check_readings_agree(case.text, Shape(role, ACTIONS, form))


@pytest.mark.parametrize(
    "evidence",
    [
        "",
        "v6: left",
        "a\\u003ab",
        "max 12 words",
        "\t",
        "\x7f",
        "\x00",
        "\ud83d",
        "é" * 200,
        "é" * 201,
    ],
)
@pytest.mark.parametrize("again", ["", '"evidence":"b",', '"evidence":"b:c",', '"risk":"low",'])
def test_the_strict_reading_is_not_deceived_by_a_key_given_twice(evidence: str, again: str) -> None:
    text = f'{{{again}"evidence":"{evidence}","risk":"high","recommended_maneuver":"IDLE","confidence":1}}'
    shape = Shape("helper", ACTIONS)
    check_readings_agree(text, shape)
    unfit = ("max 12 words", "\t", "\x00", "é" * 201)
    assert (fitting(text, shape) is not None) == (again == "" and evidence not in unfit)


def check_readings_agree(text: str, shape: Shape) -> None:
    """The typed reading takes what the schema of jsonschema does,
    and reads it as the search does.
    """
    strict = fitting(text, shape)
    assert (strict is not None) == judged_strict(text, shape)
    if strict:
        assert strict == read(json.loads(text, parse_int=float), frozenset(), shape)


@unhurried
@given(NAMES.flatmap(lambda names: hundredths(tuple(names))), st.booleans())
def test_a_valid_distribution_is_strict_and_comes_back_unchanged(
    distribution: dict[str, float], indented: bool
) -> None:
    text = json.dumps({"action_distribution": distribution}, indent=2 if indented else None)
    parsed = parse(text, role="ego", actions=tuple(distribution))
    assert parsed.status is Status.STRICT
    assert parsed.intent == pytest.approx(tuple(distribution.values()), abs=1e-12)


@pytest.mark.parametrize("key", [r"\ud800", r"note\udc00", r"IDLE\ud800"])
@pytest.mark.parametrize("role", FORMS)
def test_a_key_that_no_text_can_hold_is_no_strict_answer_and_no_fault_of_ours(
    role: str, key: str
) -> None:
    """JSON may escape a lone surrogate, and a name with one cannot be written as UTF-8."""
    shares = '{"SLOWER":0.2,"IDLE":0.5,"FASTER":0.3}'
    for text in (f'{{"{key}":1,"action_distribution":{shares}}}', f'{{"{key}":{shares}}}'):
        assert parse(text, **Shape(role, ACTIONS)._asdict()).status is not Status.STRICT


@pytest.mark.parametrize("role", FORMS)
@pytest.mark.parametrize("depth", [33, 300, 600, 950, 3000])
def test_an_answer_that_nests_deep_cannot_be_read_whoever_calls(role: str, depth: int) -> None:
    """What Python's own limit allows depends on the callers; what is an answer must not."""
    inner = "[" * depth + "]" * depth

    def at(callers: int, text: str) -> Parsed:
        return at(callers - 1, text) if callers else parse(text, **Shape(role, ACTIONS)._asdict())

    for text in (
        f'{{"action_distribution":{{"SLOWER":{inner},"IDLE":0.3,"FASTER":0.7}}}}',
        '{"a":' * depth + inner + "}" * depth,
    ):
        assert at(0, text) == at(300, text)
        assert at(0, text).intent is None
    assert at(0, f'{{"a":{"[" * 31}0{"]" * 31}}}').status is Status.MISSING_ACTION
