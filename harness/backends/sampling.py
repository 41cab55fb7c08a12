"""Choose the next token: the likeliest, or one drawn at a temperature.

Draws are keyed by the prompt and the answer's number, so other requests, order and a resume change none.
"""

import time
from collections.abc import Sequence

import numpy as np

from harness.backends.base import Request
from harness.backends.engine import Session
from harness.core import noise
from harness.core.arrays import Floats


class Choice:
    """Chooses the tokens of some answers; each sampled token takes one uniform draw."""

    def __init__(self, requests: Sequence[Request], prompts: Sequence[Sequence[int]]) -> None:
        self.first_at_s: float | None = None  # when the first token was chosen, by `time.perf_counter`
        self.rounds = 0  # calls of `next`: the number of chosen tokens of an answer that is asked alone
        self._drawn = {
            place: (request.temperature, noise.generator("answer", tuple(ids), request.sample))
            for place, (request, ids) in enumerate(zip(requests, prompts, strict=True))
            if request.temperature
        }
        self.draws = bool(self._drawn)  # whether any token is drawn and not just the likeliest

    def next(
        self, session: Session, places: Sequence[int], among: Sequence[Sequence[int] | None]
    ) -> list[int]:
        """Choose the next token of the request at each place, in a session, among some tokens (None: all)."""
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
    """Return the token of a draw from softmax(log_p / temperature) over the tokens of `among` (None: all).

    `u` is the uniform draw, in [0, 1). The temperature is above 0.
    """
    tokens = np.arange(len(log_p)) if among is None else np.unique(among)
    with np.errstate(over="ignore"):  # a token far below the likeliest gets probability 0
        ends = np.exp((log_p[tokens] - log_p[tokens].max()) / temperature).cumsum()
    last = np.searchsorted(ends, ends[-1])  # rounding may take a draw beyond the last possible token
    return int(tokens[min(np.searchsorted(ends, u * ends[-1], side="right"), last)])
