"""Say in words what other actions would have been worth:
exact, from the tree, for who rewrites a prompt.
"""

import numpy as np

from harness.core.arrays import Floats
from harness.dataset.forest import Forest
from harness.extensions.learn.optimize.tuning import Decision, Played
from harness.world.perception.graph import truth_graph
from harness.world.scene_graph import Conflict


def of_course(played: Played) -> tuple[Decision, str]:
    """Return the decision of an episode whose policy lost most, and feedback in words on it.

    The feedback is for a model that rewrites the prompt: what was stated and done, what each action
    was worth, what the ego could not see, and whether the episode succeeded. `played` is a
    wording's result on one layout (start situation), with the episode's decisions. A policy is the
    ego's probabilities of actions. It loses the best action's worth less its own mean worth. The
    worth of an action is the probability that the episode succeeds after it if all later actions
    are drawn evenly.
    """
    lost = [_lost(decision) for decision in played.course]
    worst = played.course[int(np.argmax(lost))]
    end = "The episode succeeded." if played.success == 1 else "The episode failed."
    if played.success not in (0, 1):
        end = f"The episode succeeded under {100 * played.success:.0f} % of the channel's draws."
    return worst, f"{of_decision(worst)} {end}"


def of_decision(decision: Decision) -> str:
    """Return feedback in words on one decision, for a model that rewrites the prompt.

    It says what was stated and done, what each action was worth, and which vehicles in the ego's
    way were out of its sight and in no message. The worth is the probability that the episode
    succeeds after the action if all later actions are drawn evenly; what an action lost is the best
    action's worth less its own.
    """
    actions = decision.dataset.actions
    policy = ", ".join(
        f"{a} {_share(p)}" for a, p in zip(actions, decision.policy.tolist(), strict=True)
    )
    return " ".join(
        [
            f"It stated {policy}, and did {actions[decision.action]}.",
            _worths(decision),
            *_unseen(decision),
        ]
    )


def _worths(decision: Decision) -> str:
    worth, actions = _worth(decision), decision.dataset.actions
    best = int(np.argmax(worth))
    if not worth[best]:
        return "No action could save the episode any more."
    parts = [f"{actions[best]} was worth {_share(worth[best])}"]
    for n in np.argsort(-worth, kind="stable")[1:].tolist():
        lost = worth[best] - worth[n]
        after = ", and nothing could save the episode after it" if not worth[n] else ""
        parts.append(
            f"{actions[n]} lost {_share(lost)}{after}"
            if lost
            else f"{actions[n]} was worth as much"
        )
    return "; ".join(parts) + "."


def _unseen(decision: Decision) -> list[str]:
    """Return a sentence for each vehicle in the ego's way that the ego does not see."""
    scene = decision.scene
    scenario = scene.seat or decision.dataset.scenario
    ego = scene.graphs[scene.viewers[0]]
    truth = truth_graph(scenario, scene.state)
    reported = " ".join(
        str((answer.message or {}).get("evidence", answer.raw)) for answer in decision.heard
    )
    sentences = []
    for node in truth.nodes:
        conflicts = [conflict for conflict in truth.conflicts if conflict.vehicle == node.id]
        if node.id in {each.id for each in ego.nodes} or not conflicts:
            continue
        away_m = np.hypot(node.forward_m, node.left_m)
        heard = "no message came" if not decision.heard else "it was in no message"
        if node.id in reported.replace(",", " ").replace(".", " ").split():
            heard = "a message named it"
        where = f"{away_m:.0f} m, {_meets(conflicts[0])}"
        sentences.append(f"The {node.type} {node.id} at {where}, was out of sight, and {heard}.")
    return sentences


def _meets(conflict: Conflict) -> str:
    ego_s, other_s = conflict.ego.time_s, conflict.other.time_s
    if ego_s is None or other_s is None:
        return f"from {conflict.sector}"
    gap_s = other_s - ego_s
    return (
        f"from {conflict.sector}, {abs(gap_s):.1f} s {'later' if gap_s > 0 else 'earlier'} than "
        "the ego"
    )


def _share(p: float) -> str:
    return f"{p:.2f}"


def _worth(decision: Decision) -> Floats:
    forest: Forest = decision.dataset.forest
    return np.asarray(forest.worth[forest.place[decision.scene.id]])


def _lost(decision: Decision) -> float:
    worth = _worth(decision)
    return float(worth.max() - decision.policy @ worth)
