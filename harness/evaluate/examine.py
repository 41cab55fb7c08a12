"""Ask a model the fixed questions, and find out what its read-outs follow: the letter, or the scene."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from statistics import fmean

from harness.backends.base import Backend, Completion, Request
from harness.backends.findings import Findings, Moved
from harness.core.errors import UserError
from harness.evaluate import questions
from harness.evaluate.agent import Agent
from harness.evaluate.asking import answer_of
from harness.evaluate.questions import Fact, Pair

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
    pairs = [*questions.scene_pairs(reader), *questions.plain_pairs(reader)]
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
    return Findings(
        prompt=agent.prompt.version,
        letters=str(reader.letters),
        n=len(of_letters),
        letter_share=round(fmean(c.letter_share or 0.0 for c in of_letters), 4),
        follows_letter=sum(bool(c.follows_letter) for c in of_letters),
        label_mass=round(fmean(c.label_mass or 0.0 for c in of_letters), 4),
        pairs=moved(pairs, rest),
    )


def moved(pairs: Sequence[Pair], completions: Iterator[Completion]) -> tuple[Moved, ...]:
    """Return by fact how the answers to some pairs moved, of the pairs of which both halves can be read.

    A pair has two completions: with the fact, and without.
    """
    changes: dict[Fact, list[float]] = {}
    for pair in pairs:
        likely = [_likelihood(pair, half, next(completions)) for half in (pair.present, pair.absent)]
        readable = [p for p in likely if p is not None]
        of_fact = changes.setdefault(pair.fact, [])
        if len(readable) == len(likely):
            of_fact.append(readable[0] - readable[1])
    return tuple(
        Moved(fact, len(all_), sum(c >= LEAST_MOVED for c in all_), round(fmean(all_), 4) if all_ else 0.0)
        for fact, all_ in changes.items()
    )


def _likelihood(pair: Pair, half: Request, completion: Completion) -> float | None:
    """Return how likely the expected action is in one half of a pair; None if that cannot be read."""
    intent = answer_of(half, completion).intent
    return intent[half.actions.index(pair.expected)] if intent else None
