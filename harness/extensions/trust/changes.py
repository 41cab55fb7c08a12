"""What attacks and defences change of the messages that a fusion call shows."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.coordination.intents import Intents
from harness.coordination.parts import Change
from harness.extensions.trust.attacks import Attack, Turn

if TYPE_CHECKING:
    from harness.world.scene_graph import SceneGraph


class Schema:
    """Remove free text from helpers' messages: the defence `schema` of a fusion call.

    In a fusion call the ego's model reads the messages, so that words in them could give it orders.
    It is a `Change`, which is called for each message before the prompt shows it.
    """

    adds = False

    def message(self, message: Mapping[str, Any], actions: Sequence[str]) -> dict[str, Any]:
        return {**message, "evidence": ""}

    def graph(self, graph: "SceneGraph", scenario: Any, scene: Any) -> "SceneGraph":
        return graph


class Quoted(Schema):
    """Quote a helper's words as a JSON string, so that they are no orders: the defence `quoted`.

    It is called for each message before a prompt shows it to the ego's model.
    """

    def message(self, message: Mapping[str, Any], actions: Sequence[str]) -> dict[str, Any]:
        return {**message, "evidence": json.dumps(message["evidence"], ensure_ascii=False)}


MESSAGES: dict[str, Change] = {"quoted": Quoted(), "schema": Schema()}


@dataclass(frozen=True)
class AttackersMessage:
    """Change an attacker's message in a fusion prompt, where the ego's model reads it.

    It is a `Change`, which is called for each such message before the prompt shows it. `attacks`
    are those on what it says, in the order in which they act.
    """

    attacks: Sequence[Attack]  # the attacks on what it says, in the order in which they act

    @property
    def adds(self) -> bool:
        return any(attack.adds for attack in self.attacks)

    def message(self, message: Mapping[str, Any], actions: Sequence[str]) -> dict[str, Any]:
        changed = dict(message)
        for attack in self.attacks:
            if not attack.in_objects:
                intent = _intent(attack, changed["intent"])
                changed = {**attack.rewritten(changed, actions), "intent": intent}
        return changed

    def graph(self, graph: "SceneGraph", scenario: Any, scene: Any) -> "SceneGraph":
        from harness.world.perception.shared import invented

        for attack in self.attacks:
            graph = attack.listed(graph, invented(scenario, scene.state, graph.viewer))
        return graph


def _intent(attack: Attack, intent: Sequence[float]) -> list[float]:
    """Return what an attacker says that it intends, one that is alone."""
    p = np.array([[intent]])
    actions, attacks = p.shape[-1], np.ones((1, 1), dtype=bool)
    one_helper = Intents(
        np.full((1, actions), np.nan),
        p,
        attacks,
        np.zeros((1, 2)),
        np.zeros((1, 1)),
        np.zeros((1, 1)),
        np.zeros((1, 2)),
    )
    turn = Turn(one_helper, attacks, p, np.empty((1, 0, 1, actions)), np.zeros((1, 1)))
    distribution: list[float] = attack.act(one_helper, turn).helpers[0, 0].tolist()
    return distribution
