"""Does a better reward mean better driving? Rewards of `harness.environment` beside what policies
drive.

    python benchmarks/reward_ranks.py [--layouts 60] [--scenarios NAME ...] [--then best]

It builds trees of train layouts, which takes a minute to a quarter of an hour a scenario, and keeps
them in the cache folder. Policies are every constant, `uniform`, `open-loop`, `local-view`,
`full-view`, `proxy` and `swarm-tiny-six-v2`. *Rows* is the mean advantage over the rows of
`env.rows()`; *episodes* the mean sum of an episode's rewards, each layout played once; *drives* is
success on the same layouts. The last two are means over layouts with and without a danger.
Kendall's tau (b) says how well either orders policies as driving does.
"""

import argparse
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from constants import scenario_of
from open_loop import SEARCHED
from rows import Row, finish
from scipy.stats import kendalltau

import harness
from harness.backends.registry import open_backend
from harness.backends.swarm import open_each, together
from harness.core.arrays import Floats
from harness.dataset.load import Dataset
from harness.evaluate import latency, resolve
from harness.evaluate.asking import Asker
from harness.extensions.learn.rewards.values import balanced
from harness.runs import settings
from harness.world import drivers

SMALLEST = "--layouts 1 --scenarios parking-exit --models proxy"
TABLE = ""
SCENARIOS = tuple(name for name, limits in SEARCHED if limits == 2)  # of the suite v2v-safety-2
MODELS: Mapping[str, Mapping[str, str]] = {
    "proxy": {},
    "swarm-tiny-six-v2": {"answer": "readout", "latency": "paper"},
}
# what is taken with which probability at decision points, (n, A)
Policy = Callable[[list[str]], Floats]


def looked_up(data: Dataset, table: Floats) -> Policy:
    """Return the policy of a table, (N, A)."""
    return lambda points: table[[data.forest.place[name] for name in points]]


def of_drivers(data: Dataset) -> dict[str, Policy]:
    """Return the policies of everybody who needs no model."""
    forest, each = data.forest, np.eye(len(data.forest.actions))
    points = len(forest.ids)
    tables = {
        f"always {action}": np.tile(each[n], (points, 1)) for n, action in enumerate(forest.actions)
    }
    tables[drivers.UNIFORM] = np.full((points, len(each)), 1 / len(each))
    if sequence := drivers.open_loop(data.scenario):
        tables[drivers.OPEN_LOOP] = each[forest.sequence(sequence)]
    for name in ("local-view", drivers.PRIVILEGED):
        tables[name] = each[forest.drivers[name]]
    return {name: looked_up(data, table) for name, table in tables.items()}


def of_model(model: str, data: Dataset) -> Policy:
    """Return the policy of a model, which takes its likeliest action; of equals each as often."""
    how = {
        "model": model,
        "dataset": str(data.path),
        "prompt": "v4",
        "condition": ["single-local"],
        **MODELS[model],
    }
    stated = settings.changed(settings.Settings(world=settings.FrozenSettings()), how)
    assert isinstance(stated.world, settings.FrozenSettings)
    spec = resolve.spec(stated, resolve.frozen(stated, stated.world.dataset))
    models = open_each(spec.cards, lambda card: open_backend(card, batch_size=32))
    backend = together(spec.cards, models)
    taken_as = latency.chosen_latency("paper", (spec.ego,), models)
    assert taken_as
    asker = Asker(spec, lambda: backend, taken_as)

    def taken(points: list[str]) -> Floats:
        intents = asker(data.scenes(points)).own
        likeliest = intents == intents.max(axis=-1, keepdims=True)
        return np.asarray(likeliest / likeliest.sum(axis=-1, keepdims=True))

    return taken


def played(env: Any, data: Dataset, policy: Policy) -> tuple[Floats, Floats]:
    """Return the sum of rewards of an episode on each layout, and whether it succeeded, (E,)."""
    sums, success = [], []
    for seed in data.seeds:
        _, info = env.reset(seed=seed, options={"layout_seed": seed})
        over, rewards = False, 0.0
        while not over:
            _, reward, over, _, info = env.step(policy([info["scene"]])[0])
            rewards += reward
        sums.append(rewards)
        success.append(float(info["success"]))
    return np.array(sums), np.array(success)


def main() -> None:
    """Print a table of each scenario, and how well rewards order policies."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--layouts", type=int, default=60)
    arguments.add_argument("--scenarios", nargs="+", default=SCENARIOS)
    arguments.add_argument("--models", nargs="+", default=list(MODELS))
    arguments.add_argument("--then", default="best")
    given = arguments.parse_args()
    rows = []
    for name in given.scenarios:
        scenario = scenario_of(name, 2)
        env: Any = harness.environment(
            scenario.name,
            layouts=given.layouts,
            prompt="v4",
            then=given.then,
            distributions=True,
            quiet=True,
        )
        data, values, constant = env.source.dataset, env.values, env.source.constant
        at = env.source.drawn(6)
        asked = [data.forest.ids[n] for n in at]
        advantages = values.table[at] - values.table[at, constant, None]
        print(
            f"\n{name}: {given.layouts} train layouts, {len(at)} rows; rows are less always "
            f"{data.forest.actions[constant]}"
        )
        policies = of_drivers(data) | {model: of_model(model, data) for model in given.models}
        figures = {}
        for who, policy in policies.items():
            of_rows = float(np.einsum("na,na->n", policy(asked), advantages).mean())
            sums, success = played(env, data, policy)
            figures[who] = (
                of_rows,
                balanced(sums, data.dangerous),
                balanced(success, data.dangerous),
            )
            of_rows, episodes, drives = figures[who]
            print(
                f"{who:20} rows {of_rows:+.2f}  episodes {episodes:+.2f}  drives "
                f"{100 * drives:5.1f} %",
                flush=True,
            )
        by_rows, by_episodes, driven = np.round(np.array(list(figures.values())).T, 9)
        for what, earned in (("rows", by_rows), ("episodes", by_episodes)):
            tau = float(kendalltau(earned, driven).statistic)
            print(f"Kendall's tau of {what}: {tau:.2f}")
            rows.append(
                Row(f"rewards of {what} order policies in {name}, Kendall's tau", tau, "", 1)
            )
    finish(rows, layouts=given.layouts, then=given.then)


if __name__ == "__main__":
    main()
