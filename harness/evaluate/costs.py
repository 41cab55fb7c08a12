"""What a run's questions cost, by the price in a card, and how many tokens they take.

Every completion that a model with a price or a server is asked for counts, whatever becomes of it;
one from the cache costs nothing. Each part of a run appends to a file in the working folder, so
that a stopped run goes on counting.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from harness.backends.base import Backend, Completion, Request
from harness.backends.card import Card
from harness.backends.price import Price
from harness.core.config import Whole
from harness.core.files import appending, bytes_of, opened
from harness.evaluate.command_options import Guard
from harness.runs.records import Cost

FILE = "costs.jsonl"


class Asked(msgspec.Struct, frozen=True):
    """Hold the token counts of completions that one model was asked for in one call.

    `asked` counts the completions, of which `uncounted` have no token counts; `read` and `written`
    are the tokens of the others' prompts and answers.
    """

    model: str  # name of the model's card
    asked: Whole  # number of completions
    uncounted: Whole  # how many of them have no token counts: failed ones, as a rule
    read: Whole  # tokens of the prompts of those that are counted
    written: Whole  # tokens of their answers

    @classmethod
    def of(cls, model: str, completions: Sequence[Completion]) -> "Asked":
        """Return the token counts of what a model answered, to append to the run's counts of cost.

        `model` is the name of its card, the file that describes the model; `completions` are its
        answers.
        """
        counted = [
            (each.prompt_tokens, each.completion_tokens)
            for each in completions
            if each.prompt_tokens and each.completion_tokens is not None  # no prompt has 0
        ]
        read, written = (sum(n) for n in zip(*counted, strict=True)) if counted else (0, 0)
        return cls(model, len(completions), len(completions) - len(counted), read, written)


def metered(
    cards: Sequence[Card], backends: Sequence[Backend], work: Path | None, guards: Sequence[Guard]
) -> list[Backend]:
    """Return the models' backends, wrapped so that tokens of those at servers are counted.

    A backend is the code that runs a model. So is one with a price, which stands in the model's
    card, the file that describes it; `cards` and `backends` are in the same order, the ego's first.
    Counts go to a file in the working folder `work`; nothing is counted with None. `guards`,
    functions that may make a backend refuse to ask, wrap each one, too.
    """
    models = []
    for card, backend in zip(cards, backends, strict=True):
        for guard in guards:
            backend = guard(card, backend)
        is_counted = card.price or card.server
        models.append(Metered(backend, card, work) if is_counted and work else backend)
    return models


class Metered:
    """Wrap a backend, the code that runs a model, and count the tokens of its completions.

    Counts are appended to a file in a working folder; all else is as in the backend. Completions
    without any count of tokens are counted only if the model's card has a price.
    """

    def __init__(self, backend: Backend, card: Card, work: Path) -> None:
        self._backend, self._card, self._work = backend, card, work

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        completions = self._backend.complete(requests)
        counts = Asked.of(self._card.name, completions)
        if self._card.price or counts.uncounted < counts.asked:
            with appending(self._work / FILE) as file:
                file.write(msgspec.json.encode(counts) + b"\n")
        return completions


def total(settings: Mapping[str, Any], works: Iterable[Path]) -> dict[str, Cost]:
    """Return what the questions counted in working folders cost, by model name.

    `settings` are a run's record, the content of its `run.json`, with the prices; `works` are the
    folders. A model without a price or without a question is left out.
    """
    prices = _prices(settings)
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


def _prices(settings: Mapping[str, Any]) -> dict[str, Price]:
    """Return the prices that a run's record states, by model name."""
    prices = {}
    for model in (settings["model"], *(helper["model"] for helper in settings["helpers"])):
        if price := model.get("price"):
            prices[model["name"]] = msgspec.convert(price, Price)
    return prices


class Spending:
    """Say what a run's questions have taken so far, while other threads or processes ask.

    Called, it returns tokens and cost, such as `31.2k tokens, 0.24 USD`; empty if none are counted.
    """

    def __init__(self, settings: Mapping[str, Any], work: Path) -> None:
        """Begin at the beginning: `settings` are the run's record, `work` its working folder."""
        self._prices, self._file = _prices(settings), work / FILE
        self._at, self._tokens, self._costs = 0, 0, dict[str, float]()

    def __call__(self) -> str:
        for line in self._new_lines():
            with suppress(msgspec.MsgspecError):
                counts = msgspec.json.decode(line, type=Asked)
                self._tokens += counts.read + counts.written
                if price := self._prices.get(counts.model):
                    cost = price.of(counts.read, counts.written)
                    self._costs[price.currency] = self._costs.get(price.currency, 0.0) + cost
        if not self._tokens:
            return ""
        costs = [f"{_short(cost)} {currency}" for currency, cost in self._costs.items()]
        return ", ".join([f"{_short(self._tokens)} tokens", *costs])

    def _new_lines(self) -> Sequence[bytes]:
        """Return the lines that are whole now, and were not at the last call."""
        with suppress(OSError), opened(self._file, "rows") as file:  # not begun, or tidied away
            file.seek(self._at)
            whole, end, _ = file.read().rpartition(b"\n")
            self._at += len(whole + end)
            return whole.splitlines()
        return ()


def _short(number: float) -> str:
    """Return a number in three digits and a letter: `950`, `31.2k`, `4.56M`, `0.0243`."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= 0.9995 * size:  # what is rounded to it
            return f"{number / size:.3g}{letter}"
    return f"{number:.3g}"
