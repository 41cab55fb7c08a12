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


TURN = 16  # tokens that a chat's template puts around a message, at the most
PIXELS = 32  # of a picture that a token has at the least, where makers' price lists say it


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

    `complete` raises Unanswered, before it asks, if the budget is spent, or if all of the last
    answers came without their numbers of tokens, by which a price goes. Of one among others that
    has none, the most that it can be is spent, and a line on stderr says so. All else is as in the
    backend.
    """

    def __init__(self, backend: Backend, model: str, price: Price, budget: Budget) -> None:
        self._backend, self._model, self._price, self._budget = backend, model, price, budget
        self._unsaid = False  # whether all of the last answers are without their tokens
        self._has_said = False  # that some are

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        if self._unsaid:
            raise Unanswered(
                f"{printable(self._model)} does not say how many tokens its answers take, so "
                "--max-cost cannot hold; all answers are kept, and the same command without it "
                "goes on"
            )
        self._budget.check()
        completions = self._backend.complete(requests)
        pairs = zip(requests, completions, strict=True)
        self._budget.spend(math.fsum(self._price.of(*most_tokens(*pair)) for pair in pairs))
        answers = [each for each in completions if each.error is None]
        counts = Asked.of(self._model, answers)
        self._unsaid = counts.asked == counts.uncounted > 0
        if 0 < counts.uncounted < counts.asked and not self._has_said:
            self._has_said = True
            print(
                f"harness: --max-cost {self._budget.most:g}: {printable(self._model)} does not say "
                "how many tokens some of its answers take; these count as the most they can be",
                file=sys.stderr,
            )
        return completions


def most_tokens(request: Request, completion: Completion) -> tuple[int, int]:
    """Return the numbers of tokens of a prompt and its answer, or the most that they can be.

    What is stated is taken. Else a token has one byte of its text at least, or `PIXELS`, and
    thoughts are in no text. A question that failed takes none.
    """
    read, written = completion.prompt_tokens, completion.completion_tokens
    if completion.error is not None:
        return read or 0, written or 0
    if read is None:
        chats = (request.messages, *request.orders, *request.flips)
        messages = [message for chat in chats for message in chat]
        read = sum(TURN + len(message["content"].encode()) for message in messages)
        if request.image:
            height, width, _ = request.image.pixels.shape
            read += len(chats) * -(-height * width // PIXELS)
    if written is None:
        of_text = TURN + len(completion.text.encode())
        written = request.max_tokens if request.thinking else min(of_text, request.max_tokens)
    return read, written


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
