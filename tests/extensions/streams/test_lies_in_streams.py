"""What an ego hears of a stream where helpers are blind, in another layout, or lie.

Scenes are frozen ones of a real dataset, and nothing is lost, but where seeds are compared.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import as_read, live_spec_of, run, scenes_of, spec_of, walked

from harness.backends.registry import open_backend
from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError
from harness.core.files import digest
from harness.dataset.load import Dataset, Scene
from harness.evaluate.dry_run import count
from harness.evaluate.fusion import codes_of, source_of
from harness.evaluate.requests import fusion_id, stream_sets
from harness.evaluate.sharing import shared_graphs
from harness.evaluate.spec import Spec
from harness.extensions.streams.services import Services
from harness.runs import folder
from harness.world.perception.shared import NOBODY, invented
from harness.world.scene_graph import AgedNode, SceneGraph

pytest.importorskip("harness.extensions.controls")
trust = pytest.importorskip("harness.extensions.trust.attacks")

STREAM = "6g:stream=cpm,tau_nats=9,loss=0"
CHANGED = ("messages=shuffled", "messages=blind", "attack=ghost", "attack=hide+shift:offset_m=3")


@pytest.fixture(scope="module")
def pair(small: Dataset) -> Dataset:
    return small.of_episodes({0, 1})


def heard(
    dataset: Dataset, point: OperatingPoint, scenes: Sequence[Scene]
) -> list[tuple[Scene, list[str], SceneGraph]]:
    """Each scene, the keys of what its ego hears if all helpers attack, and its graph."""
    helpers = max(len(scene.viewers) for scene in scenes) - 1
    attacks = np.ones((len(scenes), helpers if point.rewrites.changes.of_attackers else 0), bool)
    places = np.arange(len(scenes))
    if point.rewrites.elsewhere:
        places = places * len(scenes) + np.roll(places, -1)
    assert point.stream
    codes = codes_of(attacks, places)
    sets = stream_sets(dataset.scenario, scenes, point.stream, codes, point.rewrites)
    graphs = shared_graphs(dataset.scenario, sets, {scene.id: scene for scene in scenes})
    made = []
    for (scene, senders), graph in zip(sets, graphs, strict=True):
        assert graph
        made.append((scene, senders, graph))
    return made


def told(graph: SceneGraph) -> list[AgedNode]:
    """Who is known by a message."""
    return [node for node in graph.nodes if isinstance(node, AgedNode)]


def of_others(graph: SceneGraph) -> list[AgedNode]:
    """Who is known by another's message."""
    return [node for node in told(graph) if node.sensors != (f"v2v:{node.id}",)]


def place(scene: Scene, node: AgedNode) -> tuple[float, float]:
    """Where a node of the ego's graph is, in the frame of the road."""
    ego = scene.state.ego
    c, s = math.cos(ego.heading_rad), math.sin(ego.heading_rad)
    x_m = ego.x_m + node.forward_m * c + node.left_m * s
    return x_m, ego.y_m + node.forward_m * s - node.left_m * c


# -- controls --------------------------------------------------------------------------------------


def test_blind_helpers_tell_where_they_are_and_nothing_else(small: Dataset) -> None:
    scenes, known = scenes_of(small), 0
    for scene, senders, graph in heard(small, named_point(f"{STREAM},messages=blind"), scenes):
        assert all("~blind!stream:cpm:0.1:" in sender for sender in senders)
        assert not of_others(graph)
        assert graph.sectors == scene.graphs[scene.viewers[0]].sectors
        known += len(told(graph))
    assert known > 20


def test_a_shuffled_stream_puts_what_is_there_at_its_place_there(pair: Dataset) -> None:
    """By own arithmetic, from what the other layout's ego received, without that ego."""
    exact = replace(pair.scenario.parameters, perfect_knowledge=True)  # of senders' own poses
    dataset = replace(pair, _scenes={})
    scenes, point = scenes_of(dataset), named_point(f"{STREAM},messages=shuffled")
    by_id, checked = {scene.id: scene for scene in scenes}, 0
    there = replace(pair.scenario, parameters=exact)
    assert isinstance(point.stream, Services)
    for scene, senders, _ in heard(pair, point, scenes):
        source = by_id[source_of(scene.id, senders)]
        assert source.id != scene.id
        objects: dict[tuple[str, float, str], Any] = {}
        [received] = point.stream.received(pair.scenario, [source])
        for sent in received:
            age_s = round(source.state.time_s - sent.look.time_s, 2)
            objects |= {(d.id, age_s, f"v2v:{sent.sender}"): d for d in sent.objects}
        [graph] = shared_graphs(there, [(scene, senders)], by_id)
        assert graph
        for node in of_others(graph):
            assert node.id != source.viewers[0]
            d = objects[node.id, node.age_s, node.sensors[0]]
            x_m, y_m = place(scene, node)
            moved_m = 0.0 if d.heading_rad is None else node.age_s * d.speed_mps
            heading_rad = d.heading_rad or 0.0
            assert x_m == pytest.approx(d.x_m + moved_m * math.cos(heading_rad), abs=0.4)
            assert y_m == pytest.approx(d.y_m + moved_m * math.sin(heading_rad), abs=0.4)
            checked += 1
    assert checked > 20


def test_who_has_no_other_layout_hears_nobody(small: Dataset) -> None:
    point = named_point(f"{STREAM},messages=shuffled")
    scenes = scenes_of(small)[:1]
    assert heard_alone(small, point, scenes) == [fusion_id(scenes[0], [])]


def heard_alone(dataset: Dataset, point: OperatingPoint, scenes: Sequence[Scene]) -> list[str]:
    assert point.stream
    codes = np.zeros(1, dtype=int)
    sets = stream_sets(dataset.scenario, scenes, point.stream, codes, point.rewrites)
    return [fusion_id(*each) for each in sets]


def test_where_every_message_is_lost_a_stream_is_silent(small: Dataset) -> None:
    scenes = scenes_of(small)
    for radio in ("6g", "its-g5"):
        stream = named_point(f"{radio}:stream=cpm,loss=1").stream
        assert stream
        assert not any(stream.heard(small.scenario, scenes))


# -- attacks ---------------------------------------------------------------------------------------


def test_a_liar_invents_hides_or_shifts_in_each_cpm(pair: Dataset) -> None:
    scenes = scenes_of(pair)
    plain = heard(pair, named_point(STREAM), scenes)
    ghosts, hidden, moved = (
        heard(pair, named_point(f"{STREAM},attack={attack}"), scenes)
        for attack in ("ghost", "hide", "shift:offset_m=8")
    )
    shifted = invented_cars = 0
    for (scene, senders, true), ghost, nobody, beside in zip(
        plain, ghosts, hidden, moved, strict=True
    ):
        assert [sender.partition("&")[2] for sender in ghost[1]] == ["ghost"] * len(senders)
        # Where the ego sees another car at its place, it is taken for that one.
        invented_cars += NOBODY in {node.id for node in of_others(ghost[2])}
        assert NOBODY not in {node.id for node in true.nodes}
        assert not of_others(nobody[2])
        assert {sector.seen_share for sector in nobody[2].sectors} == {1.0}
        places = {(n.id, n.sensors, n.age_s): place(scene, n) for n in of_others(true)}
        for node in of_others(beside[2]):
            true_place = places.get((node.id, node.sensors, node.age_s))
            if true_place:
                away_m = math.dist(place(scene, node), true_place)
                assert away_m == pytest.approx(8, abs=0.5)
                shifted += 1
    assert shifted > 10
    assert invented_cars > 0.9 * len(scenes)


def test_a_ghost_drives_on_as_its_rule_says_from_one_cpm_to_the_next(small: Dataset) -> None:
    """Carried on from its last CPM it is near where a list that is asked for now would have it."""
    aged = 0
    for scene, senders, graph in heard(
        small, named_point(f"{STREAM},attack=ghost"), scenes_of(small)
    ):
        viewer = senders[0].partition("!")[0]
        now = invented(small.scenario, scene.state, viewer)
        sender = scene.state.vehicle(viewer)
        c, s = math.cos(sender.heading_rad), math.sin(sender.heading_rad)
        x_m = sender.x_m + now.forward_m * c + now.left_m * s
        y_m = sender.y_m + now.forward_m * s - now.left_m * c
        for node in of_others(graph):
            if node.id == NOBODY:
                # The ego may have changed its speed by 6 m/s², and places have a beacon's errors.
                within_m = 3 * node.age_s**2 + 3
                assert math.dist(place(scene, node), (x_m, y_m)) < within_m
                aged += node.age_s > 0.05
    assert aged > 10


class Watching:
    """A proxy that keeps the ids of what it is asked."""

    def __init__(self, spec: Spec) -> None:
        self.proxy, self.asked = open_backend(spec.ego.card), list[str]()

    def complete(self, requests: Any) -> Any:
        self.asked += [request.id for request in requests]
        return self.proxy.complete(requests)

    def identity(self) -> Any:
        return self.proxy.identity()


def test_attackers_are_drawn_by_layout_and_are_the_same_in_all_they_say(small: Dataset) -> None:
    """One of three, in what is sent unasked and asked for, whatever the channel's seed is."""
    points = (named_point("6g:stream=cpm,loss=0,tau_nats=0,attack=ghost:share=1/3+liar:share=1/3"),)
    spec = spec_of(small, points=points, seeds=(0, 1))
    backend = Watching(spec)
    parts = walked(spec, backend).parts
    attackers: dict[int, set[str]] = {}
    for part in parts:
        for row, at in enumerate(part.due.at.tolist()):
            scene = part.decision_points[at]
            those = np.flatnonzero(part.said.attackers[row]).tolist()
            names = {scene.viewers[1 + h] for h in those}
            assert len(names) == 1
            attackers.setdefault(scene.record.episode, set()).update(names)
    assert {len(names) for names in attackers.values()} == {1}
    assert len(set.union(*attackers.values())) > 1
    for name in backend.asked:
        scene_id, _, key = name.partition("/")
        liars = {sender.partition("!")[0] for sender in key.split("+") if "&ghost" in sender}
        assert liars <= attackers[int(scene_id.partition("-")[0])]
    assert any("&ghost" in name for name in backend.asked)


def test_a_liar_in_a_stream_alone_asks_no_helper(small: Dataset) -> None:
    spec = spec_of(small, points=(named_point(f"{STREAM},attack=ghost"),), seeds=(0,))
    assert {answer.role for answer in walked(spec, Watching(spec)).answers} == {"ego", "merge"}


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        ("spoof", "attack is 'spoof'; it must be one of what attackers say"),
        ("liar+jump", "attack is 'liar+jump'; it must be one of what attackers say"),
        ("sybil", "not of who and where they are, where there is a stream"),
        ("flood", "not of who and where they are, where there is a stream"),
        ("ghost+liar:share=1", "attacks of one share where there is a stream"),
    ],
)
def test_an_attack_that_a_stream_would_belie_is_refused_in_one_line(
    attack: str, message: str
) -> None:
    with pytest.raises(UserError) as error:
        named_point(f"6g:stream=cpm,attack={attack}")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_who_asks_nobody_still_hears_a_stream() -> None:
    silent = named_point("6g:stream=cpm,schedule=never")
    assert silent.idle("attack") is silent.idle("loss") is silent.idle("messages") is None
    assert silent.idle("consensus") == "schedule never asks nobody"
    assert named_point("6g:schedule=never").idle("loss") == "schedule never asks nobody"


# -- runs ------------------------------------------------------------------------------------------


def points_of(settings: Sequence[str]) -> tuple[OperatingPoint, ...]:
    return tuple(named_point(f"6g:stream=cpm,tau_nats=9,{each}") for each in settings)


@pytest.mark.slow
def test_a_key_says_what_became_of_a_stream(pair: Dataset, tmp_path: Path) -> None:
    """Further seeds ask no more, and whoever reads a run sees what was asked."""
    one, two = (
        folder.read(run(spec_of(pair, points=points_of(CHANGED), seeds=seeds), tmp_path / name).out)
        for name, seeds in (("one", (0,)), ("two", (0, 1)))
    )
    assert {answer.id for answer in one.answers} == {answer.id for answer in two.answers}
    of_attack = points_of(CHANGED[1:])
    spec = spec_of(pair, points=of_attack, seeds=(0,))
    stored = folder.read(run(spec, tmp_path / "read").out)
    marks = set[str]()
    for answer, _, messages in as_read(stored, pair):
        assert digest(messages) == answer.prompt_sha256
        marks |= {key.partition("&")[2] or "~" * ("~" in key) for key in answer.heard}
    assert marks == {"", "~", "ghost", "hide&shift:offset_m=3"}


@pytest.mark.slow
def test_a_pair_for_training_has_the_other_layouts_stream(pair: Dataset, tmp_path: Path) -> None:
    pairs = pytest.importorskip("harness.extensions.learn.training.pairs").pairs
    stored = folder.read(run(spec_of(pair, points=points_of(CHANGED[:1])), tmp_path / "run").out)
    asked = {answer.prompt_sha256 for answer in stored.answers}
    shuffled = [pair for pair in pairs(stored) if "&from:" in pair["viewer"]]
    assert shuffled
    assert {digest(pair["prompt"]) for pair in shuffled} <= asked


def test_a_dry_run_counts_a_question_a_scene_whatever_became_of_the_stream(pair: Dataset) -> None:
    plain = named_point("6g:stream=cpm,tau_nats=9")
    points = (plain, *points_of(CHANGED))
    counted = count(spec_of(pair, points=points), pair, None)
    assert set(counted["streamed"].values()) == {counted["streamed"][plain.name]}
    ego = counted["scenes"] + sum(counted["streamed"].values())
    assert counted["requests_by_role"]["ego"] == ego


@pytest.mark.slow
def test_a_lied_to_ego_drives_as_in_frozen_scenes(pair: Dataset, tmp_path: Path) -> None:
    how: dict[str, Any] = {"points": points_of(("attack=ghost:share=1/3",)), "seeds": (0,)}
    live = live_spec_of("proxy", 2, pair.manifest.seed, **how)
    walked_run, driven = (
        folder.read(run(spec, tmp_path / name).out)
        for name, spec in (("walked", spec_of(pair, **how)), ("driven", live))
    )
    assert not walked_run.decisions["off_lag"].any()
    told_by = []
    for each in (walked_run, driven):
        rows = each.decisions.records(0, len(each.decisions))
        told_by.append([(d.episode, d.scene, d.action, d.fused, d.latency_ms) for d in rows])
    assert told_by[0] == told_by[1]
    assert any("&ghost" in key for answer in driven.answers for key in answer.heard)


def test_cams_have_no_objects_to_lie_about() -> None:
    with pytest.raises(UserError, match=r"one with cpm where helpers attack"):
        named_point("6g:stream=cam,attack=ghost")
    named_point("6g:stream=cam+cpm,attack=ghost")
