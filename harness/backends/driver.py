"""The backend of the reference drivers, so that they run like any model."""

from collections.abc import Sequence
from typing import Any

from harness import __version__
from harness.backends.base import Completion, Request, by_scenario
from harness.backends.cards import Card
from harness.core.errors import unknown
from harness.core.files import canonical_json
from harness.world.drivers import DRIVERS, choices


def open(card: Card, **_: Any) -> "DriverBackend":
    """Open the driver that a card names. Raises UserError if there is none."""
    if card.name not in DRIVERS:
        raise unknown("driver", card.name, DRIVERS)
    return DriverBackend(card.name)


class DriverBackend:
    """Answers with all probability on the driver's action, so it never asks for help."""

    def __init__(self, driver: str) -> None:
        self.driver = driver

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [completion for part in by_scenario(requests) for completion in self._complete(part)]

    def _complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Answer requests of one scenario."""
        scenario = requests[0].scenario
        if scenario is None:
            raise ValueError(f"request {requests[0].id} has no scenario; a driver needs its road")
        asked = [(self.driver, request.view or {}, request.truth) for request in requests]
        return [
            self._answer(request, action)
            for request, action in zip(requests, choices(scenario, asked), strict=True)
        ]

    def _answer(self, request: Request, action: str) -> Completion:
        text = canonical_json({"action_distribution": {a: float(a == action) for a in request.actions}})
        return Completion(request.id, text, None, None, "stop", None, 1)

    def identity(self) -> dict[str, Any]:
        """Return the driver and the version of its rules."""
        return {"engine": "driver", "driver": self.driver, "harness": __version__}
