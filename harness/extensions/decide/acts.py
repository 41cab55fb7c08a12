"""Say how to act on a decision under a condition: alone, after helpers are asked, or carefully."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from harness.coordination.coordinate import fuse
from harness.coordination.exchange import exchange
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.parts_of_packages import obstacle, obstacle_of_models
from harness.core.errors import UserError, printable
from harness.evaluate.agent import Agent
from harness.evaluate.facts import Facts
from harness.extensions.decide.asked import Act, Answered
from harness.radio.channel import Draws
from harness.world.scenario import Scenario


class Acts:
    """Add to answers how to act on them under a condition, where the options are its actions.

    A condition is a set of settings of asking helpers and of fusing messages. As in an episode, an
    ego whose entropy is above `tau_nats` asks, and an unsure one may be careful.
    """

    def __init__(
        self, point: OperatingPoint, scenario: Scenario, agent: Agent, identity: Mapping[str, Any]
    ) -> None:
        """Take a condition, the scenario that it is used in, and the model that answers.

        `identity` tells the model apart (`Backend.identity`). Raises UserError if the condition is
        not for this model, prompt or scenario, such as a promise that was made of another.
        """
        facts = Facts((agent,), scenario)
        for part in point.more:
            reason = obstacle(part, point, facts) or obstacle_of_models(part, [identity])
            if reason:
                raise UserError(f"condition {printable(point.name)}: {reason}")
        if point.asks and (why := point.idle("tau_nats")):
            raise UserError(
                f"condition {printable(point.name)}: {why}; give one that asks by entropy"
            )
        if point.stream is not None:
            raise UserError(
                f"condition {printable(point.name)}: it has a stream, and what is served has heard "
                "nothing; leave it out"
            )
        self._actions = scenario.actions
        self._asks_above = point.ask.tau_nats if point.asks else None
        # who decides without messages; what a promise implies stays
        try:
            self._alone = point.changed(promise="", profile=None)
        except UserError:
            raise UserError(
                f"condition {printable(point.name)}: it has what acts on messages alone, and what "
                "is served hears none; give one of whom the ego asks, and when"
            ) from None

    def of(self, answer: Answered) -> Answered:
        """Return an answer with how to act on it; as it is if its options are no actions here."""
        options = answer.asked.options
        if answer.shares is None or sorted(options) != sorted(self._actions):
            return answer
        places = [options.index(action) for action in self._actions]
        intent = np.array([[answer.shares[place] for place in places]])
        nobody = np.zeros((1, 0))
        intents = Intents(
            own=intent,
            helpers=np.zeros((1, 0, len(places))),
            valid=nobody.astype(bool),
            distance_m=np.ones((1, 1)),
            range_m=nobody,
            payload_bits=nobody,
            inference_s=np.zeros((1, 1)),
        )
        heard = exchange(self._alone, intents, Draws(np.zeros((1, 0, 2)), nobody))
        decision = fuse(self._alone, heard, intents)
        word = "alone" if np.array_equal(decision.fused, heard.own) else "careful"
        if self._asks_above is not None and heard.entropy_nats[0] > self._asks_above:
            word = "ask"
        return replace(answer, act=Act(word, places[int(decision.action[0])]))
