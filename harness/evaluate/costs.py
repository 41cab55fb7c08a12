"""What a run's questions cost, by the price in a card; and the most that a command may spend.

Every completion that a model with a price is asked for counts, whatever becomes of it; one from the
cache costs nothing. Each part of a run appends to a file in the working folder, so that a stopped
run goes on counting.
"""

import math
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from harness.backends.base import Backend, Completion, Request
from harness.backends.card import Card
from harness.backends.price import Price
from harness.core.errors import Unanswered, UserError, printable
from harness.core.files import appending, bytes_of, text_of
from harness.runs.records import Cost

if TYPE_CHECKING:
    from harness.evaluate.spec import Spec

FILE = "costs.jsonl"


class Asked(msgspec.Struct, frozen=True):
    """Hold the token counts of completions that one model was asked for in one call."""

    model: str
    asked: int  # number of completions
    uncounted: int  # how many of them have no token counts: failed ones, as a rule
    read: int  # tokens of the others' prompts
    written: int  # tokens of their answers


@dataclass(frozen=True)
class Budget:
    """Hold the most money that a command may spend; its processes add up amounts in a file."""

    most: float  # amount, in `currency`
    currency: str
    file: Path  # the amounts spent, one a line

    def spend(self, amount: float) -> None:
        with appending(self.file) as file:
            file.write(f"{amount!r}\n".encode())

    def check(self) -> None:
        """Raise Unanswered if the budget is spent."""
        spent = math.fsum(map(float, text_of(self.file, "rows").split()))
        if spent >= self.most:
            raise Unanswered(
                f"{spent:.4g} {self.currency} of --max-cost {self.most:g} are spent; all answers "
                "are kept, and the same command goes on, and may spend as much again"
            )


@contextmanager
def budget(most: float | None, specs: "Sequence[Spec]") -> Iterator[Budget | None]:
    """Enter a context with the budget that a command's evaluations share, of `most` money.

    It is None if `most` is None. A line on stderr names the servers' models that have no price and
    so do not count. Raises UserError if `most` is not above 0, or no card or cards in several
    currencies state a price.
    """
    if most is None:
        yield None
        return
    option = f"--max-cost {most:g}"
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


def metered(
    cards: Sequence[Card], backends: Sequence[Backend], work: Path | None, limit: Budget | None
) -> list[Backend]:
    """Return the backends, each whose card has a price wrapped so that its cost is counted.

    Counts go to a file in the working folder `work`, and to `limit` if there is one; with `work`
    None, only to `limit`.
    """
    return [
        backend if card.price is None else Metered(backend, card.name, card.price, work, limit)
        for card, backend in zip(cards, backends, strict=True)
    ]


class Metered:
    """Wrap a backend and count the tokens and the price of its completions.

    `complete` raises Unanswered, before it asks, if the budget is spent, or if nobody said how many
    tokens the last answers took, which a budget would never notice. All else is as in the backend.
    """

    def __init__(
        self, backend: Backend, model: str, price: Price, work: Path | None, limit: Budget | None
    ) -> None:
        self._backend, self._model, self._price = backend, model, price
        self._work, self._limit = work, limit
        self._unsaid = False  # whether all of the last answers are without their tokens

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        if self._limit:
            self._limit.check()
            if self._unsaid:
                raise Unanswered(
                    f"{printable(self._model)} does not say how many tokens its answers take, so "
                    "--max-cost cannot hold; all answers are kept, and the same command without "
                    "it goes on"
                )
        completions = self._backend.complete(requests)
        counted = [
            (each.prompt_tokens, each.completion_tokens)
            for each in completions
            if each.prompt_tokens is not None and each.completion_tokens is not None
        ]
        read, written = (sum(n) for n in zip(*counted, strict=True)) if counted else (0, 0)
        uncounted = len(completions) - len(counted)
        self._unsaid = not counted and any(each.error is None for each in completions)
        if self._work:
            with appending(self._work / FILE) as file:
                file.write(
                    msgspec.json.encode(
                        Asked(self._model, len(completions), uncounted, read, written)
                    )
                    + b"\n"
                )
        if self._limit:
            self._limit.spend(self._price.of(read, written))
        return completions


def total(settings: Mapping[str, Any], works: Iterable[Path]) -> dict[str, Cost]:
    """Return what the questions counted in working folders cost, by model name.

    `settings` are a run's record. A model without a price or without a question is left out.
    """
    prices = {}
    for model in (settings["model"], *(helper["model"] for helper in settings["helpers"])):
        if price := model.get("price"):
            prices[model["name"]] = msgspec.convert(price, Price)
    sums: dict[str, Counter[str]] = {}
    for work in works:
        for line in bytes_of(work / FILE, "rows").splitlines() if (work / FILE).is_file() else ():
            with suppress(msgspec.MsgspecError):  # torn, if the run was killed
                counts = msgspec.structs.asdict(msgspec.json.decode(line, type=Asked))
                sums.setdefault(counts.pop("model"), Counter()).update(counts)
    return {
        name: Cost(
            prices[name].currency,
            round(prices[name].of(n["read"], n["written"]), 9),
            n["asked"],
            n["uncounted"],
            n["read"],
            n["written"],
        )
        for name, n in sums.items()
        if name in prices
    }
