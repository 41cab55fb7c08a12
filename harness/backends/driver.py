"""The backend of the reference drivers, so that they run like any model."""

from collections.abc import Sequence
from typing import Any

from harness.backends.base import Completion, Request, by_scenario
from harness.backends.card import Card
from harness.backends.registry import BUILT_IN
from harness.core.errors import UserError, printable, unknown
from harness.core.files import canonical_json, sha256_file
from harness.world.drivers import (
    CONSTANT,
    CONSTANTS,
    DRIVERS,
    OPEN_LOOP,
    OPEN_LOOPS,
    UNIFORM,
    choices,
    constant,
    drivers_of,
    open_loop,
)
from harness.world.precedence import RULES
from harness.world.scenario import Scenario

REFERENCES = (*DRIVERS, *RULES, UNIFORM, CONSTANT, OPEN_LOOP)
# What the choice of those that look at nothing follows from, by name
CHOSEN = {CONSTANT: ("constants", CONSTANTS), OPEN_LOOP: ("open_loops", OPEN_LOOPS)}


def open(card: Card, **_: Any) -> "DriverBackend":
    """Return the backend of the driver that a model card names: a rule in place of a model.

    `card` is what a TOML file of `models/` says. Drivers are such as `cruise` and `brake`; other
    options of engines are ignored. One that is not in `REFERENCES` is of worlds of its own.
    """
    return DriverBackend(card.name)


class DriverBackend:
    """Answer requests by a rule-based driver: the action that it takes has all of the probability.

    Such a driver, like `cruise` or `brake`, decides for a car without a model, and is what models
    are compared with. The driver `uniform` gives each action the same probability.
    """

    def __init__(self, driver: str) -> None:
        self.driver = driver

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return by_scenario(requests, self._complete)

    def _complete(self, requests: Sequence[Request]) -> list[Completion]:
        scenario = requests[0].scenario
        if scenario is None:
            raise ValueError(f"request {requests[0].id} has no scenario; a driver needs its road")
        known_names = {*REFERENCES, *drivers_of(scenario)}
        if self.driver not in known_names:
            hint = "; or give a dataset whose worlds have it"
            raise unknown(f"driver of {printable(scenario.name)}", self.driver, known_names, hint)
        if self.driver == UNIFORM:
            return [self._answer(request, request.actions) for request in requests]
        cases = [
            (self._driver(scenario, request), request.view, request.truth) for request in requests
        ]
        return [
            self._answer(request, [action])
            for request, action in zip(requests, choices(scenario, cases), strict=True)
        ]

    def _driver(self, scenario: Scenario, request: Request) -> str:
        """Return the driver, or the action that it takes without looking."""
        if self.driver not in CHOSEN:
            return self.driver
        always = constant(scenario)
        actions = open_loop(scenario) if self.driver == OPEN_LOOP else (always,) if always else None
        if actions is None or request.view is None:
            raise UserError(
                f"driver {self.driver}: none was chosen for {printable(scenario.name)}; give brake "
                "or cruise"
            )
        return actions[min(request.view.step, len(actions) - 1)]

    def _answer(self, request: Request, among: Sequence[str]) -> Completion:
        p = {action: (action in among) / len(among) for action in request.actions}
        text = canonical_json({"action_distribution": p})
        return Completion(request.id, text, None, None, "stop", None, 1)

    def identity(self) -> dict[str, Any]:
        """Return the driver's name, the version of its answers, and a digest of its decision table.

        Only drivers that look up their action in a file have such a table.
        """
        chosen = {}
        if self.driver in CHOSEN:
            name, file = CHOSEN[self.driver]
            chosen = {name: sha256_file(file, "record")}
        return {
            "engine": "driver",
            "answers": BUILT_IN["driver"].answers,
            "driver": self.driver,
            **chosen,
        }
