"""A mixed swarm: one backend that routes each request to the model of its agent."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from harness.backends.base import (
    Backend,
    Completion,
    Request,
    Served,
    forget,
    is_record,
    served,
    window,
)
from harness.backends.cache import cached
from harness.backends.card import Card


class Swarm:
    """Send each request to the model of the agent that it is for, in a run with several models.

    An agent is one of the models (with prompt and answer mode) that vehicles of a run ask;
    `Request.agent` is its index: the ego's is 0, those of helpers follow. `backends` are the
    agents', in this order; several agents may share one backend.
    """

    def __init__(self, backends: Sequence[Backend]) -> None:
        self._backends = backends
        windows = [window(backend) for backend in backends]
        self.window = sum(windows) if all(windows) else 0
        self.is_record = all(map(is_record, backends))

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
    """Return the backend of each model card, in order; equal cards share one.

    `opens` opens the backend of a card, which is what a model's TOML file says.
    """
    opened = {card: opens(card) for card in dict.fromkeys(cards)}
    return [opened[card] for card in cards]


def together(
    cards: Sequence[Card], backends: Sequence[Backend], cache: Path | None = None
) -> Backend:
    """Return one backend that passes each request to the model of the agent it is for.

    An agent is one of the models that vehicles of a run ask; a request has its index, 0 the ego's.
    `cards` are the agents' model cards (what a TOML file says of each) and `backends` the opened
    models, both in that order. `cache` is the file of answers stored by earlier runs, in which each
    looks before it asks its model; None for no cache. A single agent needs no routing: its own
    backend is returned.
    """
    agents = [cached(backend, card, cache) for backend, card in zip(backends, cards, strict=True)]
    return agents[0] if len(agents) == 1 else Swarm(agents)
