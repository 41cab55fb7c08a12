"""What a package adds to the harness without a change of it: one of each kind of plug-in."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.extend import (
    PERCENT,
    Broadcast,
    Capabilities,
    Card,
    Completion,
    Delivery,
    Draws,
    Floats,
    Formula,
    Fused,
    Links,
    Messages,
    Metric,
    Registration,
    Request,
    ScheduleInputs,
    linear_pool,
    link_up,
)


@dataclass(frozen=True)
class Smoothing:
    """The mean of the linear pool and of what this rule gave at the last step.

    A rule with memory: it goes on through steps in which the ego hears nobody and acts on its own.
    """

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Floats:
        """NaN: there was no last step."""
        return np.full((*batch, actions), np.nan)

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """What it gives, it remembers."""
        now = linear_pool(messages.intents, messages.weights)
        policy = np.where(np.isnan(state), now, (now + state) / 2)
        return Fused(policy, messages.weights, policy)


@dataclass(frozen=True)
class Fog:
    """Replies are lost with distance and never wait for each other. An assumption;
    nothing was measured.

    Attributes:
        latency_s: seconds of one exchange, the request included.
        loss_per_m: probability, a metre between ego and helper, that one transmission is lost.
    """

    latency_s: float = 0.01
    loss_per_m: float = 0.01

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        """A message's time on air is not modelled."""
        return Broadcast(0.0, 0.0)

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        """Each link has a loss of its own."""
        loss = np.minimum(links.range_m * self.loss_per_m, 1.0)
        delay_s = np.where(links.asked, links.ready_s + self.latency_s, np.inf)
        return Delivery(link_up(draws.link, loss), delay_s, loss, np.full_like(loss, np.nan))


def near(known: ScheduleInputs) -> Floats:
    """How near a helper is, from 0 at 100 m to 1 beside the ego."""
    return np.where(known.may_ask, 1 - known.range_m / 100, np.nan)


class Cautious:
    """Slows down where its own view shows a conflict, and is in doubt all the same."""

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Any number of requests at a time, so no answer has seconds of its own."""
        return [
            Completion(r.id, answer(r), None, None, "stop", None, len(requests)) for r in requests
        ]

    def identity(self) -> dict[str, Any]:
        """There is nothing else to it: no weights and no settings."""
        return {"engine": "cautious", "version": 1}


def answer(request: Request) -> str:
    """The JSON that the prompt asks for. Actions come with the most conservative one first."""
    assert request.view is not None
    shares = (0.6, 0.3, 0.1) if request.view.conflicts else (0.2, 0.4, 0.4)
    said = {"action_distribution": dict(zip(request.actions, shares, strict=True))}
    return json.dumps(said if request.role == "ego" else {"evidence": "", "risk": "low", **said})


def opened(card: Card, **options: Any) -> Cautious:
    """The backend of a card; device, number format and batch size mean nothing to it."""
    return Cautious()


class Notebook:
    """A hook that writes down what it is told."""

    def begin(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self._file = folder.with_name("noted.txt")
        self._file.write_text(f"begin {settings['model']['name']}\n")

    def answered(self, total: int) -> None:
        self._note(f"answered {total}")

    def end(self, done: Any) -> None:
        self._note(f"end {done.manifest.name}")

    def _note(self, line: str) -> None:
        with self._file.open("a") as file:
            file.write(line + "\n")


SMOOTHING = Smoothing()
NOTEBOOK = Notebook()  # a `Hook`
FOG = Fog()
NEAR = Formula(near, 0.5)
SURE = Metric(
    "sure_rate", 
        "share of decisions whose own "
        "intent is nearly certain", PERCENT, "neither", "rate", 1.0,
    decisions=lambda d: (d["normalised_entropy"] < 0.5).astype(float),
)  # fmt: skip
CAUTIOUS = Registration(
    "swarm_extras:opened",
    Capabilities(language_model=False, answer_modes=("json",), thinks="never", renders=False),
    card_keys=("revision",),
)
