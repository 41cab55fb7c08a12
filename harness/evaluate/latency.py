"""Inference times that decide who is heard: the paper's, a card's, the user's, a device's, or measured ones.

They are fixed before a run, so that its own speed changes none of its rows. What its answers took is shown
beside them.
"""

import math
from collections.abc import Iterable, Sequence
from itertools import cycle, islice
from typing import cast

import numpy as np
from msgspec.structs import replace

from harness.backends.base import Backend, Timed
from harness.core.arrays import Floats
from harness.core.config import LONGEST_S
from harness.core.errors import UserError, printable
from harness.evaluate.agent import Agent
from harness.evaluate.device import answer_s
from harness.runs import percentiles
from harness.runs.records import Answer, AnswerFacts, Latency, Times

PAPER = Latency("paper", "cited: SwarmDrive paper, single local 145.0 ms", 0.145, 0.145, 0.145)
MEASURED = "measured"
NAMES = ("card", MEASURED, "paper")
EXAMPLE = "ego=0.171,helper=0.164,fusion=0.2"


def known(choice: str | None, agents: Sequence[Agent], backends: Sequence[Backend]) -> Latency | None:
    """The latency that `--latency` chooses; None where it is to be measured.

    Without a choice it is each agent's own: the replayed run's, else the card's, else the paper's.

    Args:
        choice: what was chosen, if anything.
        agents: the ego's, then the helpers' where they are others.
        backends: of each.
    """
    if choice not in (None, *NAMES):
        return declared(choice)
    if choice == MEASURED:
        return None
    each = [_of_agent(choice, agent, backend) for agent, backend in zip(agents, backends, strict=True)]
    return mixed(each[0], each[1:])


def _of_agent(choice: str | None, agent: Agent, backend: Backend) -> Latency:
    if choice is None and agent.can.own_latency:
        return cast("Timed", backend).latency()
    if (choice or agent.card.latency.source) == "paper":
        return PAPER
    seconds = cast("float", agent.card.latency.inference_s)
    return Latency("card", agent.card.latency.basis, seconds, seconds, seconds)


def mixed(ego: Latency, helpers: Sequence[Latency]) -> Latency:
    """The ego's times, and those of helpers that are others."""
    if not helpers:
        return ego
    if any(each.speeds for each in (ego, *helpers)):
        raise UserError(
            "a replay of a run with a device profile has that run's times; give --device-profile anew, or "
            "--latency"
        )
    basis = " + ".join(dict.fromkeys(each.basis for each in helpers))
    return replace(
        ego, basis=ego.basis if basis == ego.basis else f"ego: {ego.basis}; helpers: {basis}",
        helper_s=helpers[0].helper_s,
        helpers_s=tuple(each.helper_s for each in helpers) if len(helpers) > 1 else helpers[0].helpers_s,
    )  # fmt: skip


def declared(text: str) -> Latency:
    """The seconds in a text such as `ego=0.171,helper=0.164,fusion=0.2`; one left out is the ego's.

    Several helper models have a time each: `helper=0.164:0.2`.

    Raises:
        UserError: the text is nothing that `--latency` takes.
    """
    pairs = [part.partition("=") for part in text.split(",")]
    try:
        seconds = {role: [float(part) for part in value.split(":")] for role, _, value in pairs}
    except ValueError:
        seconds = {}
    ego, helper, fusion = (seconds.get(r, seconds.get("ego", [np.nan])) for r in ("ego", "helper", "fusion"))
    roles_once = len(seconds) == len(pairs) and seconds.keys() <= {"ego", "helper", "fusion"}
    one_each = len(ego) == len(fusion) == 1
    if not (roles_once and one_each and all(0 <= s <= LONGEST_S for s in (*ego, *helper, *fusion))):
        raise UserError(
            f"--latency {printable(text)!r}: give {', '.join(NAMES)}, or seconds of one answer, "
            f"0 to {LONGEST_S:g}, such as {EXAMPLE} (ego is needed)"
        )
    several = tuple(helper) if len(helper) > 1 else ()
    return Latency("declared", "declared: --latency " + text, ego[0], helper[0], fusion[0], helpers_s=several)


def as_declared(latency: Latency) -> str:
    """A latency as a text that `declared` reads."""
    helpers = ":".join(map(str, latency.helpers_s or (latency.helper_s,)))
    return f"ego={latency.ego_s},helper={helpers},fusion={latency.fusion_s}"


def inference_s(latency: Latency, answers: Sequence[Sequence[Answer | None]]) -> Floats:
    """Seconds of inference, (n, 1+H): the ego first. NaN where nobody was asked.

    A repair turn is one more. What an answer is declared to be slower than its card comes on top.
    """
    if latency.speeds:
        return np.array([
            [answer_s(latency.speed(place), a) if a else np.nan for place, a in enumerate(row)]
            for row in answers
        ])  # fmt: skip
    turns = np.array([[a.turns if a else np.nan for a in row] for row in answers])
    slow = np.array([[a.slow_s if a else np.nan for a in row] for row in answers])
    by_place = [latency.ego_s, *islice(cycle(latency.helper_times_s()), slow.shape[1] - 1)]
    return np.asarray(slow + turns * np.array(by_place, dtype=float))


def fusion_s(latency: Latency, answers: Sequence[Answer]) -> Floats:
    """Seconds of each fusion call, (K,), as `inference_s` has those of the first answers."""
    if latency.speeds:
        return np.array([answer_s(latency.speeds[0], a) for a in answers])
    return np.array([cast("float", latency.fusion_s) * a.turns + a.slow_s for a in answers])


def times(answers: Iterable[Answer | AnswerFacts]) -> dict[str, Times]:
    """How long answers took that were asked alone and came at the first attempt, by role."""
    by_role: dict[str, list[Answer | AnswerFacts]] = {}
    for answer in answers:
        if answer.seconds is not None and answer.error is None and not answer.retries:
            by_role.setdefault(answer.role, []).append(answer)
    found = {}
    for role, each in by_role.items():
        parts = {"first_token": _times(each, "first_token_s"), "token": _times(each, "token_s")}
        found[role] = replace(cast("Times", _times(each, "seconds")), **parts)
    return found


def _times(answers: Sequence[Answer | AnswerFacts], which: str) -> Times | None:
    """Percentiles of one of their times; None where no answer has it."""
    known = [(s, a.scene.partition("-")[0]) for a in answers if (s := getattr(a, which)) is not None]
    if not known:
        return None
    values, episodes = np.array([s for s, _ in known]), [episode for _, episode in known]
    ends = {
        percent: None if math.isnan(low) else (round(low, 6), round(high, 6))
        for percent, (low, high) in percentiles.intervals(values, episodes).items()
    }
    half, low, high = np.percentile(values, (50, 5, 95)).round(6).tolist()
    return Times(len(known), half, low, high, ends[50], ends[95])
