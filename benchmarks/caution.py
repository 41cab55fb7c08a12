"""What one needless SLOWER costs in layouts without a danger,
from which `harmless_allowance_s` follows.

    python benchmarks/caution.py [--layouts 200] [--scenes SCENES] [--scenarios NAME ...]

It drives full-view through those of so many tune layouts of each scenario, as SCENES has them drawn
and judged. At each decision at which it does not slow down, an ego takes SLOWER instead and then
drives as full-view does. The table has by how much later it reaches the goal, and how often that is
more than is allowed.
"""

import argparse
from collections.abc import Sequence

import numpy as np

from harness.core.arrays import Floats
from harness.core.seeds import FIRST, seeds_text
from harness.core.statistics import rate_interval
from harness.world import lockstep, reference, scenarios
from harness.world.drivers import ALWAYS, PRIVILEGED
from harness.world.outcome import ROUNDING_S, Outcome
from harness.world.scenario import Scenario
from harness.world.world import World

SMALLEST = "--layouts 4 --scenarios blind-merge"
SCENES = "limits=2,witnesses=any,radio_share=0,perception=1"
SLOWER = ALWAYS["brake"]


def costs_s(scenario: Scenario, seeds: Sequence[int]) -> Floats:
    """Return how much later full-view reaches its goal with a SLOWER at each decision,
    (E, K), in seconds.

    Inf stands for never, NaN where full-view slows down too, is at its end, or fails.
    """
    p, n = scenario.parameters, len(seeds)
    worlds, apart = [World.start(scenario, seed) for seed in seeds], {}
    for step in range(p.decisions):
        going = [e for e in range(n) if not worlds[e].outcome.ended]
        if not going:
            break
        driven = [worlds[e] for e in going]
        actions = [each[0] for each in reference.decide(driven, [PRIVILEGED] * len(driven))]
        lockstep.advance(driven, [p.due_frame(step) + p.lag_frames] * len(driven))
        for e, world, action in zip(going, driven, actions, strict=True):
            if action != SLOWER and not world.outcome.ended:
                apart[e, step] = world.branch()
                apart[e, step].decide(SLOWER)
            world.decide(action)
        slowed = [apart[e, step] for e in going if (e, step) in apart]
        lockstep.advance([*driven, *slowed], [p.due_frame(step + 1)] * (len(driven) + len(slowed)))
    reference.finish([*worlds, *apart.values()], [PRIVILEGED] * (n + len(apart)))
    goal_s = np.array([_goal_s(world.outcome) for world in worlds])
    later_s = np.full((n, p.decisions), np.nan)
    for (e, step), world in apart.items():
        if np.isfinite(goal_s[e]):
            later_s[e, step] = _goal_s(world.outcome) - goal_s[e]
    return later_s


def _goal_s(outcome: Outcome) -> float:
    return outcome.time_s if outcome.success and outcome.time_s is not None else np.inf


def main() -> None:
    """Measure and print."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--layouts", type=int, default=200)
    arguments.add_argument("--scenes", default=SCENES)
    arguments.add_argument("--scenarios", nargs="+", default=scenarios.witnessed())
    given = arguments.parse_args()
    layouts, scenes = given.layouts, given.scenes
    print(
        f"harmless layouts of {layouts} each, {seeds_text(FIRST['tune'], layouts)}, {scenes}; "
        "seconds later"
    )
    print(f"{'scenario':22} decision    n   0 %    5 %   50 %  100 %   late, % [95 % interval]")
    for name in given.scenarios:
        scenario = scenarios.get(f"{name}:{scenes}")
        seeds = range(FIRST["tune"], FIRST["tune"] + layouts)
        harmless = [s for s in seeds if scenario.layout(s, scenario.parameters).danger is None]
        parts = [
            costs_s(scenario, harmless[n : n + reference.TOGETHER])
            for n in range(0, len(harmless), reference.TOGETHER)
        ]
        driven = reference.drive_all(scenario, harmless)
        for step, later_s in enumerate(np.concatenate(parts).T):
            show(name, step, later_s[~np.isnan(later_s)], scenario.parameters.allowance_s(None))
        counts = (f"{d} {sum(out[d].success for out in driven)}" for d in driven[0])
        print(f"{name:22} of {len(harmless)} succeed:", ", ".join(counts))


def show(name: str, step: int, later_s: Floats, allowed_s: float) -> None:
    """Print a row: percentiles of the delay, and the share that is late."""
    if len(later_s):
        late = rate_interval((later_s > allowed_s + ROUNDING_S).astype(float))
        spread = (f"{x:6.2f}" for x in np.percentile(later_s, (0, 5, 50, 100), method="lower"))
        rate = f"{100 * late.value:5.1f} [{100 * late.low:.1f}, {100 * late.high:.1f}]"
        print(f"{name:22} {step:8} {len(later_s):4}", *spread, rate)


if __name__ == "__main__":
    main()
