"""The backend of the reference drivers, so that they run like any model."""

from collections.abc import Sequence
from typing import Any

from harness import __version__
from harness.backends.base import Completion, Request
from harness.backends.cards import Card
from harness.core.errors import unknown
from harness.core.files import canonical_json
from harness.world.drivers import DRIVERS, choose


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
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Completion:
        if request.scenario is None:
            raise ValueError(f"request {request.id} has no scenario; a driver needs its road")
        action = choose(request.scenario, self.driver, request.view or {}, request.truth)
        text = canonical_json({"action_distribution": {a: float(a == action) for a in request.actions}})
        return Completion(request.id, text, None, None, "stop", None, 1)

    def identity(self) -> dict[str, Any]:
        """Return the driver and the version of its rules."""
        return {"engine": "driver", "driver": self.driver, "harness": __version__}
