"""A mixed swarm: several models behind one backend, each asked what is its agent's to answer."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from harness.backends.base import Backend, Completion, Request, window
from harness.backends.cache import cached
from harness.backends.cards import Card


class Swarm:
    """The backends of a run's agents, the ego's first; two agents may have the same."""

    def __init__(self, backends: Sequence[Backend]) -> None:
        self._backends = backends
        windows = [window(backend) for backend in backends]
        self.window = sum(windows) if all(windows) else 0

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        done: dict[int, Completion] = {}
        for agent, backend in enumerate(self._backends):
            mine = [place for place, request in enumerate(requests) if request.agent == agent]
            if mine:
                done |= zip(mine, backend.complete([requests[place] for place in mine]), strict=True)
        return [done[place] for place in range(len(requests))]

    def identity(self) -> dict[str, Any]:
        """The ego's model, and those of the helpers."""
        ego, *helpers = (backend.identity() for backend in self._backends)
        return {**ego, "helpers": helpers}


def open_each(cards: Sequence[Card], opens: Callable[[Card], Backend]) -> list[Backend]:
    """The backend of each card; two that are equal have one."""
    opened = {card: opens(card) for card in dict.fromkeys(cards)}
    return [opened[card] for card in cards]


def together(cards: Sequence[Card], backends: Sequence[Backend], cache: Path | None = None) -> Backend:
    """One backend for all of a run's agents, each with the cache before it, if there is a file."""
    each = [cached(backend, card, cache) for backend, card in zip(backends, cards, strict=True)]
    return each[0] if len(each) == 1 else Swarm(each)
