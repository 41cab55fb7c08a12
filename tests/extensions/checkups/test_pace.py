"""Which engine of a card is faster here: timed shortly, and said in one line."""

from dataclasses import replace

import pytest

from harness.backends import cards
from harness.backends.card import Dtype
from harness.extensions.checkups import number_formats, pace
from harness.extensions.checkups.number_formats import FormatPace, chosen_format, format_paces
from harness.extensions.checkups.pace import Pace, advice, paces


def of(*seconds: tuple[float, float]) -> list[Pace]:
    return [Pace(engine, *pair) for engine, pair in zip("abc", seconds, strict=False)]


@pytest.mark.parametrize(
    ("found", "says"),
    [
        (of((0.4, 0.5), (1.6, 0.9)), "a is faster here; --engine chooses."),
        (of((1.6, 0.5), (0.4, 0.9)), "faster here: b for read-outs, a for text; --engine chooses."),
        (
            of((1.0, 0.5), (1.1, 0.9)),
            "faster here: neither for read-outs, a for text; --engine chooses.",
        ),
        (of((1.0, 1.0), (1.1, 0.9)), "neither is faster here; --engine chooses."),
        (of((3.0, 3.0), (2.9, 2.9), (1.0, 1.0)), "c is faster here; --engine chooses."),
    ],
)
def test_only_a_clear_difference_makes_an_engine_the_faster_one(
    found: list[Pace], says: str
) -> None:
    assert advice(found).startswith(says)


def test_the_line_has_every_figure() -> None:
    assert advice(of((0.4, 0.51), (1.66, 0.9))).endswith(
        " On a and b: a read-out 0.4 s and 1.7 s, 16 tokens of text 0.51 s and 0.9 s"
    )


@pytest.mark.slow
def test_a_small_card_of_both_engines_is_timed_on_both() -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    found = pace.by_card(["proxy", "swarm-tiny"], lambda done: None)
    assert list(found) == ["swarm-tiny"]
    assert {each.engine for each in found["swarm-tiny"]} == {"transformers", "llama-cpp"}
    assert all(0 < s < 60 for each in found["swarm-tiny"] for s in (each.readout_s, each.text_s))


def test_what_has_one_engine_or_large_weights_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert paces("proxy") == paces("./no-card") == []
    monkeypatch.setattr(pace, "MOST_BYTES", 1000)
    monkeypatch.setattr(pace, "_pace", lambda card: pytest.fail("opened"))
    assert paces("swarm-tiny") == []


def test_a_line_says_what_each_number_format_brings_and_which_is_taken() -> None:
    measured = [
        FormatPace("float32", 1234.5, 100.0, (0, 1, 2, None)),
        FormatPace("bfloat16", 2500.0, 150.0, (0, 1, 1, None)),
    ]
    assert number_formats.advice(measured, "float32", "its card says so") == (
        "float32 1234 tokens a CPU second in read-outs and 100 in text, bfloat16 2500 tokens a "
        "CPU second in read-outs and 150 in text; 2 of 4 prompts read alike; float32 is taken: "
        "its card says so"
    )


@pytest.mark.parametrize(
    ("engine", "stated", "typed", "chosen"),
    [
        ("transformers", "float32", None, ("float32", "its card says so")),
        ("transformers", "float32", "bfloat16", ("bfloat16", "it was typed")),
        ("transformers", "float32", "auto",
            ("float32", "this processor does not multiply in bfloat16")),
        ("openvino", "auto", None, ("auto", "openvino chooses")),
    ],
)  # fmt: skip
def test_the_number_format_is_typed_or_the_cards_or_chosen(
    engine: str, stated: Dtype, typed: str | None, chosen: tuple[str, str]
) -> None:
    card = replace(cards.load("swarm-tiny:transformers"), engine=engine, dtype=stated)
    assert chosen_format(card, typed) == chosen


@pytest.mark.slow
def test_small_weights_are_timed_in_both_number_formats_on_a_cpu() -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    card = cards.load("swarm-tiny:transformers")
    measured = format_paces(card, "cpu")
    assert [each.dtype for each in measured] == ["float32", "bfloat16"]
    assert all(each.readout_rate > 0 and each.text_rate > 0 for each in measured)
    assert {len(each.actions) for each in measured} == {12}
    assert None not in measured[0].actions
    assert format_paces(card, "cuda") == format_paces(cards.load("swarm-tiny"), "cpu") == []
