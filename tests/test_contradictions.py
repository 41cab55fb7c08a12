"""A card beside what its weights say of themselves."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("gguf", reason="needs the transformers extra")

import tiny_llama

from harness.backends import cards
from harness.backends.card import Card
from harness.backends.weights import contradictions


@pytest.fixture
def tiny(tmp_path: Path) -> Card:
    """The card of a file that says MIT and 512 tokens."""
    return cards.resolve(str(tiny_llama.build(tmp_path / "tiny.gguf")))


def test_a_card_that_says_what_its_file_does_is_not_at_odds(tiny: Card) -> None:
    assert list(contradictions(tiny)) == []
    assert list(contradictions(replace(tiny, licence="MIT", context_tokens=512))) == []
    assert list(contradictions(replace(tiny, licence=None, context_tokens=100))) == []


def test_another_licence_and_a_longer_context_are_a_line_each(tiny: Card) -> None:
    licence, context = contradictions(replace(tiny, licence="Apache-2.0", context_tokens=513))
    assert licence.startswith("licence Apache-2.0 by its card, mit by its file; ")
    assert context.startswith("context of 513 tokens by its card, 512 by its weights: ")


@pytest.mark.parametrize(
    ("config", "lines"),
    [
        ({"max_position_embeddings": 100}, 1),
        ({"text_config": {"max_position_embeddings": 100}}, 1),
        ({"max_position_embeddings": 200}, 0),
        ({"max_position_embeddings": "many"}, 0),
        ({}, 0),
        ([], 0),
    ],
)
def test_a_checkpoint_says_its_context_in_its_config(
    config: object, lines: int, tmp_path: Path
) -> None:
    for name in ("model.safetensors", "tokenizer.json"):
        (tmp_path / name).write_text("{}")
    (tmp_path / "config.json").write_text(json.dumps(config))
    card = Card(
        "mine", "transformers", "Mine", cards.load("swarm-tiny").latency, weights=str(tmp_path)
    )
    assert len(list(contradictions(replace(card, context_tokens=101)))) == lines


def test_what_ships_is_not_at_odds() -> None:
    for name in ("swarm-tiny", "swarm-tiny-six", "swarm-tiny-six-v2", "swarm-tiny-vl"):
        for card in cards.each_engine(name):
            assert list(contradictions(card)) == []
