"""How fast each engine of a card answers on this machine, shortly timed.
It advises, and decides nothing.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from harness.backends.card import Card
from harness.backends.cards import each_engine, names
from harness.backends.registry import locate, missing, open_backend
from harness.core.errors import Unanswered, UserError
from harness.evaluate.agent import Agent
from harness.extensions.checkups import questions
from harness.prompts import versions

PROMPT = "v2"
TOKENS = 16  # of text that are timed
MOST_BYTES = 10**9  # of weights: larger ones take more than seconds
CLEAR = 1.2  # times as fast as another, which chance on a shared machine does not make


@dataclass(frozen=True)
class Pace:
    """Hold how many seconds a model takes on one engine for a short answer and for a longer one.

    An engine is code that runs a model, such as llama.cpp. Each answer was asked alone after a
    warm-up, on this machine.
    """

    engine: str  # its name
    readout_s: float  # seconds of a read-out (letters in one order)
    text_s: float  # seconds of the first `TOKENS` tokens of a free answer


def paces(stem: str) -> list[Pace]:
    """Return how many seconds a model's answers take on each engine that can run it here.

    An engine is code that runs a model, such as llama.cpp; a model card is a file that describes a
    model and names its engines. `stem` is the card's name without an engine's, such as `qwen3-4b`.
    The list is empty unless there are several engines and the weights are small. Raises UserError
    if weights do not load or the model cannot answer, and Unanswered if an answer fails.
    """
    able = [card for card in each_engine(stem) if missing(card) is None] if stem in names() else []
    if len(able) < 2 or not all(is_small(card) for card in able):
        return []
    return [_pace(card) for card in able]


def by_card(stems: Sequence[str], progress: Callable[[int], None]) -> dict[str, list[Pace]]:
    """Return how many seconds the answers of several models take on each engine, by model.

    It serves to advise which engine to use. An engine is code that runs a model, such as llama.cpp;
    a model card is a file that describes a model. `stems` are names of cards without an engine's
    name, and the keys of the result; a value has an entry for each engine. A model is left out if
    there is nothing to choose (fewer than two engines here, or large weights), or if it cannot be
    asked. `progress` is called with 1 after each model.
    """
    measured = {}
    for stem in stems:
        # what is wrong with a card is said where cards are listed
        with suppress(UserError, Unanswered):
            measured[stem] = paces(stem)
        progress(1)
    return {stem: each for stem, each in measured.items() if each}


def advice(measured: Sequence[Pace]) -> str:
    """Return a line that says which engine of a model is faster here, and how to choose it.

    `measured` has the times of two engines or more. One is faster for an answer of a kind (by
    letters, or in text) if it is so by a clear margin (`CLEAR`).
    """
    engines = " and ".join(pace.engine for pace in measured)
    by_letters = _fastest(measured, [pace.readout_s for pace in measured])
    by_text = _fastest(measured, [pace.text_s for pace in measured])
    if by_letters == by_text:
        verdict = f"{by_text or 'neither'} is faster here"
    else:
        verdict = (
            f"faster here: {by_letters or 'neither'} for read-outs, {by_text or 'neither'} for text"
        )
    letters_s = " and ".join(f"{pace.readout_s:.2g} s" for pace in measured)
    text_s = " and ".join(f"{pace.text_s:.2g} s" for pace in measured)
    return (
        f"{verdict}; --engine chooses. On {engines}: a read-out {letters_s}, {TOKENS} tokens of "
        f"text {text_s}"
    )


def _fastest(measured: Sequence[Pace], seconds: Sequence[float]) -> str | None:
    """Return the engine that is clearly the fastest; None if none is."""
    first, second, *_ = sorted(seconds)
    return measured[seconds.index(first)].engine if second >= CLEAR * first else None


def is_small(card: Card) -> bool:
    """Return whether a model's files are small enough to be timed by the way."""
    where = locate(card)
    files = [file for file in where.rglob("*") if file.is_file()] if where.is_dir() else [where]
    return sum(file.stat().st_size for file in files) <= MOST_BYTES


def _pace(card: Card) -> Pace:
    """Return how long a read-out and a text take on a card's engine. Raises Unanswered."""
    backend = open_backend(card, batch_size=1)
    took: list[float] = []
    try:
        for answer in ("readout", "json"):
            letters = "raw" if answer == "readout" else None
            agent = Agent(card, versions.load(PROMPT), answer, letters=letters)  # type: ignore[arg-type]
            for request in questions.requests(agent)[:2]:  # the first warms up
                [done] = backend.complete([request.alike(max_tokens=TOKENS)])
                if done.seconds is None:
                    raise Unanswered(f"{card.name}: no answer to be timed: {done.error}")
                seconds = done.seconds
            took.append(seconds)
    finally:
        getattr(backend, "close", lambda: None)()
    return Pace(card.engine, *took)
