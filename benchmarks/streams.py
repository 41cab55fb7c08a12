"""What a stream of CPMs rests on: how well motion between decisions is known, and what is sent.

    python benchmarks/streams.py [--layouts 30] [--datasets NAME ...]

The first table drives tune layouts of each scenario by drawn actions, and compares where vehicles
are ten times a second with where `harness.extensions.streams.motion` puts them by the states at the
decisions alone. The second has the CPMs at decision points of each dataset's report layouts, and
what an ego holds of them under `6g`. The third has the share of time that all helpers' CPMs, as
ETSI encodes them, take on `its-g5`, beside that of the background's packets, all uncontrolled.
"""

import argparse
import random
from collections.abc import Sequence
from statistics import mean

import numpy as np

from harness.coordination.named_points import named_point
from harness.coordination.streams import Hearing
from harness.core.seeds import FIRST
from harness.dataset.load import Earlier, Scene, find, load
from harness.evaluate.live_world import look
from harness.extensions.streams.motion import moments
from harness.extensions.streams.sending import stretch
from harness.extensions.streams.services import Services
from harness.world import lockstep
from harness.world.scenario import Scenario
from harness.world.scene_graph import AgedNode
from harness.world.state import WorldState
from harness.world.world import World

SMALLEST = "--layouts 2 --datasets hard-brake-ahead-v2"
DATASETS = (
    "occluded-intersection-v3", "hard-brake-ahead-v2", "do-not-pass-v2", "roundabout-entry-v2",
    "parking-exit-v2", "blind-merge-v2",
)  # fmt: skip
EVERY_FRAMES = 5  # a tenth of a second
SENT = "its-g5:encoding=etsi,"
DENSITIES_PER_KM = (60, 120)


def away_m(scenario: Scenario, seeds: Sequence[int]) -> list[float]:
    """Return how far vehicles are from where their motion puts them, m."""
    p, distances_m = scenario.parameters, list[float]()
    for seed in seeds:
        world, drawn = World.start(scenario, seed), random.Random(seed)
        before = look(world, 0, 0, 0, ego_alone=True)
        for step in range(p.decisions):
            lockstep.advance([world], [p.due_frame(step) + p.lag_frames])
            if not _goes_on(world):
                break
            world.take(drawn.choice(scenario.actions), 0)
            states: list[WorldState] = []
            begin, end = p.due_frame(step) + p.lag_frames, p.due_frame(step + 1)
            for frame in (*range(begin + EVERY_FRAMES, end, EVERY_FRAMES), end):
                lockstep.advance([world], [frame])
                states.append(world.state(0))
            if not _goes_on(world):
                break
            scene = look(world, 0, 0, step + 1, ego_alone=True)
            distances_m += _distances_m(Scene(scene.record, before=Earlier(before)), states)
            before = scene
    return distances_m


def _goes_on(world: World) -> bool:
    return not world.outcome.ended


def _distances_m(scene: Scene, states: Sequence[WorldState]) -> list[float]:
    distances_m = []
    found = moments(scene, [state.time_s for state in states])
    for there, state in zip(found, states, strict=True):
        for v in there.vehicles:
            true = state.vehicle(v.id)
            distances_m.append(float(np.hypot(v.x_m - true.x_m, v.y_m - true.y_m)))
    return distances_m


def load_of(name: str, layouts: int) -> tuple[float, ...]:
    """Return what is sent and held at a dataset's decision points, by the columns of `main`."""
    dataset = load(find(name), layouts)
    scenario, stream = dataset.scenario, named_point("6g:stream=cpm").stream
    assert isinstance(stream, Services)
    scenes = [scene for scene in dataset.scenes(dataset.courses()) if scene.before()]
    cpms = [cpm for s in scenes for cpm in stretch(scenario, s, stream.interval_s).messages]
    seconds = sum(len(s.state.helpers) for s in scenes) * scenario.parameters.decision_period_s
    heard = stream.heard(scenario, scenes)
    pairs = zip(scenes, heard, strict=True)
    graphs = stream.graphs(scenario, [Hearing(scene, scene, texts, {}) for scene, texts in pairs])
    nodes = [node for graph in graphs for node in graph.nodes]
    ages_s = [node.age_s for node in nodes if isinstance(node, AgedNode)]
    own = [len(scene.graphs[scene.viewers[0]].nodes) for scene in scenes]
    return (
        len(cpms) / seconds,
        mean(len(cpm.objects) for cpm in cpms),
        float(stream.bits(cpms).mean()) / 8,
        mean(len(scene.state.vehicles) - 1 for scene in scenes),
        mean(own),
        len(nodes) / len(graphs),
        mean(ages_s),
    )


def on_air(name: str, layouts: int) -> tuple[float, ...]:
    """Return what helpers' CPMs take of the time on `its-g5`, in % of it.

    It is the mean and the most at a dataset's decision points, each of the time since the one
    before; then comes the background's busy ratio at each of `DENSITIES_PER_KM`.
    """
    dataset, stream = load(find(name), layouts), named_point(f"{SENT}stream=cpm").stream
    assert stream is not None
    scenes = [scene for scene in dataset.scenes(dataset.courses()) if scene.before()]
    airtime_s = stream.sent(dataset.scenario, scenes).airtime_s
    shares = airtime_s / dataset.scenario.parameters.decision_period_s
    values = [float(shares.mean()), float(shares.max())]
    for density in DENSITIES_PER_KM:
        radio = named_point(f"{SENT}density_per_km={density}").physical
        assert radio is not None
        values.append(radio.busy_ratio())
    return tuple(100 * value for value in values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--layouts", type=int, default=30)
    parser.add_argument("--datasets", nargs="+", default=list(DATASETS))
    args = parser.parse_args()
    print("| scenario | places | exact to 1 cm, % | 99 % within, m | largest, m |")
    print("|---|--:|--:|--:|--:|")
    for name in args.datasets:
        scenario = load(find(name), 1).scenario
        first = FIRST["tune"]
        found = np.array(away_m(scenario, range(first, first + args.layouts)))
        exact = 100 * float(np.mean(found < 0.01))
        within = float(np.quantile(found, 0.99))
        print(
            f"| `{scenario.name}` | {len(found)} | {exact:.1f} | {within:.2f} | {found.max():.2f} |"
        )
    print("\n| dataset | CPMs/s | objects | bytes | vehicles | seen | known | age, s |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    for name in args.datasets:
        cells = " | ".join(f"{value:.2f}" for value in load_of(name, args.layouts))
        print(f"| `{name}` | {cells} |")
    print("\n| dataset | CPMs, % of time | most | background at 60 a km | at 120 |")
    print("|---|--:|--:|--:|--:|")
    for name in args.datasets:
        cells = " | ".join(f"{value:.2f}" for value in on_air(name, args.layouts))
        print(f"| `{name}` | {cells} |")


if __name__ == "__main__":
    main()
