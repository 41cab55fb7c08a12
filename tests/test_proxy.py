"""The proxy: what it says, and that it reads nothing but its own view."""

import json
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from evaluating import scenes_of
from former import SCENARIO
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import structs

from harness.backends.base import Request
from harness.backends.proxy import answers, distribution
from harness.coordination.trigger import entropy_nats
from harness.dataset.load import Dataset
from harness.parsing.parse import parse
from harness.prompts.answer_schema import FORMS, ROLES
from harness.prompts.versions import load
from harness.world.perception.graph import truth_graph
from harness.world.scene_graph import (
    Arrival,
    Conflict,
    Ego,
    EgoArrival,
    Point,
    Role,
    SceneGraph,
    Sector,
    Viewer,
)

ACTIONS = SCENARIO.actions
TAU_NATS = 0.7  # the paper's threshold

tenths = st.floats(-60, 60).map(lambda x: round(x, 1))
seconds = st.none() | st.floats(-5, 9).map(lambda x: round(x, 1))
speeds = st.floats(0, 20).map(lambda x: round(x, 1))


@st.composite
def conflicts(draw: st.DrawFn) -> Conflict:
    sector, route = draw(
        st.sampled_from([("left", "straight"), ("right", "straight"), ("oncoming", "left")])
    )
    return Conflict(
        f"v{draw(st.integers(2, 99))}", sector, route, Point(draw(tenths), draw(tenths)),
        EgoArrival(draw(tenths), draw(seconds)), Arrival(draw(tenths), draw(seconds), draw(speeds)),
    )  # fmt: skip


@st.composite
def graphs(draw: st.DrawFn, role: Role | None = None) -> SceneGraph:
    """Any scene graph that a dataset may hold, as far as the proxy can tell."""
    share = st.floats(0, 1).map(lambda x: round(x, 2))
    seen = {s: draw(share) for s in ("left", "right", "oncoming")}
    target_mps = draw(st.sampled_from([0.0, 7.0, 14.0]))
    return SceneGraph(
        "v1", role or draw(st.sampled_from(ROLES)), draw(st.integers(0, SCENARIO.parameters.decisions - 1)),
        Viewer(draw(speeds), "approach-own", 40.0),
        Ego("v1", draw(speeds), target_mps, 0.0, draw(tenths), 0.0, 0.0), (),
        tuple(draw(st.lists(conflicts(), max_size=3))),
        tuple(Sector(s, p, p < 0.5, ("b1",) if p < 1 else ()) for s, p in seen.items()),
    )  # fmt: skip


def in_sight(graph: SceneGraph, shares: Mapping[str, float]) -> SceneGraph:
    """The graph with so much of some sectors in sight."""
    sectors = (
        structs.replace(s, seen_share=shares[s.sector], occluded=shares[s.sector] < 0.5)
        if s.sector in shares else s
        for s in graph.sectors
    )  # fmt: skip
    return structs.replace(graph, sectors=tuple(sectors))


def request(graph: SceneGraph, form: str = "distribution") -> Request:
    return Request(
        "s/v1", graph.role, (), ACTIONS, 64, form, reasons_first=form != "distribution", view=graph,
        scenario=SCENARIO,
    )  # fmt: skip


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(graphs())
def test_it_gives_a_distribution_in_hundredths_that_sums_to_one(graph: SceneGraph) -> None:
    p = distribution(SCENARIO, graph)
    assert tuple(p) == ACTIONS
    assert all(0 <= x <= 1 and round(x * 100) / 100 == x for x in p.values())
    assert sum(round(x * 100) for x in p.values()) == 100


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(graphs(), st.data())
def test_every_answer_is_what_its_prompt_asks_for(graph: SceneGraph, data: st.DataObject) -> None:
    """A prompt that asks for a distribution has JSON alone;
    one that asks for reasons has them first.
    """
    form = data.draw(st.sampled_from(FORMS[graph.role]))
    asked = request(graph, form)
    parsed = parse(answers([asked])[0], **asked.shape._asdict())
    assert parsed.verdict == ("strict" if form == "distribution" else "recovered"), parsed.detail
    assert [str(r) for r in parsed.repairs] == ([] if form == "distribution" else ["prose_around"])
    assert (parsed.message is None) == (graph.role == "ego")
    p = distribution(SCENARIO, graph)
    if form == "distribution":
        assert parsed.intent == pytest.approx(tuple(p.values()))
    else:
        assert max(parsed.intent) == pytest.approx(max(p.values()))


@pytest.mark.slow
@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(graphs(role="ego"), st.sampled_from(["left", "right", "oncoming"]), st.floats(0, 0.45))
def test_it_is_unsure_where_a_sector_is_hidden_and_nothing_calls_for_braking(
    graph: SceneGraph, sector: str, seen: float
) -> None:
    hidden = in_sight(graph, {sector: seen})
    p = np.array(list(distribution(SCENARIO, hidden).values()))
    assert p[0] == 0.9 or entropy_nats(p) > TAU_NATS
    free = structs.replace(
        hidden, conflicts=(), ego=structs.replace(graph.ego, speed_mps=14.0, zone_m=40.0)
    )  # fmt: skip
    p = np.array(list(distribution(SCENARIO, free).values()))
    assert entropy_nats(p) > TAU_NATS


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.too_slow])
@given(graphs(role="ego"))
def test_it_is_sure_where_everything_is_in_sight(graph: SceneGraph) -> None:
    everything = dict.fromkeys(("left", "right", "oncoming"), 1.0)
    p = np.array(list(distribution(SCENARIO, in_sight(graph, everything)).values()))
    assert entropy_nats(p) < TAU_NATS


def test_a_car_that_arrives_with_the_ego_makes_it_brake_and_say_so() -> None:
    """Both 28 m and 2 s before the conflict point: keeping on means meeting."""
    crossing = Conflict(
        "v7", "left", "straight", Point(28.0, 0.0), EgoArrival(28.0, 2.0), Arrival(28.0, 2.0, 14.0)
    )  # fmt: skip
    graph = SceneGraph(
        "v3", "helper", 2, Viewer(0.0, "approach-right", 20.0),
        Ego("v1", 14.0, 14.0, 0.0, 28.0, 10.0, 20.0), (), (crossing,), (Sector("left", 0.2, True, ("b1",)),),
    )  # fmt: skip
    assert json.loads(answers([request(graph)])[0]) == {
        "evidence": "v7 from left 28 m before the ego's path.",
        "risk": "high",
        "action_distribution": {"SLOWER": 0.9, "IDLE": 0.05, "FASTER": 0.05},
    }
    free = json.loads(answers([request(structs.replace(graph, conflicts=()))])[0])
    assert free["evidence"] == "Nothing on the ego's path; hidden: left."
    assert free["action_distribution"]["SLOWER"] < 0.5


def test_it_reads_its_own_view_and_neither_messages_nor_truth(small: Dataset) -> None:
    prompt = load("v2")
    for scene in scenes_of(small)[:6]:
        for viewer in scene.viewers:
            graph = scene.graphs[viewer]
            bare = Request("a", graph.role, (), ACTIONS, 64, view=graph, scenario=SCENARIO)
            full = replace(
                bare,
                messages=prompt.render(graph, ACTIONS),
                truth=truth_graph(SCENARIO, scene.state),
                thinking=True,
            )
            assert answers([bare]) == answers([full])


def test_without_a_view_it_has_nothing_to_say() -> None:
    with pytest.raises(ValueError, match="has no view"):
        answers([Request("s/v1", "ego", (), ACTIONS, 64)])


def test_a_quarter_of_a_sector_hidden_leaves_it_just_sure_enough() -> None:
    """SLOWER .05 + .33/4 = .1325, the third action .10, the planned one the rest .7675:
    0.697 nats.
    """
    graph = SceneGraph(
        "v1", "ego", 0, Viewer(14.0, "approach-own", 60.0), Ego("v1", 14.0, 14.0, 0.0, 60.0, 0.0, 0.0),
        (), (), (Sector("left", 0.75, False, ("b1",)),),
    )  # fmt: skip
    p = distribution(SCENARIO, graph)
    assert p == {"SLOWER": 0.13, "IDLE": 0.77, "FASTER": 0.1}
    assert entropy_nats(np.array(list(p.values()))) == pytest.approx(0.697, abs=5e-4)
