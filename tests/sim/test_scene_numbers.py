"""The numbers of a scene graph by name."""

from typing import get_args

from harness.world.perception.graph import scene_graph
from harness.world.scenarios.occluded_intersection import SCENARIO
from harness.world.scene_numbers import BY_SIZE, numbers
from harness.world.simulator import KINDS
from harness.world.state import HEIGHTS_M, SIZES_M, Kind
from harness.world.world import World


def test_every_graph_gives_the_same_names():
    road, names = SCENARIO.road(), set()
    for seed in range(5):
        state = World.start(SCENARIO, seed).state()
        for viewer in ("v1", "v2"):
            names.add(tuple(dict(numbers(scene_graph(SCENARIO, state, viewer), road))))
    assert len(names) == 1
    assert len(set(*names)) == len(*names)


def test_every_kind_has_its_numbers_and_moves_in_its_size():
    for table in (SIZES_M, HEIGHTS_M, KINDS, BY_SIZE):
        assert {*table} == {*get_args(Kind)}
    assert {kind: (of.LENGTH, of.WIDTH) for kind, of in KINDS.items()} == SIZES_M
