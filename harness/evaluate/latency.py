"""Inference times that decide who is heard: the paper's, the card's, the user's, or measured by name.

They are fixed before a run, so that its own speed changes none of its rows. What its answers took is shown
beside them.
"""

from collections.abc import Iterable, Sequence
from typing import cast

import numpy as np

from harness.backends.base import Backend, Timed
from harness.backends.cards import Card
from harness.backends.registry import capabilities
from harness.core.arrays import Floats
from harness.core.config import LONGEST_S
from harness.core.errors import UserError, printable
from harness.runs.records import Answer, Latency, Times

PAPER = Latency("paper", "cited: SwarmDrive paper, single local 145.0 ms", 0.145, 0.145, 0.145)
MEASURED = "measured"
NAMES = ("card", MEASURED, "paper")
EXAMPLE = "ego=0.171,helper=0.164,fusion=0.2"


def known(choice: str | None, card: Card, backend: Backend) -> Latency | None:
    """The latency that `--latency` chooses; None where it is to be measured.

    Without a choice it is the replayed run's, else the card's, else the paper's.
    """
    if choice is None and capabilities(card.engine).own_latency:
        return cast("Timed", backend).latency()
    choice = choice or card.latency.source
    if choice == MEASURED:
        return None
    if choice == "paper":
        return PAPER
    if choice != "card":
        return declared(choice)
    seconds = cast("float", card.latency.inference_s)
    return Latency("card", card.latency.basis, seconds, seconds, seconds)


def declared(text: str) -> Latency:
    """The seconds in a text such as `ego=0.171,helper=0.164,fusion=0.2`; one left out is the ego's.

    Raises:
        UserError: the text is nothing that `--latency` takes.
    """
    pairs = [part.partition("=") for part in text.split(",")]
    try:
        seconds = {role: float(value) for role, _, value in pairs}
    except ValueError:
        seconds = {}
    ego, helper, fusion = (seconds.get(r, seconds.get("ego", np.nan)) for r in ("ego", "helper", "fusion"))
    roles_once = len(seconds) == len(pairs) and seconds.keys() <= {"ego", "helper", "fusion"}
    if not roles_once or not all(0 <= s <= LONGEST_S for s in (ego, helper, fusion)):
        raise UserError(
            f"--latency {printable(text)!r}: give {', '.join(NAMES)}, or seconds of one answer, "
            f"0 to {LONGEST_S:g}, such as {EXAMPLE} (ego is needed)"
        )
    return Latency("declared", "declared: --latency " + text, ego, helper, fusion)


def as_declared(latency: Latency) -> str:
    """A latency as a text that `declared` reads."""
    return f"ego={latency.ego_s},helper={latency.helper_s},fusion={latency.fusion_s}"


def inference_s(latency: Latency, answers: Sequence[Sequence[Answer | None]]) -> Floats:
    """Seconds of inference, (n, 1+H): the ego first. NaN where nobody was asked.

    What an answer is declared to be slower than its card comes on top.
    """
    slow = np.array([[a.slow_s if a else np.nan for a in row] for row in answers])
    by_place = [latency.ego_s, *[latency.helper_s] * (slow.shape[1] - 1)]
    return np.asarray(slow + np.array(by_place))


def fusion_s(latency: Latency, answers: Sequence[Answer]) -> Floats:
    """Seconds of each fusion call, (K,), as `inference_s` has those of the first answers."""
    return np.array([latency.fusion_s + a.slow_s for a in answers])


def times(answers: Iterable[Answer]) -> dict[str, Times]:
    """How long answers took that were asked alone and came at the first attempt, by role."""
    by_role: dict[str, list[float]] = {}
    for answer in answers:
        if answer.seconds is not None and answer.error is None and not answer.retries:
            by_role.setdefault(answer.role, []).append(answer.seconds)
    return {
        role: Times(len(each), *np.percentile(each, (50, 5, 95)).round(6).tolist())
        for role, each in by_role.items()
    }
