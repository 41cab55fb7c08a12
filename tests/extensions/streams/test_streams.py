"""What an ego has heard before it asks anybody: when it was seen, what became of it, and who pays.

Scenes are frozen ones of a real dataset; where arithmetic is by hand, vehicles are put by hand.
"""

import json
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from evaluating import live_spec_of, run, spec_of
from msgspec import structs

from harness.coordination.named_points import named_point
from harness.coordination.streams import Hearing
from harness.core.errors import UserError
from harness.dataset.load import Dataset, Earlier, Scene, load
from harness.evaluate.dry_run import count, lacking
from harness.evaluate.requests import stream_sets
from harness.evaluate.sharing import shared_graphs
from harness.extensions.devices import profiles as devices
from harness.extensions.devices.timer import Computer, transmit_watts
from harness.extensions.schedules.choices import refuse
from harness.extensions.streams import sending
from harness.extensions.streams.motion import moments
from harness.extensions.streams.services import KEPT_S, Services, aged
from harness.radio.channel import Broadcast
from harness.radio.profiles import CHANNELS
from harness.report.words import questions
from harness.runs.folder import read
from harness.world import lockstep, scenarios
from harness.world.perception.sensors import Detection
from harness.world.perception.shared import Heard, Report, merged
from harness.world.scene_graph import AgedNode, SceneGraph
from harness.world.world import World

LOSSLESS = replace(CHANNELS["6g"], loss=0.0)
AT_ONCE = Services(0.1, 0.0, LOSSLESS)
BANDWIDTH_BPS = 200e6  # of 6g


def scenes_of(dataset: Dataset) -> list[Scene]:
    return dataset.scenes(dataset.courses())


def as_sent(scenes: Sequence[Scene], heard: Sequence[Mapping[str, str]]) -> list[Hearing]:
    pairs = zip(scenes, heard, strict=True)
    return [Hearing(scene, scene, texts, {}) for scene, texts in pairs]


def told(graph: SceneGraph) -> dict[str, float]:
    """The age of each vehicle that is known by a message."""
    return {n.id: n.age_s for n in graph.nodes if isinstance(n, AgedNode)}


# -- where vehicles were between two decisions -----------------------------------------------------


def test_a_motion_has_both_ends_and_even_motion_is_even(small: Dataset) -> None:
    for scene in scenes_of(small):
        before = scene.before()
        ends = [scene.state.time_s]
        if before:
            ends.insert(0, before.state.time_s)
        states = moments(scene, ends)
        for state, end in zip(states, filter(None, (before, scene)), strict=True):
            for v in state.vehicles:
                there = end.state.vehicle(v.id)
                assert (v.x_m, v.y_m) == pytest.approx((there.x_m, there.y_m), abs=1e-9)
                assert v.speed_mps == pytest.approx(there.speed_mps, abs=1e-9)
                assert math.cos(v.heading_rad - there.heading_rad) == pytest.approx(1)
    first = scene_at_start(small)
    [earlier] = moments(first, [first.state.time_s - 1.5])
    for v, now in zip(earlier.vehicles, first.state.vehicles, strict=True):
        assert math.hypot(v.x_m - now.x_m, v.y_m - now.y_m) == pytest.approx(1.5 * now.speed_mps)


def scene_at_start(dataset: Dataset) -> Scene:
    return next(scene for scene in scenes_of(dataset) if scene.before() is None)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["occluded-intersection", "do-not-pass"])
def test_a_motion_is_that_of_the_simulator_within_a_metre(name: str) -> None:
    """At ten moments a second; half of all are exact to a centimetre."""
    scenario, away_m = scenarios.get(name), list[float]()
    p, drawn = scenario.parameters, random.Random(1)
    for seed in range(4):
        world = World.start(scenario, seed)
        for step in range(3):
            begin = world.state(0)
            lockstep.advance([world], [p.due_frame(step) + p.lag_frames])
            world.take(drawn.choice(scenario.actions), 0)
            states = []
            for frame in range(p.due_frame(step) + 10, p.due_frame(step + 1) + 1, 5):
                lockstep.advance([world], [frame])
                states.append(world.state(0))
            if world.ended:
                break
            end = Scene(_record(states[-1]), before=Earlier(Scene(_record(begin))))
            for there, state in zip(moments(end, [s.time_s for s in states]), states, strict=True):
                for v in there.vehicles:
                    true = state.vehicle(v.id)
                    away_m.append(math.hypot(v.x_m - true.x_m, v.y_m - true.y_m))
    assert len(away_m) > 300
    assert max(away_m) < 1
    assert np.median(away_m) < 0.01


def _record(state: Any) -> Any:
    class Record:  # of which motion reads the state alone
        def __init__(self) -> None:
            self.state = state

    return Record()


# -- what is held of what was sent -----------------------------------------------------------------


def test_ages_are_those_of_the_looks_and_bounded(small: Dataset) -> None:
    """A look every 0.1 s; an object is sent again within a second, and takes the delay."""
    ages = list[float]()
    for delay_s in (0.0, 0.3):
        stream = Services(0.1, delay_s, LOSSLESS)
        scenes = scenes_of(small)
        heard = stream.heard(small.scenario, scenes)
        graphs = stream.graphs(small.scenario, as_sent(scenes, heard))
        here = [age for graph in graphs for age in told(graph).values()]
        assert len(here) > 20
        assert min(here) >= delay_s
        assert max(here) <= KEPT_S
        ages.append(float(np.mean(here)))
    assert ages[1] - ages[0] == pytest.approx(0.3, abs=0.1)


def test_what_was_heard_is_what_helpers_saw_carried_on(small: Dataset) -> None:
    """By own arithmetic, for each node that is known by a message: the look, its place and speed."""
    scenes, checked = scenes_of(small), 0
    heard = AT_ONCE.heard(small.scenario, scenes)
    exact = replace(small.scenario.parameters, perfect_knowledge=True)  # of senders' own poses
    scenario = replace(small.scenario, parameters=exact)
    graphs = AT_ONCE.graphs(scenario, as_sent(scenes, heard))
    for scene, graph in zip(scenes, graphs, strict=True):
        ego, objects = scene.state.ego, {}
        [received] = AT_ONCE.received(small.scenario, [scene])
        for sent in received:
            age_s = round(scene.state.time_s - sent.look.time_s, 2)
            objects |= {(f"v2v:{sent.sender}", d.id, age_s): d for d in sent.objects}
        for node in graph.nodes:
            if not isinstance(node, AgedNode) or node.sensors == (f"v2v:{node.id}",):
                continue  # seen by the ego itself, or a sender that tells of itself
            d = objects[node.sensors[0], node.id, node.age_s]
            moved_m = 0.0 if d.heading_rad is None else node.age_s * d.speed_mps
            dx = d.x_m + moved_m * math.cos(d.heading_rad or 0.0) - ego.x_m
            dy = d.y_m + moved_m * math.sin(d.heading_rad or 0.0) - ego.y_m
            c, s = math.cos(ego.heading_rad), math.sin(ego.heading_rad)
            assert node.forward_m == pytest.approx(dx * c + dy * s, abs=0.13)
            assert node.left_m == pytest.approx(dx * s - dy * c, abs=0.13)
            checked += 1
    assert checked > 20


def test_an_error_grows_with_age() -> None:
    """Of 3 m/s² variance of speed after 2 s: 3·4 and (2·4/2)² = 16 in place, (2·2)² = 16 in speed."""
    seen = Detection("v4", ("lidar",), "car", "off", 10.0, 0.0, 0.0, 5.0, None)
    then = aged(Report(seen, None, np.eye(2), 3.0), 2.0)
    assert (then.detection.x_m, then.detection.y_m, then.detection.age_s) == (20.0, 0.0, 2.0)
    assert then.place_m2 == pytest.approx(np.eye(2) * (1 + 12 + 16))
    assert then.speed_m2ps2 == pytest.approx(3 + 16)
    unknown = aged(Report(structs.replace(seen, heading_rad=None), None, np.eye(2), 3.0), 2.0)
    assert unknown.detection.x_m == 10.0
    assert unknown.place_m2 == pytest.approx(np.eye(2) * (1 + 12 + 16 + 100))


def test_a_look_at_the_decision_tells_what_a_list_that_is_asked_for_does(
    small: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Looks a second apart fall on decisions, and have all objects: the two differ by rounding."""
    monkeypatch.setattr(sending, "phase", lambda seed, sender, kind: 0.0)
    stream, compared = Services(1.0, 0.0, LOSSLESS), 0
    for scene in small.scenes(small.courses()):
        scene = replace(scene, notes={})
        own, *helpers = (scene.graphs[viewer] for viewer in scene.viewers)
        [asked] = merged(small.scenario, [Heard(scene.state, own, helpers)])
        [graph] = stream.graphs(
            small.scenario, as_sent([scene], stream.heard(small.scenario, [scene]))
        )
        nodes = {node.id: node for node in graph.nodes}
        for node in asked.nodes:
            there = nodes[node.id]
            assert there.forward_m == pytest.approx(node.forward_m, abs=0.21)
            assert there.left_m == pytest.approx(node.left_m, abs=0.21)
            compared += isinstance(there, AgedNode) and there.age_s == 0.0
        assert {s.sector: s.seen_share for s in graph.sectors} == {
            s.sector: s.seen_share for s in asked.sectors
        }
    assert compared > 20


def test_a_lost_or_late_stream_is_none(small: Dataset) -> None:
    scenes = scenes_of(small)
    for stream in (
        Services(0.1, 0.0, replace(LOSSLESS, loss=1.0)),
        Services(0.1, KEPT_S + 1, LOSSLESS),
    ):
        assert not any(stream.heard(small.scenario, scenes))
    assert all(AT_ONCE.heard(small.scenario, scenes))


@pytest.mark.parametrize(
    "text",
    ["6g:stream=cpm", "its-g5:density_per_km=600,stream=cpm", "its-g5:stream=cam+cpm"],
)
def test_many_scenes_at_once_hear_what_each_hears_alone(small: Dataset, text: str) -> None:
    """Of a dataset that is read anew for each, so that nothing is known of the others."""
    stream, names = named_point(text).stream, small.courses()
    assert isinstance(stream, Services)
    scenes = replace(small, _scenes={}).scenes(names)
    together = stream.heard(small.scenario, scenes)
    assert stream.heard(small.scenario, scenes) == together, "as a second condition asks it"
    alone = []
    for name in names[-20:]:
        alone += stream.heard(small.scenario, replace(small, _scenes={}).scenes([name]))
    assert together[-20:] == alone
    assert len({str(each) for each in alone}) > 10


def test_a_helper_tells_of_whom_the_ego_does_not_see(small: Dataset) -> None:
    scenes = scenes_of(small)
    heard = AT_ONCE.heard(small.scenario, scenes)
    graphs = AT_ONCE.graphs(small.scenario, as_sent(scenes, heard))
    more = 0
    for scene, graph in zip(scenes, graphs, strict=True):
        own = scene.graphs[scene.viewers[0]]
        assert {node.id for node in own.nodes} <= {node.id for node in graph.nodes}
        assert scene.viewers[0] not in {node.id for node in graph.nodes}
        more += len(graph.nodes) - len(own.nodes)
    assert more > len(scenes) / 2


# -- runs ------------------------------------------------------------------------------------------


def evaluated(dataset: Dataset, out: Path, texts: Sequence[str], seeds: Sequence[int]) -> Any:
    points = tuple(map(named_point, texts))
    return read(run(spec_of(dataset, points=points, seeds=seeds), out).out)


def test_seeds_and_equal_streams_ask_no_more(small: Dataset, tmp_path: Path) -> None:
    one = evaluated(small, tmp_path / "one", ["6g:stream=cpm,tau_nats=9"], (0,))
    two = evaluated(small, tmp_path / "two", ["6g:stream=cpm,tau_nats=9"], (0, 1, 2))
    both = ["6g:stream=cpm,tau_nats=9", "6g:stream=cpm,tau_nats=9,window_s=0.3"]
    three = evaluated(small, tmp_path / "three", both, (0,))
    keys = {answer.id for answer in one.answers}
    assert any("!stream:cpm:0.1:" in key for key in keys)
    assert {answer.id for answer in two.answers} == keys
    assert {answer.id for answer in three.answers} == keys


def test_a_lost_stream_leaves_every_decision_as_it_was(small: Dataset, tmp_path: Path) -> None:
    lost = evaluated(small, tmp_path / "lost", ["6g:loss=1", "6g:loss=1,stream=cpm"], (0, 1))
    plain, with_stream = (
        [
            (row.episode, row.seed, row.step, row.action, row.fused)
            for row in lost.decisions.records(0, len(lost.decisions))
            if ("stream" in row.condition) == has
        ]
        for has in (False, True)
    )
    assert plain == with_stream


OF_CPMS = [175, 195, 215, 237, 257, 278, 298]  # bytes as ETSI encodes and signs them, by objects


def _as_json_bits(cpm: sending.Message) -> float:
    listed = []
    for d in cpm.objects:
        numbers = [round(d.x_m, 1), round(d.y_m, 1), round(d.speed_mps, 1)]
        listed.append([d.id, d.kind, *numbers, d.indicator])
    told = {"from": cpm.look.sender, "objects": listed}
    return 8.0 * len(json.dumps(told, separators=(",", ":")))


def _by_its_g5_s(bits: float) -> float:
    """40 µs and 8 µs a symbol of 48 bits, with 30 bytes of headers and 22 bits of service."""
    return 40e-6 + 8e-6 * math.ceil((bits + 8 * 30 + 22) / 48)


@pytest.mark.parametrize("loss", [0.0, 1.0])
@pytest.mark.parametrize("profile", ["6g", "its-g5"])
def test_what_is_sent_is_counted_whoever_hears_it(
    small: Dataset, profile: str, loss: float
) -> None:
    """By own arithmetic, of the CPMs whose looks lie between two decisions."""
    encoding = "json" if profile == "6g" else "etsi"
    stream = named_point(f"{profile}:loss={loss},encoding={encoding},stream=cpm").stream
    assert isinstance(stream, Services)
    scenes = scenes_of(small)
    counted = stream.sent(small.scenario, scenes)
    for scene, *row in zip(scenes, *counted, strict=True):
        cpms, before = sending.stretch(small.scenario, scene, 0.1).messages, scene.before()
        since_s = before.state.time_s if before else scene.state.time_s
        expected = [0.0, 0.0, 0.0]
        for cpm in cpms:
            if since_s < cpm.look.time_s <= scene.state.time_s:
                bits = _as_json_bits(cpm) if profile == "6g" else 8 * OF_CPMS[len(cpm.objects)]
                airtime_s = bits / BANDWIDTH_BPS if profile == "6g" else _by_its_g5_s(bits)
                for n, value in enumerate((1, bits, airtime_s)):
                    expected[n] += value
        assert row == pytest.approx(expected)
        assert (row[0] > 0) == (before is not None)


def test_time_on_air_is_unknown_where_a_radio_does_not_know_it(small: Dataset) -> None:
    class Unknown(type(LOSSLESS)):  # type: ignore[misc]
        def request(self, bits: Any, draws: Any) -> Broadcast:
            return Broadcast(math.nan, math.nan)

    scenes = scenes_of(small)
    known = AT_ONCE.sent(small.scenario, scenes)
    sent = Services(0.1, 0.0, Unknown(**vars(LOSSLESS))).sent(small.scenario, scenes)
    assert np.array_equal(sent.bits, known.bits)
    assert np.array_equal(np.isnan(sent.airtime_s), known.messages > 0)


COUNTED = ("unasked", "unasked_bits", "unasked_ms")


def _rows(done: Any) -> dict[Any, dict[str, float]]:
    """Each decision's columns of messages, by condition, episode, seed and step."""
    d = done.decisions
    names = (*COUNTED, "request_bits", "reply_bits", "airtime_ms", "latency_ms", "off_lag")
    keys = zip(d.labels("condition"), *map(d.whole, ("episode", "seed", "step")), strict=True)
    values = zip(*(d[name].tolist() for name in names), strict=True)
    return {key: dict(zip(names, row, strict=True)) for key, row in zip(keys, values, strict=True)}


def test_a_run_counts_what_is_sent_beside_what_is_asked_for(small: Dataset, tmp_path: Path) -> None:
    alone, plain, silent, both = points = [
        "single-local", "6g:loss=0", "6g:loss=0,stream=cpm,tau_nats=9", "6g:loss=0,stream=cpm",
    ]  # fmt: skip
    done = evaluated(small, tmp_path / "run", points, (0,))
    rows = _rows(done)
    for (condition, _, _, step), row in rows.items():
        has = condition in (silent, both)
        assert [math.isnan(row[name]) for name in COUNTED] == [not has] * 3
        if has:
            assert (row["unasked_bits"] > 0) == (step > 0)
            assert row["unasked_ms"] == pytest.approx(
                row["unasked_bits"] / BANDWIDTH_BPS * 1e3, abs=1e-6
            )
        asked_ms = row["airtime_ms"] - (row["unasked_ms"] if has else 0)
        asked_for = row["request_bits"] + row["reply_bits"]
        assert asked_ms == pytest.approx(asked_for / BANDWIDTH_BPS * 1e3, abs=2e-6)
        if condition == silent:
            assert asked_for == 0
    for condition in points:
        here = [row for (name, *_), row in rows.items() if name == condition]
        total = sum(row["request_bits"] + row["reply_bits"] for row in here)
        total += sum(row["unasked_bits"] for row in here if condition in (silent, both))
        score = done.score(condition, "bits_per_episode")
        assert score.value == pytest.approx(total / len(small.episodes))
    of_both = done.score(both, "unasked_per_episode").value
    assert of_both > 10
    assert done.score(both, "bits_per_episode").value > done.score(silent, "bits_per_episode").value
    without = evaluated(small, tmp_path / "without", [alone, plain], (0,))
    assert not {*COUNTED} & {*pq.read_schema(without.path / "decisions.parquet").names}
    assert not {score.metric for score in without.scores} & {"unasked_per_episode", "unasked_ms"}


@pytest.mark.slow
def test_what_is_sent_unasked_takes_energy(small: Dataset, tmp_path: Path) -> None:
    """As all messages do: a radio's power for as long as they are on air, or a frame at least."""
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    profile = devices.load("orin-nano")
    assert profile.frame_ms is not None
    points = tuple(map(named_point, ("its-g5:stream=cpm,tau_nats=9", "6g:stream=cpm,tau_nats=9")))
    options: Any = {"timer": Computer(profile, "qwen3-0.6b"), "points": points, "seeds": (0,)}
    done = read(run(spec_of(load(small.path, 1), "swarm-tiny", "v12", **options), tmp_path).out)
    d = done.decisions
    for point in points:
        here = d.codes("condition", done.conditions) == done.conditions.index(point.name)
        assert not d["messages"][here].any()
        on_air_ms = d["airtime_ms"] if point.physical else d["unasked"] * profile.frame_ms.value
        expected = (transmit_watts(profile, point) * on_air_ms)[here]
        assert d["radio_mj"][here] == pytest.approx(expected, abs=1e-5)
        assert expected.max() > 0


CROWDED = "its-g5:encoding=etsi,density_per_km=600,stream=cpm"
OBEYING = f"{CROWDED},congestion=reactive"  # a message every 200 ms (`radio congestion`)


def test_a_reply_waits_as_long_as_after_any_packet(small: Dataset) -> None:
    """By own arithmetic: since a helper's last CPM of all the course, and not after the scene."""
    crowded, obeying = named_point(CROWDED).stream, named_point(OBEYING).stream
    assert isinstance(crowded, Services)
    assert isinstance(obeying, Services)
    scenes, waits_s = scenes_of(small), list[float]()
    assert not any(crowded.allowed_s(small.scenario, scenes))
    for scene, allowed_s in zip(scenes, obeying.allowed_s(small.scenario, scenes), strict=True):
        last_s, at = dict[str, float](), scene
        while at is not None:
            for cpm in sending.stretch(small.scenario, at, 0.2).messages:
                last_s[cpm.sender] = max(cpm.look.time_s, last_s.get(cpm.sender, -9))
            at = at.before()
        assert {*last_s} == {helper.id for helper in scene.state.helpers}
        for sender, sent_s in last_s.items():
            assert allowed_s[sender] == pytest.approx(max(sent_s + 0.2 - scene.state.time_s, 0))
        waits_s += allowed_s.values()
    assert 0 <= min(waits_s) < 0.05 < 0.15 < max(waits_s) <= 0.2


def test_replies_of_a_run_wait(small: Dataset, tmp_path: Path) -> None:
    done = evaluated(small, tmp_path / "run", [OBEYING], (0,))
    stream = named_point(OBEYING).stream
    assert stream is not None
    rows, waited = done.decisions.records(0, len(done.decisions)), 0
    scenes = small.scenes([row.scene for row in rows])
    for row, allowed_s in zip(rows, stream.allowed_s(small.scenario, scenes), strict=True):
        for message in row.messages:
            if message.arrival_ms is not None:
                wait_ms = 1000 * allowed_s[message.sender]
                assert message.arrival_ms > wait_ms
                waited += wait_ms > 145
    assert waited > 3


@pytest.mark.slow
def test_frozen_and_driven_send_alike(small: Dataset, tmp_path: Path) -> None:
    """Up to a decision that is later than frozen scenes assume."""
    texts = ("6g:stream=cpm", "its-g5:encoding=etsi,density_per_km=120,stream=cam+cpm", OBEYING)
    same: Any = {"points": tuple(map(named_point, texts)), "latency": "paper", "seeds": (0,)}
    frozen = read(run(spec_of(load(small.path, 2), **same), tmp_path / "frozen").out)
    driven = read(run(live_spec_of(episodes=2, first_seed=100, **same), tmp_path / "driven").out)
    late, compared, alike = dict[tuple[Any, ...], int](), 0, _rows(driven)
    for (*place, step), row in sorted(_rows(frozen).items()):
        if step <= late.setdefault((*place,), 99):
            late[*place,] = step if row["off_lag"] else 99
            assert {**alike[*place, step], "off_lag": row["off_lag"]} == row
            compared += 1
    assert compared > 10
    assert any(step < 99 for (text, *_), step in late.items() if text == OBEYING)


def test_a_dry_run_counts_what_a_stream_adds(small: Dataset) -> None:
    points = tuple(map(named_point, ("single-local", "6g:stream=cpm,tau_nats=9")))
    counted = count(spec_of(small, points=points), small, None)
    without = count(spec_of(small, points=points[:1]), small, None)
    [(name, more)] = counted["streamed"].items()
    assert name == points[1].name
    assert counted["requests_by_role"]["ego"] == without["requests_by_role"]["ego"] + more
    assert "streamed" not in without


def test_what_a_stream_lacks_is_counted_until_it_is_answered(
    small: Dataset, tmp_path: Path
) -> None:
    texts = ["6g:stream=cpm,tau_nats=9"]
    heard = evaluated(small, tmp_path / "heard", texts, [0])
    alone = evaluated(small, tmp_path / "alone", ["single-local"], [0])
    spec = spec_of(small, points=tuple(map(named_point, ("single-local", *texts))))
    scenes = sorted({a.scene for a in alone.answers} & {a.scene for a in heard.answers})
    unasked = [a.scene for a in heard.answers if a.heard]
    more = sum(scene in scenes for scene in unasked)
    assert lacking(spec, small, scenes, {a.id for a in alone.answers})["ego"] == more > 0
    assert lacking(spec, small, scenes, {a.id for a in heard.answers})["ego"] == 0
    assert f"ego with messages {len(unasked)}" in questions(heard)


def test_congestion_control_thins_the_radio_and_the_stream() -> None:
    """At 600 vehicles a km reactive control lets each send every 200 ms (`radio congestion`)."""
    crowded = named_point("its-g5:density_per_km=600,stream=cpm")
    obeying = named_point("its-g5:density_per_km=600,stream=cpm,congestion=reactive")
    assert isinstance(crowded.stream, Services)
    assert isinstance(obeying.stream, Services)
    assert (crowded.stream.interval_s, obeying.stream.interval_s) == (0.1, 0.2)
    assert obeying.channel.rate_hz == 5  # type: ignore[attr-defined]
    assert obeying.physical.busy_ratio() < crowded.physical.busy_ratio()
    wrapped = named_point("its-g5:density_per_km=600,loss=0.2,congestion=reactive")
    assert wrapped.channel.channel.rate_hz == 5  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "setting", "reason"),
    [
        ("its-g5", "congestion", None),  # all vehicles send less, whether helpers do so or not
        ("its-g5", "stream", None),
        ("its-g5:stream=cpm", "stream_delay_s", None),
        ("its-g5", "stream_delay_s", "helpers send nothing unasked (stream is none)"),
        ("its-g5:congestion=reactive", "stream_interval_s", "helpers send nothing unasked (stream is none)"),
        ("single-local", "congestion", "it has no channel"),
        ("single-local", "stream", "it has no channel"),
    ],
)  # fmt: skip
def test_a_sweep_refuses_what_changes_nothing(text: str, setting: str, reason: str | None) -> None:
    assert named_point(text).idle(setting) == reason


def test_schedules_are_not_compared_as_if_nothing_were_heard() -> None:
    with pytest.raises(UserError, match=r"the oracle knows no stream; leave it out$"):
        refuse(named_point("its-g5:stream=cpm"), 3, 3)
    refuse(named_point("its-g5:congestion=reactive"), 3, 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("6g:stream=cps", "unknown stream 'cps'; did you mean 'cpm'?"),
        ("6g:stream=cpm,stream_interval_s=0.05", "seconds from 0.1 to 1 (ETSI TS 103 324)"),
        ("6g:stream=cpm,stream_interval_s=2", "seconds from 0.1 to 1 (ETSI TS 103 324)"),
        ("6g:stream=cpm,content=objects", "it must be none where content is objects"),
        ("6g:congestion=adaptive", "channel 6g has no packets of other vehicles"),
        ("its-g5:congestion=fast", "unknown congestion 'fast'; known: adaptive, none, reactive"),
        ("single-local:stream=cpm", "has no channel, so stream changes nothing"),
    ],
)
def test_what_cannot_be_sent_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(UserError) as error:
        named_point(text)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "cpm:",
        "cpm:0.1:",
        "cpm:x:1",
        "cpm:1e-9:1",
        "cpm:0.00001:1",
        "cpm:9:1",
        "cpm:0.1:1..2",
        "cam:0.1:1;",
    ],
)
def test_a_key_that_is_no_stream_is_refused_in_one_line(small: Dataset, text: str) -> None:
    """As a stranger's file may have it: an interval could make a program look for ever."""
    scene = scenes_of(small)[0]
    with pytest.raises(UserError, match=r"^'.*' is no stream$"):
        shared_graphs(small.scenario, [(scene, [f"{scene.viewers[1]}!stream:{text}"])], {})


def test_streams_of_two_intervals_are_each_shown_by_its_own(small: Dataset) -> None:
    """A dry run has the questions of several conditions at once."""
    scenes, sets = scenes_of(small)[:6], []
    for interval_s in (0.1, 0.5):
        stream = Services(interval_s, 0.0, LOSSLESS)
        sets += stream_sets(small.scenario, scenes, stream, np.arange(6))
    together = shared_graphs(small.scenario, sets, {})
    alone = [shared_graphs(small.scenario, [each], {})[0] for each in sets]
    assert together == alone
    assert alone[:6] != alone[6:]
