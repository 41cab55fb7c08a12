"""What messages hold: intents, objects, both, or the truth."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import (
    Walked,
    all_scenes,
    as_read,
    figure,
    run,
    same_files,
    says,
    scenes_of,
    spec_of,
    walked,
)
from former import NAME
from msgspec import structs

from harness.backends.base import Completion, Request
from harness.backends.proxy import distribution
from harness.coordination.contents import CONTENTS
from harness.coordination.coordinate import FusionInputs, coordinate
from harness.coordination.intents import Intents
from harness.coordination.named_points import POINTS, named_point
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError
from harness.core.files import digest
from harness.dataset.load import Dataset, Scene
from harness.evaluate.dry_run import count
from harness.evaluate.fusion import source_of
from harness.evaluate.sharing import as_asked, listed
from harness.extensions.radio.messages import Counts, size
from harness.prompts import versions as prompts
from harness.radio.channel import Draws
from harness.runs import folder
from harness.world import scenarios
from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.perception.shared import NOBODY, Heard, merged, state_in_message
from harness.world.scene_graph import SceneGraph, Sector
from harness.world.state import Part, VehicleState, WorldState

OBJECTS, BOTH, ORACLE = (
    named_point(f"6g:content={name}") for name in ("objects", "both", "oracle")
)
LOSSLESS = {
    name: named_point(f"6g:loss=0,content={name}")
    for name, content in CONTENTS.items()
    if not content.of_agents
}


def heard_by_all(scene: Scene) -> Heard:
    ego, *helpers = scene.viewers
    return Heard(scene.state, scene.graphs[ego], [scene.graphs[helper] for helper in helpers])


def shared(dataset: Dataset, scenes: Sequence[Scene]) -> list[SceneGraph]:
    return merged(dataset.scenario, [heard_by_all(scene) for scene in scenes])


@pytest.fixture(scope="module")
def pair(small: Dataset) -> Dataset:
    """Two of the layouts, for walks whose every question is looked at."""
    return small.of_episodes({0, 1})


# The larger graph


def test_whoever_hears_nobody_knows_what_it_saw(small: Dataset) -> None:
    cases = [heard_by_all(scene)._replace(helpers=()) for scene in all_scenes(small)[:50]]
    assert merged(small.scenario, cases) == [case.own for case in cases]


@pytest.mark.slow
def test_it_lists_whatever_anybody_lists_and_each_sender_and_never_the_ego(small: Dataset) -> None:
    for scene, graph in zip(all_scenes(small), shared(small, all_scenes(small)), strict=True):
        ego, *helpers = scene.viewers
        listed = {ego, *helpers}.union(*(scene.graphs[viewer].seen for viewer in scene.viewers))
        assert set(graph.seen) == listed - {ego}


@pytest.mark.slow
def test_an_object_of_several_senders_is_one(small: Dataset) -> None:
    graphs = shared(small, all_scenes(small))
    assert all(len(graph.nodes) == len({*graph.seen}) for graph in graphs)


def test_ids_do_not_say_what_is_one_object(small: Dataset) -> None:
    """Helpers that call every vehicle by other names add as many objects at the same places."""
    for scene in scenes_of(small):
        case = heard_by_all(scene)
        renamed = [
            structs.replace(
                graph,
                nodes=tuple(structs.replace(n, id=f"v{90 - int(n.id[1:])}") for n in graph.nodes),
            )
            for graph in case.helpers
        ]
        plain, other = merged(small.scenario, [case, case._replace(helpers=renamed)])
        places = [
            [(n.forward_m, n.left_m, n.speed_mps) for n in graph.nodes] for graph in (plain, other)
        ]
        assert places[0] == places[1]


def test_a_sector_of_another_road_counts_for_nobody(small: Dataset) -> None:
    """Shuffled messages of a recording may be of another road, which has sectors of its own."""
    case, elsewhere = heard_by_all(scenes_of(small)[0]), Sector("n13", 1.0, False, ())
    helpers = []
    for graph in case.helpers:
        helpers.append(structs.replace(graph, sectors=(*graph.sectors, elsewhere)))
    plain, other = merged(small.scenario, [case, case._replace(helpers=helpers)])
    assert other == plain


@pytest.mark.slow
def test_what_only_a_helper_sees_is_where_it_is_and_meets_the_ego(small: Dataset) -> None:
    """The danger behind the corner: its conflict is that of the truth,
    up to errors of sensors and places.
    """
    met = 0
    for scene, graph in zip(all_scenes(small), shared(small, all_scenes(small)), strict=True):
        truth = {c.vehicle: c for c in truth_graph(small.scenario, scene.state).conflicts}
        own = {c.vehicle for c in scene.graphs[scene.viewers[0]].conflicts}
        for conflict in graph.conflicts:
            if (
                conflict.vehicle in truth.keys() - own
                and conflict.vehicle == scene.record.danger.vehicle
            ):
                met += 1
                true = truth[conflict.vehicle]
                assert conflict.sector == true.sector
                assert conflict.other.arc_m == pytest.approx(true.other.arc_m, abs=6)
                assert conflict.other.speed_mps == pytest.approx(true.other.speed_mps, abs=4)
    assert met > 20


NORTH = -math.pi / 2


def test_the_more_precise_report_of_an_object_stands() -> None:
    """A car 110 m ahead: the ego has it by radar alone, a helper 20 m from it by LiDAR."""
    scenario = scenarios.get(f"{NAME},perfect_knowledge=true")

    def car(name: str, part: Part, y_m: float) -> VehicleState:
        return VehicleState(name, "car", part, 2.0, y_m, NORTH, 10.0, "own", "straight", False)

    cars = car("v1", "ego", 60.0), car("v2", "helper", -30.0), car("v3", "other", -50.0)
    # The helper is beside, so that it does not hide the other from the ego.
    vehicles = cars[0], structs.replace(cars[1], x_m=-6.0), cars[2]
    state = WorldState("by hand", 0, 0, 0.0, 14.0, vehicles, ())
    own, helper = (scene_graph(scenario, state, name) for name in ("v1", "v2"))
    [mine] = [node for node in own.nodes if node.id == "v3"]
    [graph] = merged(scenario, [Heard(state, own, [helper])])
    [node] = [node for node in graph.nodes if node.id == "v3"]
    assert mine.sensors == ("radar",)
    assert node.sensors == ("v2v:v2",)
    assert math.hypot(node.forward_m - 110.0, node.left_m) < 0.5
    assert math.hypot(mine.forward_m - 110.0, mine.left_m) > math.hypot(
        node.forward_m - 110.0, node.left_m
    )


def test_a_region_is_as_much_in_sight_as_to_who_sees_most_of_it(small: Dataset) -> None:
    for scene, graph in zip(scenes_of(small), shared(small, scenes_of(small)), strict=True):
        for n, sector in enumerate(graph.sectors):
            assert sector.seen_share == max(
                scene.graphs[v].sectors[n].seen_share for v in scene.viewers
            )


def test_a_message_says_where_its_sender_is_with_the_errors_of_a_beacon(small: Dataset) -> None:
    p = small.scenario.parameters
    apart = [
        (said.x_m - true.x_m, said.y_m - true.y_m)
        for scene in all_scenes(small) for viewer in scene.viewers[1:]
        for said, true in [(state_in_message(p, scene.state, viewer), scene.state.vehicle(viewer))]
    ]  # fmt: skip
    assert np.std(apart) == pytest.approx(p.beacon_noise_m, rel=0.4)
    exact = replace(p, perfect_knowledge=True)
    scene = all_scenes(small)[0]
    assert state_in_message(exact, scene.state, "v2") == scene.state.vehicle("v2")


# Who is heard, and when


def intents(
    own: Sequence[float], helpers: Sequence[Sequence[float]], object_bits: float = 800.0
) -> Intents:
    """One decision whose helpers take 5 s to think."""
    n = len(helpers)
    shape = np.ones((1, n))
    return Intents(
        np.array([own]), np.array([helpers]), shape > 0, np.full((1, 1 + n), 10.0), 20.0 * shape,
        400.0 * shape, np.insert(5.0 * shape, 0, 0.1, axis=1),
        objects=3 * shape, object_bits=object_bits * shape, text_bytes=40 * shape,
    )  # fmt: skip


CLEAR = Draws(np.full((1, 3, 2), 0.9), np.zeros((1, 3)))


def decided(point: OperatingPoint, answer: Sequence[float]) -> Any:
    said = intents([0.3, 0.4, 0.3], [[1.0, 0.0, 0.0]] * 3)
    said = point.content.able(point, said, None)
    said = replace(said, payload_bits=point.content.bits(point.radio.encoding, said, headers=False))
    call = lambda on_time: (np.array([answer]), np.full(1, 0.05))  # noqa: E731
    return coordinate(point, said, CLEAR, FusionInputs(call))


def test_objects_do_not_wait_for_the_helpers_model() -> None:
    """Helpers infer for 5 s: their intents miss the window, their objects do not."""
    late, early = (decided(LOSSLESS[name], [0.0, 1.0, 0.0]) for name in ("intent", "objects"))
    assert not late.on_time.any()
    assert early.on_time.all()
    assert early.fused[0].tolist() == [0.0, 1.0, 0.0]
    assert early.latency_s[0] == pytest.approx(early.exchange_s[0] + 0.05)
    assert np.isnan(early.weights).all()
    assert late.infers.all()
    assert not early.infers.any()


def test_what_is_sent_is_paid_for() -> None:
    for name, bits in (("intent", 400), ("objects", 800), ("both", 1200)):
        assert decided(LOSSLESS[name], [0.0, 1.0, 0.0]).reply_bits[0] == 3 * bits


@pytest.mark.parametrize(
    ("encoding", "intent", "objects"),
    [("etsi", "etsi-intent", "CPM"), ("sae", "sae-intent", "SDSM")],
)
def test_a_standards_encoding_has_the_sizes_of_its_messages(
    encoding: str, intent: str, objects: str
) -> None:
    """Three objects, 40 bytes of text, three actions; a message and its signed envelope."""
    counts = Counts(objects=3, actions=3, text_bytes=40)
    sizes = {name: size(name, counts) for name in (intent, objects)}
    packets = {name: float(each.message + each.envelope) for name, each in sizes.items()}
    by_content = {
        "intent": packets[intent],
        "objects": packets[objects],
        "both": sum(packets.values()),
    }
    for content, bits in by_content.items():
        sent = decided(
            named_point(f"6g:loss=0,content={content},encoding={encoding}"), [0.0, 1.0, 0.0]
        )
        assert sent.reply_bits[0] == 3 * bits
        assert sent.request_bits[0] != 400


def test_headers_count_under_a_physical_radio() -> None:
    said = intents([0.3, 0.4, 0.3], [[1.0, 0.0, 0.0]] * 3)
    content = CONTENTS["both"]
    paper, radio = (content.bits("etsi", said, headers) for headers in (False, True))
    assert (radio > paper + 2 * 8 * 40).all()
    assert (content.bits("json", said, True) == content.bits("json", said, False)).all()


def test_with_both_the_ego_votes_as_it_sees_now() -> None:
    """Three helpers are sure of the first action;
    the ego's new answer is one of four voices at 10 m.
    """
    point = LOSSLESS["both"].changed(window_s=10.0)
    both, failed = decided(point, [0.0, 0.0, 1.0]), decided(point, [math.nan] * 3)
    assert both.fused[0].tolist() == pytest.approx([0.75, 0.0, 0.25])
    assert failed.fusion_failed[0]
    assert failed.fused[0].tolist() == pytest.approx([0.75 + 0.075, 0.1, 0.075])


# Whole evaluations


@pytest.fixture(scope="module")
def planner(small: Dataset) -> Walked:
    spec = spec_of(small, points=(*POINTS.values(), OBJECTS, BOTH, ORACLE), ask="used")
    return walked(spec, Planner(small))


class Planner:
    """Answers as `proxy` does, and remembers what it was asked."""

    def __init__(self, dataset: Dataset) -> None:
        self.scenario, self.asked = dataset.scenario, list[Request]()

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.asked += requests
        views = {r.id: r.view for r in requests if r.view is not None}
        intents = {
            name: [*distribution(self.scenario, view).values()] for name, view in views.items()
        }
        return [
            Completion(r.id, says(intents[r.id], r.role), None, None, "stop", None, 1)
            for r in requests
        ]

    def identity(self) -> dict[str, Any]:
        return {"engine": "scripted"}


@pytest.mark.slow
def test_a_set_of_messages_is_one_question_whatever_else_is_done_with_its_answer(
    pair: Dataset,
) -> None:
    """`objects` and `both` ask the same;
    a helper's model is asked only where its intent is sent.
    """
    asked = {}
    for point in (OBJECTS, BOTH):
        backend = Planner(pair)
        walked(spec_of(pair, points=(point,), ask="used"), backend)
        asked[point] = [r.id for r in backend.asked]
        assert len(asked[point]) == len(set(asked[point]))
    both = Planner(pair)
    walked(spec_of(pair, points=(OBJECTS, BOTH), ask="used"), both)
    assert {r.id for r in both.asked} == {*asked[OBJECTS], *asked[BOTH]}
    assert not [name for name in asked[OBJECTS] if "/v1" not in name]
    assert [name for name in asked[BOTH] if "/v1" not in name]
    assert [
        name for name in asked[OBJECTS] if name.endswith("/v1+v2!objects+v3!objects+v4!objects")
    ]


def test_a_larger_graph_is_a_prompts_graph(pair: Dataset) -> None:
    backend, spec = Planner(pair), spec_of(pair, points=(OBJECTS,), ask="used")
    walked(spec, backend)
    scenes = {scene.id: scene for scene in all_scenes(pair)}
    for request in backend.asked:
        if "!objects" in request.id:
            scene = scenes[request.id.partition("/")[0]]
            assert request.view is not None
            new = set(request.view.seen) - set(scene.graphs["v1"].seen)
            assert {*request.id.partition("/")[2].replace("!objects", "").split("+")[1:]} <= {
                *request.view.seen
            }
            shown = request.messages[-1]["content"]
            listed = prompts.listed(request.view, spec.ego.prompt.max_objects)
            names = [request.view.nodes[n].id for n in listed]
            assert all(f"\n{name} " in shown for name in names if name in new)


def test_the_truth_is_no_worse_than_objects_and_these_no_worse_than_nothing(
    planner: Walked,
) -> None:
    alone, objects, oracle = (
        figure(planner, name, "success_rate").value
        for name in ("single-local", OBJECTS.name, ORACLE.name)
    )
    assert alone <= objects <= oracle


def test_the_truth_has_every_sector_of_the_ego_in_sight(pair: Dataset) -> None:
    backend = Planner(pair)
    walked(spec_of(pair, points=(ORACLE,), ask="used"), backend)
    scenes = {scene.id: scene for scene in all_scenes(pair)}
    asked = [r for r in backend.asked if "!truth" in r.id and r.view]
    assert asked
    for request in asked:
        assert request.view is not None
        own = scenes[request.id.partition("/")[0]].graphs["v1"]
        assert [s.sector for s in request.view.sectors] == [s.sector for s in own.sectors]
        assert {(s.seen_share, s.occluded, s.by) for s in request.view.sectors} == {
            (1.0, False, ())
        }
        assert "100% seen" in request.messages[-1]["content"]


def test_helpers_that_see_nothing_add_but_themselves(pair: Dataset) -> None:
    backend = Planner(pair)
    walked(spec_of(pair, points=(OBJECTS.changed(messages="blind"),), ask="used"), backend)
    scenes = {scene.id: scene for scene in all_scenes(pair)}
    asked = [r for r in backend.asked if "~blind!objects" in r.id]
    assert asked
    for request in asked:
        own = scenes[request.id.partition("/")[0]].graphs["v1"].seen
        assert request.view is not None
        assert {*request.view.seen} <= {*own, "v2", "v3", "v4"}


def test_shuffled_objects_are_those_of_another_layout_where_they_are_there(pair: Dataset) -> None:
    """Every question but the ego's own has the list of one other layout,
    in which the ego is left out.
    """
    backend, scenes = Planner(pair), {scene.id: scene for scene in all_scenes(pair)}
    walked(spec_of(pair, points=(OBJECTS.changed(messages="shuffled"),), ask="used"), backend)
    sets = [r for r in backend.asked if "!objects" in r.id]
    assert len(sets) > 10
    for request in sets:
        name, _, key = request.id.partition("/")
        senders = key.split("+")[1:]
        source = scenes[source_of(name, senders)]
        assert source.record.episode != scenes[name].record.episode
        assert source.record.step == scenes[name].record.step
        own, there = (
            scenes[name].graphs["v1"],
            [source.graphs[s.partition("!")[0]] for s in senders],
        )
        assert request.view is not None
        assert "v1" not in request.view.seen
        for sender, graph in zip(senders, there, strict=True):
            place = state_in_message(
                pair.scenario.parameters, source.state, sender.partition("!")[0]
            )
            new = {*request.view.nodes} - {*own.nodes}
            assert place.id in {node.id for node in new} or place.id in own.seen
            assert {node.id for node in new} <= {v.id for v in source.state.vehicles} | {
                *own.seen
            }, graph


@pytest.mark.slow
def test_with_shuffled_objects_and_words_nothing_is_won(small: Dataset) -> None:
    """A planner hears of dangers that are not there, and of none that is."""
    points = [OBJECTS, OBJECTS.changed(name="shuffled", messages="shuffled")]
    rows = walked(spec_of(small, points=(POINTS["single-local"], *points)), Planner(small))
    alone, own, shuffled = (
        figure(rows, name, "success_rate").value
        for name in ("single-local", OBJECTS.name, "shuffled")
    )
    assert shuffled <= alone < own


@pytest.mark.slow
def test_a_shuffled_run_is_read_as_it_was_asked(small: Dataset, tmp_path: Path) -> None:
    """A pair for training has the objects of the other layout; energy of them is not counted."""
    point = OBJECTS.changed(messages="shuffled")
    stored = folder.read(run(spec_of(small, points=(point,)), tmp_path / "run").out)
    counted = count(spec_of(small, points=(point,), ask="used"), small, None)
    assert counted["requests_by_role"]["fusion"] == 2 * 7 * counted["scenes"], "of two seeds"
    asked = {
        answer.prompt_sha256 for answers in stored.answers_by_scene.values() for answer in answers
    }
    pairs = pytest.importorskip("harness.extensions.learn.training.pairs").pairs
    shuffled = [pair for pair in pairs(stored) if "&from:" in pair["viewer"]]
    assert shuffled
    assert {digest(pair["prompt"]) for pair in shuffled} <= asked


def test_bits_grow_with_what_is_listed(small: Dataset) -> None:
    scenes = all_scenes(small)
    counts, bits = listed(scenes)
    assert counts.tolist() == [[len(s.graphs[v].nodes) for v in s.viewers[1:]] for s in scenes]
    assert np.corrcoef(bits.ravel(), counts.ravel())[0, 1] > 0.9
    assert bits.min() >= 8 * len('{"from":"v2","objects":[],"seen":[],"speed_mps":0.0}')


def test_a_dry_run_counts_the_questions_of_a_content(small: Dataset) -> None:
    """Seven sets of three helpers, and none of their models; more sets with a liar among them."""
    plain, lied, both = (
        count(spec_of(small, points=(point,), ask="used"), small, None)
        for point in (OBJECTS, OBJECTS.changed(attack="ghost:share=1/3"), BOTH)
    )
    n = plain["scenes"]
    assert plain["requests_by_role"] == {"ego": n, "fusion": 7 * n}
    assert lied["requests_by_role"] == {"ego": n, "fusion": 26 * n}
    assert both["requests_by_role"] == {"ego": n, "helper": 3 * n, "fusion": 7 * n}


# Helpers that lie


@pytest.mark.parametrize(
    ("attack", "what"),
    [
        ("ghost", lambda true, said: "v99" in said - true),
        (
            "hide",
            lambda true, said: (
                not said - {"v2", "v3", "v4"} - true and said <= true | {"v2", "v3", "v4"}
            ),
        ),
    ],
)
def test_a_liar_invents_or_hides(pair: Dataset, attack: str, what: Any) -> None:
    """All helpers lie: what the ego's graph gains is a ghost, or only the helpers themselves."""
    backend = Planner(pair)
    point = OBJECTS.changed(attack=f"{attack}:share=1")
    walked(spec_of(pair, points=(point,), ask="used"), backend)
    scenes = {scene.id: scene for scene in all_scenes(pair)}
    asked = [r for r in backend.asked if f"!{attack}&objects" in r.id]
    assert asked
    for request in asked:
        assert request.view is not None
        assert what({*scenes[request.id.partition("/")[0]].graphs["v1"].seen}, {*request.view.seen})


@pytest.mark.slow
def test_a_ghost_stops_who_believes_it_and_none_is_believed_of_nobody(small: Dataset) -> None:
    points = [OBJECTS.changed(name=f"{share}", attack=f"ghost:share={share}") for share in (0, 1)]
    rows = walked(spec_of(small, points=tuple(points)), Planner(small))
    honest = walked(spec_of(small, points=(OBJECTS,)), Planner(small))
    assert (
        figure(rows, "0", "success_rate").value
        == figure(honest, OBJECTS.name, "success_rate").value
    )
    assert figure(rows, "1", "success_rate").value < figure(rows, "0", "success_rate").value


def test_a_shifted_object_is_another_object(pair: Dataset) -> None:
    """Both places are believed where the ego sees the object itself."""
    backend = Planner(pair)
    walked(spec_of(pair, points=(OBJECTS.changed(attack="shift:share=1:offset_m=12"),)), backend)
    graphs = [r.view for r in backend.asked if "!shift:offset_m=12&objects" in r.id]
    assert any(len(graph.seen) > len({*graph.seen}) for graph in graphs if graph)


@pytest.mark.parametrize("text", ["ghost+hide", "hide+ghost"])
def test_whoever_hides_all_and_invents_a_car_lists_that_car_alone(pair: Dataset, text: str) -> None:
    """In whatever order both are named, and as one question."""
    attack = "+".join(f"{name}:share=1" for name in text.split("+"))
    backend = Planner(pair)
    walked(spec_of(pair, points=(OBJECTS.changed(attack=attack),)), backend)
    scenes = {scene.id: scene for scene in all_scenes(pair)}
    asked = [r for r in backend.asked if "+" in r.id]
    assert asked
    for request in asked:
        name, _, senders = request.id.partition("/")
        assert request.view is not None
        assert {key.partition("!")[2] for key in senders.split("+")[1:]} == {"hide&ghost&objects"}
        helpers = {key.partition("!")[0] for key in senders.split("+")[1:]}
        assert {*request.view.seen} - {*scenes[name].graphs["v1"].seen} - helpers == {NOBODY}


def test_a_ghost_is_where_it_was_meant_whatever_else_is_moved(
    small: Dataset, proxy_run: Path
) -> None:
    pytest.importorskip("harness.extensions.trust")
    scene = all_scenes(small)[0]
    answer = structs.replace(next(iter(folder.read(proxy_run).answers)), role="merge", viewer="v1")
    alone, moved = (
        as_asked(small.scenario, scene, structs.replace(answer, heard=(f"v2!{text}&objects",)))
        for text in ("ghost", "ghost&shift")
    )
    ghosts = [[n for n in each.graphs["v1"].nodes if n.id == NOBODY] for each in (alone, moved)]
    assert ghosts[0] == ghosts[1] != []


# The same whatever way


@pytest.mark.exhaustive
def test_one_at_a_time_as_in_batches(pair: Dataset, tmp_path: Path) -> None:
    points = (POINTS["single-local"], OBJECTS, BOTH)
    one, many = (
        run(spec_of(pair, points=points, batch_size=size), tmp_path / f"{size}").out
        for size in (1, 8)
    )
    assert same_files(one, many)


@pytest.mark.slow
def test_whoever_reads_a_run_sees_what_the_ego_was_asked(pair: Dataset, tmp_path: Path) -> None:
    """The prompt of every answer can be shown as it was sent, and a pair for training has it."""
    spec = spec_of(
        pair, points=(OBJECTS, BOTH, OBJECTS.changed(attack="ghost:share=1/3", name="lied to"))
    )
    stored = folder.read(run(spec, tmp_path / "run").out)
    shared = 0
    for answer, _, messages in as_read(stored, pair):
        assert digest(messages) == answer.prompt_sha256
        shared += any("objects" in key for key in answer.heard)
    assert shared > 10
    asked = {
        answer.prompt_sha256 for answers in stored.answers_by_scene.values() for answer in answers
    }
    pairs = pytest.importorskip("harness.extensions.learn.training.pairs").pairs
    assert {digest(pair["prompt"]) for pair in pairs(stored)} <= asked


@pytest.mark.parametrize("heard", ["v9!objects", "v2!shift:offset_m=x&objects"])
def test_a_stranger_who_heard_nobody_is_one_line(
    small: Dataset, proxy_run: Path, heard: str
) -> None:
    answer = structs.replace(
        next(iter(folder.read(proxy_run).answers)), role="merge", heard=(heard,)
    )
    with pytest.raises(UserError) as error:
        as_asked(small.scenario, all_scenes(small)[0], answer)
    assert "\n" not in str(error.value)


def test_a_stranger_who_names_two_attacks_at_once_gets_both(
    small: Dataset, proxy_run: Path
) -> None:
    pytest.importorskip("harness.extensions.trust")
    scene = all_scenes(small)[0]
    answer = next(iter(folder.read(proxy_run).answers))
    twice, apart = (
        as_asked(
            small.scenario,
            scene,
            structs.replace(answer, role="merge", heard=(f"v2!{text}&objects",)),
        )
        for text in ("shift:offset_m=6+hide", "shift:offset_m=6&hide")
    )
    assert twice.graphs == apart.graphs
