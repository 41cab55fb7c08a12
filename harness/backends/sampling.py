"""Which token comes next: the likeliest, or one drawn at a temperature.

Draws are keyed by what the model reads and by which answer it is, so company, order and a resume change none.
"""

import time
from collections.abc import Sequence

import numpy as np

from harness.backends.base import Request
from harness.backends.engine import Session
from harness.core import noise
from harness.core.arrays import Floats


class Choice:
    """Chooses the tokens of some answers: a uniform draw for each token of those that are drawn.

    Attributes:
        first_at_s: when the first was there, by `time.perf_counter`; None before.
        rounds: how often some were chosen: of an answer alone, its tokens.
    """

    def __init__(self, requests: Sequence[Request], prompts: Sequence[Sequence[int]]) -> None:
        self.first_at_s: float | None = None
        self.rounds = 0
        self._drawn = {
            place: (request.temperature, noise.generator("answer", tuple(ids), request.sample))
            for place, (request, ids) in enumerate(zip(requests, prompts, strict=True))
            if request.temperature
        }

    def next(
        self, session: Session, places: Sequence[int], among: Sequence[Sequence[int] | None]
    ) -> list[int]:
        """The next token of each sequence of a session, of those listed for it or of all where None.

        Args:
            session: whose sequences are those of `places`, in order.
            places: of their requests.
            among: tokens that are allowed.
        """
        chosen = session.argmax(among)
        if self._drawn:
            log_p = session.log_probs()
            for row, (place, tokens) in enumerate(zip(places, among, strict=True)):
                if place in self._drawn:
                    temperature, generator = self._drawn[place]
                    chosen[row] = drawn(log_p[row], tokens, temperature, generator.random())
        if not self.rounds:
            self.first_at_s = time.perf_counter()
        self.rounds += 1
        return chosen


def drawn(log_p: Floats, among: Sequence[int] | None, temperature: float, u: float) -> int:
    """The token that a uniform draw means, of softmax(log_p / temperature) over those that are allowed.

    Args:
        log_p: log-probabilities of the vocabulary.
        among: the tokens that are allowed; None for all.
        temperature: above 0.
        u: in [0, 1).
    """
    tokens = np.arange(len(log_p)) if among is None else np.unique(among)
    with np.errstate(over="ignore"):  # far below the likeliest there is no probability left
        ends = np.exp((log_p[tokens] - log_p[tokens].max()) / temperature).cumsum()
    last = np.searchsorted(ends, ends[-1])  # rounding may take a draw beyond it
    return int(tokens[min(np.searchsorted(ends, u * ends[-1], side="right"), last)])
