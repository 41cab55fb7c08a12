"""Play egos that look at nothing: what may be promised without a model, to hold one against."""

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.dataset.load import Dataset
from harness.extensions.promise.outcomes import Outcome
from harness.extensions.promise.promises import Harm
from harness.world.drivers import OPEN_LOOP, UNIFORM, open_loop


def blind_outcomes(dataset: Dataset, harm: Harm) -> dict[str, Outcome]:
    """Return how egos that look at nothing do in E layouts, by what tables call them.

    They always take the same action, one ego each; take the fixed sequence that did best in the
    scenario's tune layouts (`open-loop`); or draw actions (`uniform`), for which probabilities, by
    the decision trees, stand in place of 0 and 1.
    """
    forest, limits = dataset.forest, dataset.scenario.parameters.limits
    sequences: dict[str, tuple[str, ...]] = {
        f"always {action}": (action,) for action in forest.actions
    }
    best = open_loop(dataset.scenario)
    if best and set(best) <= set(forest.actions):
        sequences[OPEN_LOOP] = best
    ends = dict[str, tuple[Bools | Floats, Bools | Floats]]()
    for name, actions in sequences.items():
        last = forest.last_edge(forest.sequence(actions))
        ends[name] = forest.unsafe(last, limits), forest.sequence_success(actions)
    unsafe = forest.chance(np.ones(forest.child.shape), forest.unsafe(forest.edge, limits))
    ends[UNIFORM] = unsafe[forest.root].mean(axis=-1), forest.uniform_success()
    outcomes = {}
    for name, (unsafe_ends, successes) in ends.items():
        success = successes.astype(float)[None]
        harms = unsafe_ends.astype(float)[None] if harm == "unsafe" else 1 - success
        outcomes[name] = Outcome(harms, success, {})
    return outcomes
