"""The most money that a command may spend on answers, by the prices in cards."""

import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.backends.base import Backend, Completion, Request
from harness.backends.card import Card
from harness.backends.price import Price
from harness.core.errors import Unanswered, UserError, printable
from harness.core.files import appending, text_of
from harness.evaluate.costs import Asked

if TYPE_CHECKING:
    from harness.core.parallel import Workers
    from harness.evaluate.spec import Spec


@dataclass(frozen=True)
class Budget:
    """Hold the most money that a command may spend on answers, by the prices in model cards.

    A model card is a file that describes a model. Every process of the command adds what it spends
    to `file`. Called with a card and the backend (the code that runs its model), it returns a
    backend that does the same, adds its price to the file, and stops once all is spent.
    """

    most: float  # the most, in `currency`
    currency: str  # the currency of the cards' prices
    file: Path  # the amounts spent, one a line

    def __call__(self, card: Card, backend: Backend) -> Backend:
        """Return a model's backend, which asks no more once the budget is spent."""
        return backend if card.price is None else Limited(backend, card.name, card.price, self)

    def spend(self, amount: float) -> None:
        with appending(self.file) as file:
            file.write(f"{amount!r}\n".encode())

    def check(self) -> None:
        """Raise Unanswered if what all processes of the command spent so far reaches `most`."""
        spent = math.fsum(map(float, text_of(self.file, "rows").split()))
        if spent >= self.most:
            raise Unanswered(
                f"{spent:.4g} {self.currency} of --max-cost {self.most:g} are spent; all answers "
                "are kept, and the same command goes on, and may spend as much again"
            )


class Limited:
    """Wrap a backend, the code that runs a model, and add the price of its answers to a budget.

    `complete` raises Unanswered, before it asks, if the budget is spent, or if the last answers
    came without their numbers of tokens, by which a price goes. All else is as in the backend.
    """

    def __init__(self, backend: Backend, model: str, price: Price, budget: Budget) -> None:
        self._backend, self._model, self._price, self._budget = backend, model, price, budget
        self._unsaid = False  # whether all of the last answers are without their tokens

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self._budget.check()
        if self._unsaid:
            raise Unanswered(
                f"{printable(self._model)} does not say how many tokens its answers take, so "
                "--max-cost cannot hold; all answers are kept, and the same command without it "
                "goes on"
            )
        completions = self._backend.complete(requests)
        counts = Asked.of(self._model, completions)
        is_said = counts.uncounted < counts.asked
        self._unsaid = not is_said and any(each.error is None for each in completions)
        self._budget.spend(self._price.of(counts.read, counts.written))
        return completions


@contextmanager
def budget(most: float, specs: "Sequence[Spec]", workers: "Workers") -> Iterator[Budget]:
    """Enter a context with the budget that a command's evaluations share, of `most` money.

    `most` is in the currency of the models' prices, which model cards (files that describe models)
    state. `specs` are the evaluations, and `workers` is how many processes play them, or a cluster
    of them. A line on stderr names the servers' models that have no price and so do not count.
    Raises UserError if `most` is not above 0, if no card states a price or several state it in
    different currencies, or for a cluster.
    """
    option = f"--max-cost {most:g}"
    if not isinstance(workers, int):
        raise UserError(
            f"{option}: the processes of a cluster do not add up what they spend; leave it out"
        )
    if not (math.isfinite(most) and most > 0):
        raise UserError(f"{option}: give an amount above 0, in the currency of the card's [price]")
    prices = {card.price for spec in specs for card in spec.cards if card.price}
    if len(currencies := {price.currency for price in prices}) != 1:
        names = ", ".join(sorted({printable(card.name) for spec in specs for card in spec.cards}))
        reason = f"has prices in {' and '.join(sorted(currencies))}" if prices else "has no price"
        raise UserError(
            f"{option}: {names} {reason}; give its card a [price] with input, output and currency"
        )
    cards = {card.name: card for spec in specs for card in spec.cards}
    if free := sorted(
        printable(name) for name, card in cards.items() if card.server and not card.price
    ):
        print(
            f"harness: {option}: {', '.join(free)} has no price and is not counted", file=sys.stderr
        )
    with tempfile.TemporaryDirectory(prefix="swarmdrive-") as folder:
        file = Path(folder) / "spent"
        file.touch()
        yield Budget(most, currencies.pop(), file)
