"""Choose the inference times that decide which helpers are heard in time.

They come from the paper, a card or the user, or are measured, or an extension times each answer
(`harness.runs.timers`). They are fixed before a run, so that its own speed changes none of its
rows. The times that its answers took are recorded beside them.
"""

from collections.abc import Sequence
from itertools import cycle, islice
from typing import cast

import numpy as np
from msgspec.structs import replace

from harness.backends.base import Backend, Timed
from harness.backends.card import Card
from harness.core.arrays import Floats
from harness.core.config import LONGEST_S
from harness.core.errors import UserError, printable
from harness.evaluate.agent import Agent
from harness.runs.records import MEASURED, Answer, Latency
from harness.runs.timers import options

PAPER = Latency("paper", "cited: SwarmDrive paper, single local 145.0 ms", 0.145, 0.145, 0.145)
NAMES = ("card", MEASURED, "paper")
EXAMPLE = "ego=0.171,helper=0.164,fusion=0.2"


def chosen_latency(
    choice: str | None, agents: Sequence[Agent], backends: Sequence[Backend]
) -> Latency | None:
    """Return the inference times that `--latency` chooses for agents; None if they are measured.

    An agent is a model with its prompt. `choice` is what was typed. Without it each agent has its
    own: those of the run that it replays, else what its model's card (the file that describes it)
    declares, else the paper's. `backends`, the code that runs the models, are those of `agents`, in
    their order, the ego's first.
    """
    if choice not in (None, *NAMES):
        return declared(choice)
    if choice == MEASURED:
        return None
    latencies = [
        _of_agent(choice, agent, backend) for agent, backend in zip(agents, backends, strict=True)
    ]
    return mixed(latencies[0], latencies[1:])


def _of_agent(choice: str | None, agent: Agent, backend: Backend) -> Latency:
    if choice is None and agent.can.own_latency:
        return cast("Timed", backend).latency()
    return of_card(choice, agent.card)


def of_card(choice: str | None, card: Card) -> Latency:
    """Return the inference times of a model by its card, a file that describes it.

    `choice` is `card` or `paper`; None takes what the card names as its source.
    """
    if (choice or card.latency.source) in ("cited", "paper"):
        return PAPER
    seconds = cast("float", card.latency.inference_s)
    return Latency("card", card.latency.basis, seconds, seconds, seconds)


def mixed(ego: Latency, helpers: Sequence[Latency]) -> Latency:
    """Return the ego's inference times with the helpers' replaced by those of their own models.

    `helpers` has the times of each agent that answers for helpers; without any the ego's stay. An
    agent is a model, its prompt and how it answers. Raises UserError if one of them times each
    answer by itself.
    """
    if not helpers:
        return ego
    if any(each.speeds for each in (ego, *helpers)):
        raise UserError(
            "a replay of a run that timed each answer has that run's times; give "
            f"{' or '.join(options())} anew, or --latency"
        )
    basis = " + ".join(dict.fromkeys(each.basis for each in helpers))
    return replace(
        ego,
        basis=ego.basis if basis == ego.basis else f"ego: {ego.basis}; helpers: {basis}",
        helper_s=helpers[0].helper_s,
        helpers_s=tuple(each.helper_s for each in helpers)
        if len(helpers) > 1
        else helpers[0].helpers_s,
    )


def declared(text: str) -> Latency:
    """Return the latency of a text such as `ego=0.171,helper=0.164,fusion=0.2`, in seconds.

    Fusion is a second question to the ego's model, with the messages that arrived. A role left out
    has the ego's time. Several models of helpers have one time each: `helper=0.164:0.2`. Raises
    UserError for any other text.
    """
    pairs = [part.partition("=") for part in text.split(",")]
    seconds: dict[str, list[float]] = {}
    try:
        for role, _, value in pairs:
            seconds[role] = [float(part) for part in value.split(":")]
    except ValueError:
        seconds = {}
    ego = seconds.get("ego", [np.nan])
    helper, fusion = seconds.get("helper", ego), seconds.get("fusion", ego)
    roles_once = len(seconds) == len(pairs) and seconds.keys() <= {"ego", "helper", "fusion"}
    one_each = len(ego) == len(fusion) == 1
    if not (roles_once and one_each and all(0 <= s <= LONGEST_S for s in (*ego, *helper, *fusion))):
        raise UserError(
            f"--latency {printable(text)!r}: give {', '.join(NAMES)}, or by role the seconds of "
            f"one answer, 0 to {LONGEST_S:g}, such as {EXAMPLE} (ego is needed; a role left out "
            "has its time)"
        )
    several = tuple(helper) if len(helper) > 1 else ()
    return Latency(
        "declared", "declared: --latency " + text, ego[0], helper[0], fusion[0], helpers_s=several
    )


def same_times(one: Latency, other: Latency) -> bool:
    """Return whether two latencies are of one source and give every answer the same seconds.

    Where the times come from, in words, does not count.
    """
    return replace(one, basis="", sample={}) == replace(other, basis="", sample={})


def as_declared(latency: Latency) -> str:
    """Return inference times as `--latency` takes them: `ego=0.171,helper=0.164,fusion=0.2`."""
    helpers = ":".join(map(str, latency.helpers_s or (latency.helper_s,)))
    return f"ego={latency.ego_s},helper={helpers},fusion={latency.fusion_s}"


def inference_s(
    latency: Latency, answers: Sequence[Sequence[Answer | None]], places: Sequence[Sequence[int]]
) -> Floats:
    """Return the seconds in which each vehicle's answer is ready, `(n, 1+H)`, NaN without one.

    `answers` has for each of n scenes those of the ego and of H helpers, the ego's first. `places`,
    alike, has the number of the model that answers: 0 is the ego's, and helpers' models take turns
    (`Latency.speed`). If one model answers for all, only the role counts. A repair turn, a second
    question after a failed answer, takes the time of one more answer. An answer's own declared
    delay (`slow_s`) is added.
    """
    shape = len(answers), len(answers[0]) if answers else 0
    seconds, turns, slow = np.full((3, *shape), np.nan)
    for n, row in enumerate(answers):
        for place, answer in enumerate(row):
            if answer and latency.speeds:
                seconds[n, place] = latency.answer_s(places[n][place], answer)
            elif answer:
                turns[n, place], slow[n, place] = answer.turns, answer.slow_s
    if latency.speeds:
        return seconds
    by_place = [latency.ego_s, *islice(cycle(latency.helper_times_s()), slow.shape[1] - 1)]
    return np.asarray(slow + turns * np.array(by_place, dtype=float)[np.array(places, dtype=int)])


def fusion_s(latency: Latency, answers: Sequence[Answer], places: Sequence[int]) -> Floats:
    """Return the seconds of K fusion calls, `(K,)`, a repair turn and declared delays included.

    A fusion call is a second question to a deciding vehicle's model, with the messages that it
    heard; `answers` has the answer of each. `places` has the number of the model that answers each,
    0 the ego's. A vehicle with a helper's model takes as long as for any other answer.
    """
    if latency.speeds:
        return np.array([latency.answer_s(n, a) for n, a in zip(places, answers, strict=True)])
    by_place = [latency.fusion_s, *islice(cycle(latency.helper_times_s()), max(places, default=0))]
    seconds = [cast("float", by_place[n]) for n in places]
    return np.array([s * a.turns + a.slow_s for s, a in zip(seconds, answers, strict=True)])
