"""The fixed text of a constrained answer:
what stands, what is chosen, and how it is walked in tokens.
"""

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.backends.skeleton import TWO_DIGITS, Filled, Skeleton, start, tokens_after
from harness.backends.tokens import tokenizer
from harness.core.errors import UserError
from harness.parsing.parse import Status, parse
from harness.prompts.answer_schema import Shape, answer_schema

THREE = ("SLOWER", "IDLE", "FASTER")
FIVE = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
KINDS = [("ego", "distribution"), ("helper", "distribution"), ("helper", "recommendation")]
QWEN = Path(__file__).parents[2] / "shared" / "tokenizer" / "qwen2-vocab-only.gguf"


class Encoder:
    """What a skeleton asks of a chat: its name, and texts in tokens."""

    def __init__(self, name: str, encode: Callable[[str], list[int]]) -> None:
        self.subject, self.encode = f"model {name!r}", encode


def characters(text: str) -> list[int]:
    return [ord(c) for c in text]


CHARACTERS: Any = Encoder("characters", characters)


def of(source: Path) -> Any:
    loaded = tokenizer(source)
    return Encoder(source.name, lambda text: loaded.encode(text, add_special_tokens=False).ids)


@pytest.fixture(scope="module", params=["characters", "tiny", "qwen"])
def chat(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    if request.param == "characters":
        return CHARACTERS
    if request.param == "qwen":
        if not QWEN.is_file():
            pytest.skip("Qwen's vocabulary is not here")
        return of(QWEN)
    pytest.importorskip("torch", reason="needs the transformers extra")
    import tiny_qwen3

    return of(tiny_qwen3.build(tmp_path_factory.mktemp("tiny")))


def parts(shape: Shape) -> list[str | tuple[str, ...]]:
    """The fixed texts of an answer without lists or texts, and between them what is chosen from."""
    found: list[str | tuple[str, ...]] = []
    way = start(shape).branches[0]
    while way.then:
        found += [way.text, way.then.options]
        way = way.then.branches[0]
    return [*found, way.text]


def finished(shape: Shape, chosen: list[int]) -> str:
    places = iter(chosen)
    return "".join(p if isinstance(p, str) else p[next(places)] for p in parts(shape))


def played(
    skeleton: Skeleton, choose: Callable[[Any], int]
) -> tuple[list[int], list[list[int]], Filled]:
    """A whole walk: the tokens before its last decision, what stood to choose, and the answer."""
    walk: Any = skeleton.walk()
    ids, choices = [], []
    ask = next(walk)
    while True:
        token = choose(ask.among)
        ids += ask.forced
        choices.append(ask.among)
        try:
            ask = walk.send(token)
        except StopIteration as end:
            return ids, choices, end.value


# -- the text --------------------------------------------------------------------------------------


def test_the_egos_text_is_a_distribution_with_two_digits_an_action() -> None:
    assert parts(Shape("ego", THREE, "distribution")) == [
        '{"action_distribution":{"SLOWER":0.', TWO_DIGITS,
        ',"IDLE":0.', TWO_DIGITS,
        ',"FASTER":0.', TWO_DIGITS,
        "}}",
    ]  # fmt: skip


def test_a_helper_says_its_risk_first_and_has_no_words_for_evidence() -> None:
    assert parts(Shape("helper", ("GO", "STOP"), "distribution")) == [
        '{"evidence":"","risk":"', ("low", "medium", "high"),
        '","action_distribution":{"GO":0.', TWO_DIGITS,
        ',"STOP":0.', TWO_DIGITS,
        "}}",
    ]  # fmt: skip
    assert parts(Shape("helper", ("GO", "STOP"), "recommendation")) == [
        '{"evidence":"","risk":"', ("low", "medium", "high"),
        '","recommended_maneuver":"', ("GO", "STOP"),
        '","confidence":0.', TWO_DIGITS,
        "}",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("digits", "text", "intent", "repairs"),
    [
        ([70, 20, 10], '"SLOWER":0.70,"IDLE":0.20,"FASTER":0.10', (0.7, 0.2, 0.1), []),
        (
            [99, 0, 0],
            '"SLOWER":0.99,"IDLE":0.00,"FASTER":0.00',
            (1, 0, 0),
            ["renormalised"],
        ),  # 1.00 was meant
        (
            [99, 99, 99],
            '"SLOWER":0.99,"IDLE":0.99,"FASTER":0.99',
            (1 / 3, 1 / 3, 1 / 3),
            ["divided"],
        ),
        ([1, 1, 0], '"SLOWER":0.01,"IDLE":0.01,"FASTER":0.00', (0.5, 0.5, 0), ["divided"]),
        ([0, 0, 0], '"SLOWER":0.00,"IDLE":0.00,"FASTER":0.00', None, []),  # nothing said
    ],
)
def test_the_digits_are_kept_and_their_sum_is_divided_out_when_they_are_read(
    digits: list[int], text: str, intent: tuple[float, ...] | None, repairs: list[str]
) -> None:
    written = finished(Shape("ego", THREE, "distribution"), digits)
    assert written == f'{{"action_distribution":{{{text}}}}}'
    parsed = parse(written, role="ego", actions=THREE, divides=True)
    assert parsed.intent == (None if intent is None else pytest.approx(intent))
    assert list(parsed.repairs) == repairs
    assert (parsed.status is Status.BAD_SUM) == (intent is None)


def test_a_recommendation_keeps_its_confidence() -> None:
    assert finished(Shape("helper", THREE, "recommendation"), [2, 1, 7]) == (
        '{"evidence":"","risk":"high","recommended_maneuver":"IDLE","confidence":0.07}'
    )


@given(st.data(), st.sampled_from(KINDS), st.sampled_from([THREE, FIVE, ("GO", 'say "x"\\')]))
def test_every_filling_fits_the_schema_and_is_read_as_it_stands(
    data: st.DataObject, kind: tuple[str, str], actions: tuple[str, ...]
) -> None:
    role, form = kind
    options = [p for p in parts(Shape(role, actions, form)) if not isinstance(p, str)]
    chosen = [data.draw(st.integers(0, len(option) - 1)) for option in options]
    text = finished(Shape(role, actions, form), chosen)
    jsonschema.validate(json.loads(text), answer_schema(role, actions))
    parsed = parse(text, role=role, actions=actions, divides=True)
    if form != "distribution" and role == "helper":
        assert parsed.status is Status.STRICT
        return
    digits = chosen[-len(actions) :]
    assert {*parsed.repairs} <= {"renormalised", "divided"}
    assert parsed.mass == pytest.approx(sum(digits) / 100)
    assert (parsed.intent is None) == (not any(digits))
    if parsed.intent is not None:
        assert parsed.intent == pytest.approx(tuple(n / sum(digits) for n in digits))


# -- the walk --------------------------------------------------------------------------------------


@pytest.mark.parametrize("actions", [THREE, FIVE], ids=["three", "five"])
@pytest.mark.parametrize("kind", KINDS, ids="-".join)
def test_the_tokens_are_those_of_the_whole_text(
    chat: Any, kind: tuple[str, str], actions: tuple[str, ...]
) -> None:
    skeleton = Skeleton(chat, Shape(kind[0], actions, kind[1]))
    for seed in range(100):
        ids, choices, done = played(skeleton, random.Random(seed).choice)
        whole = chat.encode(done.text)
        assert ids == whole[: len(ids)], "another cut than the tokenizer's own"
        assert done.tokens == len(whole) <= skeleton.most_tokens
        assert all(among == sorted(set(among)) and len(among) > 1 for among in choices)


def test_labels_that_begin_alike_are_decided_where_they_part() -> None:
    skeleton = Skeleton(
        CHARACTERS, Shape("helper", ("LANE_LEFT", "LANE_RIGHT", "IDLE"), "recommendation")
    )
    said = iter("hLR07")
    ids, choices, done = played(skeleton, lambda among: ord(next(said)))
    assert ["".join(map(chr, among)) for among in choices] == [
        "hlm",  # risk: high, low, medium
        "IL",  # IDLE, or one of the lanes
        "LR",  # behind LANE_, which nobody was asked for
        "0123456789",
        "0123456789",
    ]
    assert "".join(map(chr, ids)) == (
        '{"evidence":"","risk":"high","recommended_maneuver":"LANE_RIGHT","confidence":0.0'
    )
    assert done.text == "".join(map(chr, ids)) + "7}"


@pytest.mark.skipif(not QWEN.is_file(), reason="Qwen's vocabulary is not here")
def test_in_qwens_vocabulary_the_lanes_share_two_tokens_and_are_one_decision() -> None:
    qwen = of(QWEN)
    left, right = qwen.encode("LANE_LEFT"), qwen.encode("LANE_RIGHT")
    assert left[:2] == right[:2]
    assert len(left) == len(right) == 3
    skeleton = Skeleton(qwen, Shape("helper", ("LANE_LEFT", "LANE_RIGHT"), "recommendation"))
    _, choices, done = played(skeleton, max)
    assert choices[1] == sorted([left[2], right[2]])
    assert ('"LANE_LEFT"' in done.text) == (left[2] > right[2])


@pytest.mark.parametrize(("said", "maneuver"), [('l"07', "SLOW"), ("lE07", "SLOWER")])
def test_a_label_that_is_another_ones_beginning_ends_with_its_quote(
    said: str, maneuver: str
) -> None:
    actions = ("SLOWER", "SLOW")
    skeleton = Skeleton(CHARACTERS, Shape("helper", actions, "recommendation"))
    tokens = iter(said)
    ids, choices, done = played(skeleton, lambda among: ord(next(tokens)))
    assert "".join(map(chr, choices[1])) == '"E'
    assert f'maneuver":"{maneuver}","conf' in "".join(map(chr, ids)), "the quote stands once"
    assert done.text == "".join(map(chr, ids)) + "7}"


def test_a_tokenizer_that_merges_digits_is_asked_for_both_at_once() -> None:
    def pairs(text: str) -> list[int]:
        """Characters, but two digits are one token."""
        ids, at = [], 0
        while at < len(text):
            two = text[at : at + 2].isdigit() and len(text[at : at + 2]) == 2
            ids.append(100000 + int(text[at : at + 2]) if two else ord(text[at]))
            at += 2 if two else 1
        return ids

    merging: Any = Encoder("merging", pairs)
    _, choices, done = played(Skeleton(merging, Shape("ego", ("GO",), "distribution")), max)
    assert choices == [[100000 + n for n in range(100)]]
    assert done.text == '{"action_distribution":{"GO":0.99}}'


def test_a_tokenizer_that_marks_a_beginning_marks_none_inside_the_text() -> None:
    marking: Any = Encoder("marking", lambda text: [0, *characters(text)])
    assert tokens_after(marking, "0.", "70") == tuple(characters("70"))


def test_where_a_token_spans_the_cut_the_text_alone_is_taken() -> None:
    spanning: Any = Encoder("spanning", lambda text: [7] if text == "ab" else characters(text))
    assert tokens_after(spanning, "a", "b") == (ord("b"),)


def test_a_tokenizer_that_cannot_tell_labels_apart_is_refused() -> None:
    blind: Any = Encoder("blind", lambda text: [min(ord(c), 128) for c in text])
    with pytest.raises(UserError, match=r"'blind'.*tell the choices.*--answer json"):
        Skeleton(blind, Shape("helper", ("é", "è"), "recommendation"))


def test_an_ego_may_be_asked_for_one_action_and_a_confidence() -> None:
    pieces = parts(Shape("ego", ("SLOWER", "IDLE"), "maneuver"))
    assert pieces == ['{"maneuver":"', ("SLOWER", "IDLE"), '","confidence":0.', TWO_DIGITS, "}"]
    text = finished(Shape("ego", ("SLOWER", "IDLE"), "maneuver"), [1, 70])
    jsonschema.validate(json.loads(text), answer_schema("ego", ("SLOWER", "IDLE"), form="maneuver"))
    assert parse(text, role="ego", actions=("SLOWER", "IDLE")).intent == pytest.approx((0.3, 0.7))
