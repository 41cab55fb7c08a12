"""Examples for a prompt version: decision points of train layouts,
answered as their outcomes ask for.
"""

from collections.abc import Callable

import numpy as np

from harness.core import noise
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.core.seeds import FIRST, purposes
from harness.dataset import rebuilt
from harness.extensions.learn.training.answers import answer
from harness.extensions.learn.training.lessons import Point, decision_points
from harness.prompts.examples import Example, Examples
from harness.prompts.versions import ROLES, Prompt
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

PATIENCE = 8  # layouts that are passed over, at most, for want of an action that was shown less
# a scene graph, its soft label (A,), and its best action's number
Candidate = tuple[SceneGraph, Floats, int]


def examples(
    prompt: Prompt, scenario: Scenario, count: int, first_seed: int, progress: Callable[[int], None]
) -> Examples:
    """Draw `count` worked examples for a prompt to show, 1 or more for each role (ego, helper).

    Each is from a layout (start situation) of its own; layouts have the seeds from `first_seed` on.
    An example is a decision whose best action the role's examples show least so far, and in which
    the vehicle that is asked sees a conflict of paths, where one does. A layout with no safe action
    is passed over, and so are a few that repeat frequent actions. `progress` is called with 1 for
    each layout used. Raises UserError if the train seeds end too early.
    """
    chosen: dict[str, list[Example]] = {role: [] for role in ROLES}
    times = {role: [0] * len(scenario.actions) for role in ROLES}
    seed, passed = first_seed, 0
    while len(chosen["ego"]) < count:
        if purposes(seed, 1) != ["train"]:
            raise UserError(
                f"--first-seed {first_seed}: layout seed {seed} is no train seed; give "
                f"{FIRST['train']} to {FIRST['report'] - 1}"
            )
        rebuilt.refuse_drawn(scenario, [seed])
        if points := decision_points(scenario, seed, 0):
            candidates: dict[str, Candidate] = {}
            for role in ROLES:
                candidate = _pick(points, role, times[role], seed)
                if candidate:
                    candidates[role] = candidate
            rare = all(
                times[role][best] == min(times[role]) for role, (_, _, best) in candidates.items()
            )
            passed = 0 if rare or passed == PATIENCE else passed + 1
            if not passed:
                for role, (graph, label, best) in candidates.items():
                    times[role][best] += 1
                    text = answer(prompt, graph, label, scenario.actions)
                    chosen[role].append(Example(seed, graph, text))
                progress(1)
        seed += 1
    return Examples(scenario.name, ego=tuple(chosen["ego"]), helper=tuple(chosen["helper"]))


def _pick(points: list[Point], role: str, times: list[int], seed: int) -> Candidate | None:
    """Return the decision point of a role that is shown; None where nobody has the role."""
    candidates: list[Candidate] = []
    for point in points:
        label = np.array(point.label)
        best = int(label.argmax())
        graphs = [graph for graph in point.record.graphs.values() if graph.role == role]
        candidates += [(graph, label, best) for graph in graphs]
    order = noise.generator("examples", role, seed).permutation(len(candidates)).tolist()

    def rank(candidate: Candidate) -> tuple[int, int, bool]:
        graph, _, best = candidate
        return times[best], best, not graph.conflicts

    return min((candidates[n] for n in order), default=None, key=rank)
