"""What a distilled model learns to answer:
a distribution as a prompt asks for it, and what pictures show.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.files import canonical_json
from harness.core.rounding import rounded
from harness.extensions.learn.training.model import VISION
from harness.prompts.answer_schema import plainest
from harness.prompts.versions import Prompt
from harness.world.perception.camera import Sight
from harness.world.scene_graph import Conflict, SceneGraph

PARTS = 20  # of a stated distribution: so small a model cannot make hundredths sum to 1
MOST_SEEN = 5  # vehicles of a picture that are listed
HIGH, MEDIUM = 0.6, 0.3  # probability of the most careful action from which risk has that name
# of how far the nearest vehicle in a square of a picture is, a digit each; 0 is nobody
CLASSES = 10
STEP_M = 7.0  # from one class to the next; the last has no end


def evidence(view: SceneGraph, named: bool = True) -> str:
    """Return one sentence of evidence, as a helper reports it, from what a viewer knows of a scene.

    `view` is that: its scene graph. The sentence says who brakes ahead of the ego, else who comes
    closest to it in time, else what is hidden. The gap is by how many seconds that vehicle reaches
    the conflict later than the ego. If `named` is false, the prompt names no vehicle, and the
    sentence says "one".
    """

    def who(conflict: Conflict) -> str:
        return conflict.vehicle if named else "one"

    for conflict in view.conflicts:
        if conflict.other.braking and conflict.kind == "ahead":
            return f"{who(conflict)} brakes, {conflict.lane} lane, {conflict.ego.arc_m:.0f} m"
    gaps = [(_gap_s(conflict), conflict) for conflict in view.conflicts]
    moving = [(gap, c) for gap, c in gaps if gap is not None]
    if moving:
        gap, first = min(moving, key=lambda pair: abs(pair[0]))
        return f"{who(first)} from {first.sector}, gap {gap:+.1f} s"
    if gaps:
        return f"{who(gaps[0][1])} from {gaps[0][1].sector}, one of us stands"
    return f"nothing crosses, hidden {' '.join(view.occluded) or 'none'}"


def sights(view: SceneGraph) -> str:
    """Return what a viewer's cameras show, as text: up to five vehicles, the nearest first.

    `view` is the scene graph, what the viewer knows of the scene. Each vehicle has its type, metres
    ahead and to the left of the viewer, and a brake light or indicator.
    """
    seen = [node for node in view.nodes if "camera" in node.sensors]
    seen.sort(key=lambda node: float(np.hypot(node.forward_m, node.left_m)))
    parts = []
    for node in seen[:MOST_SEEN]:
        lamps = "brake" if node.braking else node.indicator
        lit = f" {lamps}" if lamps not in (None, "off") else ""
        parts.append(f"{node.type} {node.forward_m:.0f} {node.left_m:.0f}{lit}")
    return "; ".join(parts) or "nobody"


def _gap_s(conflict: Conflict) -> float | None:
    ego_s, other_s = conflict.ego.time_s, conflict.other.time_s
    return None if ego_s is None or other_s is None else other_s - ego_s


def message(
    view: SceneGraph, intent: Floats, actions: Sequence[str], named: bool = True
) -> dict[str, Any]:
    """Return a helper's message that states an intent (A,), with all fields that a prompt may show.

    They are `evidence`, `risk`, `intent` (in steps of 1/20), `recommended_maneuver` and
    `confidence`. An intent is probabilities of the A actions. `view` is the scene graph, what the
    helper knows of the scene. `actions` has the names of the A actions, the most careful first. If
    `named` is false, the prompt names no vehicle, and the evidence says "one".
    """
    parts = rounded(intent.tolist(), PARTS)
    best = int(np.argmax(intent))
    braking = parts[0]  # the most careful action comes first
    return {
        "evidence": evidence(view, named),
        "risk": "high" if braking > HIGH else "medium" if braking > MEDIUM else "low",
        "intent": tuple(parts),
        "recommended_maneuver": actions[best],
        "confidence": parts[best],
    }


def answer(
    prompt: Prompt,
    view: SceneGraph,
    intent: Floats,
    actions: Sequence[str],
    *,
    bare: bool = False,
    named: bool = True,
) -> str:
    """Return the JSON answer that a viewer should give to `prompt` to state an intent (A,).

    An intent is probabilities of the A actions that `actions` names. `view` is the scene graph,
    what the viewer knows of the scene. If `bare`, its free text is left empty, as in a constrained
    answer. If `named` is false, the prompt names no vehicle, and the text says "one".
    """
    sent = message(view, intent, actions, named)
    numbers = ",".join(f'"{a}":{p:.2f}' for a, p in zip(actions, sent["intent"], strict=True))
    body = f'"action_distribution":{{{numbers}}}'
    best, confidence = sent["recommended_maneuver"], f'"confidence":{sent["confidence"]:.2f}'
    shape = prompt.shape(view.role, actions)
    if key := shape.named:
        body = f'"{key}":"{best}",{confidence}'
    if view.role == "helper":
        reported = "" if bare else sent["evidence"]
        body = f'"evidence":{canonical_json(reported)},"risk":"{sent["risk"]}",{body}'
    for name, schema in reversed(shape.further.items()):
        body = f'"{name}":{canonical_json(plainest(schema))},{body}'
    reasons_first = view.role in prompt.reasons_first and not bare
    return f"{sent['evidence']}. {{{body}}}" if reasons_first else f"{{{body}}}"


def cells(sight: Sight) -> Ints:
    """Return the distance class of every image token of a camera picture, (tokens,), row by row.

    The class is that of the nearest vehicle which the token shows: 0 for none, else 1 to 9 in steps
    of 7 m from the viewer. Learnt as a further target, it trains the vision encoder.
    """
    frame, viewer = sight.frame, sight.state.vehicle(sight.viewer_id)
    classes = np.zeros(len(frame.ids) + 1, dtype=np.int64)  # the last is of pixels that nobody owns
    places = {v.id: (v.x_m, v.y_m) for v in sight.state.vehicles}
    for n, name in enumerate(frame.ids):
        if name in places:
            x_m, y_m = places[name]
            away_m = float(np.hypot(x_m - viewer.x_m, y_m - viewer.y_m))
            classes[n] = 1 + min(CLASSES - 2, int(away_m / STEP_M))
    side = VISION.patch_px * VISION.merge
    height, width = frame.owners.shape
    squares = classes[frame.owners].reshape(height // side, side, width // side, side)
    nearest = np.where(squares == 0, CLASSES, squares).min(axis=(1, 3)).ravel()
    return np.where(nearest == CLASSES, 0, nearest)
