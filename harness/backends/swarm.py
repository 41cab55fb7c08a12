"""A mixed swarm: one backend that routes each request to the model of its agent."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from harness.backends.base import Backend, Completion, Request, Served, forget, served, window
from harness.backends.cache import cached
from harness.backends.card import Card


class Swarm:
    """A backend that sends each request to the backend of its agent (`Request.agent`).

    `backends` are those of the agents, the ego's first; agents may share one.
    """

    def __init__(self, backends: Sequence[Backend]) -> None:
        self._backends = backends
        windows = [window(backend) for backend in backends]
        self.window = sum(windows) if all(windows) else 0

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        completions: dict[int, Completion] = {}
        for agent, backend in enumerate(self._backends):
            places = [place for place, request in enumerate(requests) if request.agent == agent]
            if places:
                completions |= zip(
                    places, backend.complete([requests[place] for place in places]), strict=True
                )
        return [completions[place] for place in range(len(requests))]

    def identity(self) -> dict[str, Any]:
        ego, *helpers = (backend.identity() for backend in self._backends)
        return {**ego, "helpers": helpers}

    def forget(self) -> None:
        for backend in self._backends:
            forget(backend)

    def served(self) -> list[Served]:
        return [each for backend in self._backends for each in served(backend)]


def open_each(cards: Sequence[Card], opens: Callable[[Card], Backend]) -> list[Backend]:
    """Return the backend of each card, opened by `opens`; equal cards share one."""
    opened = {card: opens(card) for card in dict.fromkeys(cards)}
    return [opened[card] for card in cards]


def together(
    cards: Sequence[Card], backends: Sequence[Backend], cache: Path | None = None
) -> Backend:
    """Return one backend of a run's agents, which routes requests by agent.

    With a `cache` file, a completion cache is put before each.
    """
    agents = [cached(backend, card, cache) for backend, card in zip(backends, cards, strict=True)]
    return agents[0] if len(agents) == 1 else Swarm(agents)
