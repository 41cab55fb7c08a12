"""Examples for a prompt version: decision points of train layouts, answered as their outcomes ask for."""

from collections.abc import Callable
from typing import Any

import numpy as np

from harness.core import noise
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.core.seeds import FIRST, purposes
from harness.prompts.examples import Example, Examples
from harness.prompts.versions import ROLES, Prompt
from harness.training.answers import answer
from harness.training.lessons import drawn
from harness.world.scenario import Scenario

PATIENCE = 8  # layouts that are passed over, at most, for want of an action that was shown less


def examples(
    prompt: Prompt, scenario: Scenario, count: int, first_seed: int, progress: Callable[[int], None]
) -> Examples:
    """So many examples for each role, each from a layout of its own, the layout seeds from `first_seed` on.

    Of a layout's decision points, one is taken whose best action the role's examples have shown least so far,
    the most careful of such actions first, and whose viewer sees a conflict, so that there is a reason to be
    seen; a keyed draw decides between equals. A layout in which nothing is safe is passed over, and so are a
    few whose best actions have all been shown oftener than others.

    Args:
        prompt: the version, whose form of answer they have.
        scenario: what is decided in.
        count: how many for each role, 1 or more.
        first_seed: layout seed of the first.
        progress: called with 1 for each layout that gave examples.

    Raises:
        UserError: the train seeds end before there are enough.
    """
    shown: dict[str, list[Example]] = {role: [] for role in ROLES}
    times = {role: [0] * len(scenario.actions) for role in ROLES}
    seed, passed = first_seed, 0
    while len(shown["ego"]) < count:
        if purposes(seed, 1) != ["train"]:
            raise UserError(
                f"--first-seed {first_seed}: layout seed {seed} is no train seed; give {FIRST['train']} to "
                f"{FIRST['report'] - 1}"
            )
        if points := drawn(scenario, seed, 0):
            picked = {
                role: one for role in ROLES if (one := _pick(points, role, times[role], seed)) is not None
            }
            rare = all(times[role][best] == min(times[role]) for role, (_, _, best) in picked.items())
            if rare or passed == PATIENCE:
                for role, (graph, label, best) in picked.items():
                    times[role][best] += 1
                    said = answer(prompt, graph, label, scenario.actions)
                    shown[role].append(Example(seed, graph, said))
                progress(1)
                passed = 0
            else:
                passed += 1
        seed += 1
    return Examples(scenario.name, ego=tuple(shown["ego"]), helper=tuple(shown["helper"]))


def _pick(
    points: list[dict[str, Any]], role: str, times: list[int], seed: int
) -> tuple[dict[str, Any], Floats, int] | None:
    """The scene graph that is shown, its soft label (A,), and its best action by number.

    None where nobody has the role.
    """
    every = [
        (graph, label := np.array(point["label"]), int(label.argmax()))
        for point in points for graph in point["moment"]["graphs"].values() if graph["role"] == role
    ]  # fmt: skip
    order = noise.generator("examples", role, seed).permutation(len(every)).tolist()
    return min(
        (every[n] for n in order), default=None,
        key=lambda one: (times[one[2]], one[2], not one[0]["conflicts"]),
    )  # fmt: skip
