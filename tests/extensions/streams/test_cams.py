"""CAMs as a condition's: when they are sent, and what the ego holds of them in place of beacons."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from studied import Once

from harness.coordination.encodings import ENCODINGS
from harness.coordination.named_points import named_point
from harness.coordination.streams import Hearing
from harness.dataset.build import build
from harness.dataset.load import Dataset, Scene, load
from harness.evaluate.sharing import shared_graphs
from harness.extensions.streams.motion import moments
from harness.extensions.streams.sending import CAM, CPM, senders, stretch
from harness.extensions.streams.services import Services
from harness.radio.profiles import CHANNELS
from harness.world import scenarios
from harness.world.scene_graph import BY_BEACON, AgedNode, SceneGraph

LOSSLESS = replace(CHANNELS["6g"], loss=0.0)
DELAY_S = 0.05
CAMS = Services(0.1, DELAY_S, LOSSLESS, kinds=(CAM,))
CPMS = replace(CAMS, kinds=(CPM,))
BOTH = replace(CAMS, kinds=(CAM, CPM))
LOST = replace(CAMS, channel=replace(LOSSLESS, loss=1.0))


@pytest.fixture(scope="module")
def announced(once: Once) -> Dataset:
    """Scenes in which all other vehicles send beacons."""
    scenario = scenarios.get("occluded-intersection:radio_share=1")

    def make(out: Path) -> object:
        return build(scenario, out, 3, 7, 1, lambda done: None)

    return load(once("announced", make))


def scenes_of(dataset: Dataset) -> list[Scene]:
    return dataset.scenes(dataset.courses())


def graphs(dataset: Dataset, stream: Services) -> list[tuple[Scene, SceneGraph, SceneGraph]]:
    """Each scene, the ego's own graph, and that with what it has heard, if anything."""
    scenes = scenes_of(dataset)
    hearings = []
    for scene, texts in zip(scenes, stream.heard(dataset.scenario, scenes), strict=True):
        if texts:
            hearings.append(Hearing(scene, scene, texts, {}))
    heard = stream.graphs(dataset.scenario, hearings)
    pairs = zip(hearings, heard, strict=True)
    return [(each.scene, each.scene.graphs[each.scene.viewers[0]], graph) for each, graph in pairs]


def by_beacon(graph: SceneGraph) -> set[str]:
    return {node.id for node in graph.nodes if node.sensors == BY_BEACON}


def test_cams_are_sent_when_the_standard_says(announced: Dataset) -> None:
    """4 m, 4°, 0.5 m/s or 1 s, by own arithmetic between the CAMs of a stretch."""
    moved = 0
    for scene in scenes_of(announced):
        messages = stretch(announced.scenario, scene, 0.1, CAM).messages
        times_s = [message.look.time_s for message in messages]
        last: dict[str, tuple[float, float, float, float, float]] = {}
        for message, state in zip(messages, moments(scene, times_s), strict=True):
            v = state.vehicle(message.sender)
            now = (message.look.time_s, v.x_m, v.y_m, v.heading_rad, v.speed_mps)
            if then := last.get(v.id):
                age_s, x_m, y_m, turn_rad, faster_mps = np.subtract(now, then).tolist()
                moves = math.hypot(x_m, y_m) > 4 or abs(faster_mps) > 0.5
                turns = abs(math.remainder(turn_rad, math.tau)) > math.radians(4)
                assert 0.1 - 1e-9 <= age_s <= 1 + 1e-9
                assert moves or turns or age_s >= 0.3 - 1e-9
                moved += moves or turns
            last[v.id] = now
        assert set(last) <= {v.id for v in senders(scene.state, CAM)}
    assert moved > 50


def test_cams_stand_in_the_place_of_beacons(announced: Dataset) -> None:
    compared = 0
    for scene, own, graph in graphs(announced, CAMS):
        assert not by_beacon(graph)
        nodes = {node.id: node for node in graph.nodes}
        assert set(own.seen) <= set(nodes)
        assert graph.sectors == own.sectors
        for name in by_beacon(own):
            node, true = nodes[name], scene.state.vehicle(name)
            assert isinstance(node, AgedNode)
            assert DELAY_S - 1e-9 <= node.age_s <= 1 + DELAY_S + 0.1
            assert abs(node.speed_mps - true.speed_mps) < 2
            compared += 1
    assert compared > 5


def test_a_lost_cam_leaves_no_beacon(announced: Dataset) -> None:
    """Else an ego that heard nothing would know more than one that heard something."""
    without = 0
    for _, own, graph in graphs(announced, LOST):
        without += len(by_beacon(own))
        assert by_beacon(own)
        assert graph.nodes == own.sensed
        assert {conflict.vehicle for conflict in graph.conflicts} <= set(own.seen)
    assert without > 5


def test_both_kinds_are_held_and_counted_together(announced: Dataset) -> None:
    scenes, scenario = scenes_of(announced), announced.scenario
    cams, cpms, both = (stream.sent(scenario, scenes) for stream in (CAMS, CPMS, BOTH))
    for ours, theirs, together in zip(cams, cpms, both, strict=True):
        assert together == pytest.approx(ours + theirs)
    assert cams.messages.sum() > 0
    known = {scene.id: set(graph.seen) for scene, _, graph in graphs(announced, CPMS)}
    for scene, _, graph in graphs(announced, BOTH):
        assert known.get(scene.id, set()) - by_beacon(graph) <= set(graph.seen)


def test_a_cam_is_as_long_as_a_beacon_of_its_encoding(announced: Dataset) -> None:
    stream = named_point("its-g5:stream=cam,encoding=etsi").stream
    assert isinstance(stream, Services)
    messages = stretch(announced.scenario, scenes_of(announced)[0], 0.1, CAM).messages
    expected = ENCODINGS["etsi"].packet_bits("beacon", headers=True)
    assert stream.bits(messages).tolist() == [float(expected)] * len(messages)


def test_a_key_alone_makes_the_graph_again(announced: Dataset) -> None:
    scenes = {scene.id: scene for scene in scenes_of(announced)}
    sets = []
    for scene in scenes.values():
        [texts] = BOTH.heard(announced.scenario, [scene])
        sets.append((scene, [f"{name}!stream:{text}" for name, text in texts.items()]))
    sets = [each for each in sets if each[1]]
    made = shared_graphs(announced.scenario, sets, scenes)
    assert list(made) == [graph for _, _, graph in graphs(announced, BOTH)]
