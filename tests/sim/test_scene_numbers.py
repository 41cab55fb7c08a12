"""The numbers of a scene graph by name."""

from harness.world.perception.graph import scene_graph
from harness.world.scenarios.occluded_intersection import SCENARIO
from harness.world.scene_numbers import numbers
from harness.world.world import World


def test_every_graph_gives_the_same_names():
    road, names = SCENARIO.road(), set()
    for seed in range(5):
        state = World.start(SCENARIO, seed).state()
        for viewer in ("v1", "v2"):
            names.add(tuple(dict(numbers(scene_graph(SCENARIO, state, viewer), road))))
    assert len(names) == 1
    assert len(set(*names)) == len(*names)
