"""Ask a model the fixed questions, and find out what its read-outs follow: the letter, or the scene."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import fmean

from harness.backends.base import Backend, Completion
from harness.backends.findings import Findings, Moved
from harness.core.errors import UserError
from harness.evaluate import questions
from harness.evaluate.agent import Agent
from harness.evaluate.asking import answer_of
from harness.evaluate.questions import Pair

LEAST_MOVED = 0.05  # by how much the expected action becomes likelier where a fact counts
COUNT = 12 + 2 * 16  # requests that an examination asks


def examine(
    backend: Backend, agent: Agent, progress: Callable[[int], None] = lambda done: None
) -> Findings | str:
    """Ask a model the fixed questions by read-outs.

    Letters are read over cyclic orders to see what follows them, and in the pairs as the agent reads them.

    Returns:
        What was found, or why a question got no answer.
    """
    reader = replace(agent, answer="readout", letters=agent.letters if agent.answer == "readout" else None)
    pairs = questions.pairs(reader)
    asked = [
        *questions.requests(replace(reader, letters="cyclic")),
        *(half for pair in pairs for half in (pair.present, pair.absent)),
    ]
    done: list[Completion] = []
    for request in asked:
        try:
            done += backend.complete([request])
        except UserError as error:
            return str(error)
        if done[-1].error is not None:
            return done[-1].error
        progress(1)
    of_letters, rest = done[: -2 * len(pairs)], iter(done[-2 * len(pairs) :])
    changes = [
        (pair.fact, _likelihood(pair, next(rest), 0) - _likelihood(pair, next(rest), 1)) for pair in pairs
    ]
    return Findings(
        prompt=agent.prompt.version,
        letters=str(reader.letters),
        n=len(of_letters),
        letter_share=round(fmean(c.letter_share or 0.0 for c in of_letters), 4),
        follows_letter=sum(bool(c.follows_letter) for c in of_letters),
        label_mass=round(fmean(c.label_mass or 0.0 for c in of_letters), 4),
        pairs=tuple(
            _moved(fact, [change for of, change in changes if of == fact])
            for fact in dict.fromkeys(pair.fact for pair in pairs)
        ),
    )


def _moved(fact: str, changes: Sequence[float]) -> Moved:
    moved = sum(change >= LEAST_MOVED for change in changes)
    return Moved(fact, len(changes), moved, round(fmean(changes), 4))


def _likelihood(pair: Pair, completion: Completion, half: int) -> float:
    """Return how likely the expected action is in one half of a pair."""
    request = (pair.present, pair.absent)[half]
    intent = answer_of(request, completion).intent
    return intent[request.actions.index(pair.expected)] if intent else 0.0
