"""Several agents in one world: seats, the walk, and what a run says of them."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from shutil import copytree

import pytest
from evaluating import FILES, live_spec_of, run
from reading import details, packed
from tiers import some

from harness.api import load
from harness.backends import cards
from harness.backends.registry import open_backend
from harness.coordination.named_points import named_point
from harness.core.errors import UserError
from harness.dataset.build import build
from harness.evaluate.agent import Agent
from harness.evaluate.live_world import LiveSource, looks
from harness.evaluate.replay import scenes_of
from harness.evaluate.requests import EGO, requests
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.prompts import versions
from harness.report.decisions import failures
from harness.report.page import render
from harness.report.runs import gather
from harness.runs import folder
from harness.world import scenarios
from harness.world.seats import offset_of
from harness.world.swarm import alone
from harness.world.world import World

ALL = "all-way-crossing:agent_share=1"
PAIRS = pytest.mark.parametrize("name", ["all-way-crossing", "platoon-merge"])


@PAIRS
def test_an_agent_is_the_ego_in_its_own_eyes_and_nothing_else_changes(name: str) -> None:
    scenario = scenarios.get(f"{name}:agent_share=1")
    for seed in range(8):
        world = World.start(scenario, seed)
        true = world.state()
        for agent in list(world.journeys)[1:]:
            seen, seat = world.state(agent), world.seat(agent)
            assert seen.ego.id == true.vehicles[agent].id
            assert {v.id for v in seen.helpers} == {
                v.id for v in true.vehicles if v.part != "other"
            } - {seen.ego.id}
            for v in seen.vehicles:
                before, path = true.vehicle(v.id), seat.road().paths[v.approach, v.route]
                assert (v.x_m, v.y_m, v.heading_rad, v.speed_mps) == (
                    before.x_m, before.y_m, before.heading_rad, before.speed_mps
                )  # fmt: skip
                assert path.project(v.x_m, v.y_m)[1] < 0.1, "on the path that the seat names"


@PAIRS
def test_who_decides_at_a_share_decides_at_a_higher_one(name: str) -> None:
    deciding = [
        [
            set(World.start(scenarios.get(f"{name}:agent_share={share}"), seed).journeys)
            for seed in range(20)
        ]
        for share in (0, 0.3, 0.7, 1)
    ]
    assert all(agents == {0} for agents in deciding[0])
    for fewer, more in pairwise(deciding):
        assert all(a <= b for a, b in zip(fewer, more, strict=True))
    assert sum(map(len, deciding[1])) < sum(map(len, deciding[2])) < sum(map(len, deciding[3]))


@pytest.mark.slow
def test_agents_act_alone_and_the_world_goes_on_until_all_have_ended() -> None:
    world = World.start(scenarios.get(ALL), 0)
    agents = list(world.journeys)
    world.take("SLOWER", agents[-1])
    world.advance(50)
    speeds = [v.speed for v in world.vehicles]
    assert speeds[agents[-1]] < 9 < min(speeds[n] for n in agents[:-1])
    world.advance(10**6)
    assert world.ended
    assert world.time_s == pytest.approx(
        max(j.outcome.time_s or 0 for j in world.journeys.values()), abs=0.03
    )


def test_a_world_branches_with_all_its_journeys() -> None:
    world = World.start(scenarios.get(ALL), 1)
    branch = world.branch()
    branch.advance(10**6)
    assert branch.ended
    assert not any(journey.outcome.ended for journey in world.journeys.values())


def test_every_agent_is_asked_with_its_own_graph() -> None:
    world = World.start(scenarios.get(ALL), 2)
    scenes = looks([(world, agent, 0) for agent in world.journeys], 0, ego_alone=False)
    assert [scene.viewers[0] for scene in scenes] == [
        world.vehicles[n].spawn.id for n in world.journeys
    ]
    assert len({scene.id for scene in scenes}) == len(scenes)
    for scene in scenes:
        assert scene.graphs[scene.viewers[0]].role == "ego"
        places = [scene.place(viewer) for viewer in range(len(scene.viewers))]
        names = [world.vehicles[world.answering[place]].spawn.id for place in places]
        assert names == list(scene.viewers), "a vehicle keeps its model, whoever decides"


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of two to four agents, whose decisions are not ready at once, or never."""
    out = tmp_path_factory.mktemp("agents") / "run"
    points = named_point("single-local"), named_point("6g")
    spec = live_spec_of(
        prompt="v4", points=points, seeds=(0,), latency="ego=1.3,helper=1.3,fusion=0"
    )
    run(replace(spec, source=LiveSource(50_000, 4, ALL)), out)
    return out


@pytest.mark.slow
def test_a_run_says_who_decided_and_how_all_of_them_ended(driven: Path) -> None:
    there = folder.read(driven)
    table = there.decisions
    for episode in there.episodes:
        assert episode.agents in (2, 3, 4)
        assert episode.success == (episode.arrived == episode.agents)
        rows = [
            r for r in table.records(0, len(table))
            if (r.episode, r.condition, r.seed) == (episode.episode, episode.condition, episode.seed)
        ]  # fmt: skip
        assert len(rows) == episode.decisions
    assert len(set(table.labels("agent"))) == 4
    scores = {(s.condition, s.metric): s.value for s in there.scores}
    mean = sum(e.arrived / e.agents for e in there.episodes if e.condition == "6g") / 4
    assert scores["6g", "arrived_rate"] == pytest.approx(mean)


def beside_few() -> Spec:
    """Two episodes, in one of which nobody beside the ego decides."""
    points = named_point("6g"), named_point("6g:tau=0,content=plan,consensus=auction")
    source = LiveSource(200_003, 2, "all-way-crossing:agent_share=0.2")
    return replace(live_spec_of(prompt="v4", seeds=(0,)), source=source, points=points)


@pytest.mark.slow
def test_an_episode_in_which_nobody_beside_the_ego_decides_is_one_of_the_swarm(
    tmp_path: Path,
) -> None:
    run(beside_few(), tmp_path / "run")
    there = load(tmp_path / "run")
    assert (there.episodes.groupby("episode").agents.first() == [1, 2]).all()
    assert there.decisions.agent.notna().all()
    assert len(there.agents) == there.episodes.agents.sum()


@pytest.mark.exhaustive
def test_episodes_of_one_agent_and_of_two_are_driven_together_as_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(beside_few(), tmp_path / "together")
    monkeypatch.setattr("harness.evaluate.run.EPISODES_AT_ONCE", 1)
    run(beside_few(), tmp_path / "each")
    for name in FILES:
        assert (tmp_path / "each" / name).read_bytes() == (
            tmp_path / "together" / name
        ).read_bytes()


@pytest.mark.exhaustive
def test_the_settings_of_a_run_of_agents_drive_it_again(
    driven: Path, tmp_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    copytree(driven, tmp_path / "run")
    assert harness("drive", "run", "--quiet", "--workers", 1, "--out", "again")[0] == 0
    assert (tmp_path / "again" / "episodes.csv").read_bytes() == (
        driven / "episodes.csv"
    ).read_bytes()


@pytest.mark.slow
def test_a_run_has_a_table_of_its_agents_that_adds_up_to_its_episodes(driven: Path) -> None:
    run = load(driven)
    keys = ["condition", "seed", "episode"]
    whole = run.episodes.set_index(keys)
    assert len(run.agents) == whole.agents.sum()
    sums = run.agents.assign(arrived=run.agents.result == "cleared").groupby(keys, sort=False)
    assert (sums.arrived.sum() == whole.arrived).all()
    assert (sums.met.sum() == whole.met).all()
    assert sums.lost_s.sum().to_numpy() == pytest.approx(whole.agents_lost_s.fillna(0).to_numpy())
    paying = run.agents[run.agents.gave_way].set_index(keys)
    assert (paying.agent == whole.gave_way.dropna()).all()
    assert (paying.lost_s == whole.most_lost_s[paying.index]).all()


@pytest.mark.slow
def test_the_table_of_answers_says_who_decided_with_them(driven: Path) -> None:
    answers = load(driven).answers
    own = answers.role == "ego"
    assert (answers.decider == answers.viewer)[own].all()
    assert (answers.decider != answers.viewer)[answers.role == "helper"].all()
    assert 0 < own.sum() < len(answers)


@pytest.mark.slow
def test_a_broken_table_of_agents_is_named(driven: Path, tmp_path: Path) -> None:
    copytree(driven, tmp_path / "run")
    file = tmp_path / "run" / "episodes.csv"
    file.write_text(file.read_text().replace('""cleared""', "1"))
    with pytest.raises(UserError, match="is broken"):
        _ = load(tmp_path / "run").agents


@pytest.mark.slow
def test_every_decision_point_comes_out_again_from_the_seat_of_who_decided(driven: Path) -> None:
    there = folder.read(driven)
    names = list(there.decisions.scenes)
    assert (
        sum(e.skipped or 0 for e in there.episodes)
        > 0
        < sum(e.never_acted or 0 for e in there.episodes)
    )
    assert [scene.id for scene in scenes_of(there, names)] == names


@pytest.fixture(scope="module")
def two_models(once: Callable[..., Path]) -> Path:
    """Egos are the proxy and take 100 ms; the others never yield, and take 300 ms."""
    cruise = Agent(cards.resolve("cruise"), versions.load("v4"))
    point = named_point("single-local")
    spec = live_spec_of(prompt="v4", points=(point,), seeds=(0,))
    spec = replace(spec, source=LiveSource(50_000, 1, ALL), helpers=(cruise,))
    return once("two-models", lambda out: run(spec.changed(latency="ego=0.1,helper=0.3"), out))


@pytest.mark.slow
def test_a_vehicle_decides_with_its_own_model_and_takes_that_ones_time(two_models: Path) -> None:
    there = folder.read(two_models)
    egos = {World.start(scenarios.get(ALL), 50_000).vehicles[0].spawn.id}
    table = there.decisions
    for d in table.records(0, len(table)):
        [answer] = [a for a in there.answers_by_scene[d.scene] if a.role == "ego"]
        model = there.agent(answer)["model"]["name"]
        assert d.latency_ms == {"proxy": 100.0, "cruise": 300.0}[model]
        assert d.action == "IDLE" or model == "proxy", "who never yields"
        assert (model == "proxy") == (d.agent in egos)


@pytest.mark.exhaustive
def test_a_page_says_how_long_the_model_of_who_decided_took(two_models: Path) -> None:
    table, page = (
        folder.read(two_models).decisions,
        details(render(gather([two_models]), full=True)),
    )
    for d in table.records(0, len(table)):
        took_s = page[d.scene]["runs"][0]["answers"][0]["took_s"]
        assert took_s == pytest.approx(d.latency_ms / 1000)


@pytest.mark.parametrize("model", ["proxy", "right-hand"])
def test_a_rule_answers_agents_of_several_seats_together_as_each_alone(model: str) -> None:
    spec = replace(live_spec_of(prompt="v4"), ego=Agent(cards.resolve(model), versions.load("v4")))
    spec = replace(spec, points=(named_point("single-local"),), source=LiveSource(50_000, 2, ALL))
    worlds = [World.start(spec.scenario, seed) for seed in (50_000, 50_001)]
    scenes = looks(
        [(world, agent, 0) for world in worlds for agent in world.journeys], 0, spec.ego_alone
    )
    asked = list(requests(spec, scenes, places=[EGO] * len(scenes)))
    assert len({id(request.scenario) for request in asked}) == 4
    backend = open_backend(spec.ego.card)
    assert backend.complete(asked) == [backend.complete([request])[0] for request in asked]


@pytest.mark.exhaustive
def test_a_liar_is_one_vehicle_and_lies_to_whoever_asks(tmp_path: Path) -> None:
    liars = []
    for name in (ALL, "all-way-crossing"):
        points = (named_point("6g:attack=liar"),)
        spec = live_spec_of(prompt="v4", points=points, seeds=(0,))
        table = folder.read(
            run(
                replace(spec, source=LiveSource(50_000, 2, name)), tmp_path / f"run-{len(liars)}"
            ).out
        ).decisions
        said = [
            (d.agent, (d.episode, m.sender), m.attacker)
            for d in table.records(0, len(table))
            for m in d.messages
        ]
        liars.append({sender for _, sender, attacks in said if attacks})
        assert not any(attacks for _, sender, attacks in said if sender not in liars[-1])
        assert all(attacks for _, sender, attacks in said if sender in liars[-1])
    assert liars[0] == liars[1], "those whom the ego faces where it alone decides"
    assert len({episode for episode, _ in liars[0]}) == 2 == len(liars[0])


@pytest.mark.parametrize(
    ("agents", "head", "said"),
    some([("all", "time-out", "100.0 %")], exhaustive=[("ego", "late", "0.0 %")]),
)
def test_time_outs_of_agents_have_a_column_and_nobody_is_late(
    agents: str, head: str, said: str, tmp_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    """Who brakes forever meets nobody and arrives nowhere."""
    of = ("--scenario", "all-way-crossing", "--agents", agents, "--model", "brake", "--workers", 1)
    drawn = ("--condition", "single-local", "--episodes", 1, "--first-seed", 50_000, "--seeds", 0)
    typed = ("drive", *of, *drawn, "--out", tmp_path / "run", "--verbose")
    lines = harness(*typed)[1].splitlines()
    heads = next(line for line in lines if "crash" in line)
    row = lines[lines.index(heads) + 1]
    ends = heads.index(f" {head} ") + len(head) + 1
    assert row[:ends].endswith(said)
    assert max(len(heads), len(row)) <= 80


@pytest.mark.exhaustive
def test_shards_change_no_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, harness: Callable[..., tuple[int, str, str]]
) -> None:
    monkeypatch.setattr("harness.evaluate.run.EPISODES_AT_ONCE", 1)
    words = (
        "drive", "--scenario", "all-way-crossing", "--agents", "all", "--model", "proxy", "--quiet",
        "--condition", "single-local", "--episodes", 2, "--first-seed", 50_000, "--seeds", 0, "--workers", 1,
        "--batch-size", 4,
    )  # fmt: skip
    assert harness(*words, "--out", "one")[0] == 0
    for n in (1, 2):
        said = harness(*words, "--shard", f"{n}/2", "--out", f"part-{n}")
        assert said[0] == 0, said
    assert harness("run", "merge", "part-2", "part-1", "--out", "merged", "--quiet")[0] == 0
    for name in FILES:
        assert (tmp_path / "merged" / name).read_bytes() == (tmp_path / "one" / name).read_bytes()


@pytest.mark.exhaustive
def test_workers_shards_and_a_stop_change_no_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, harness: Callable[..., tuple[int, str, str]]
) -> None:
    monkeypatch.setattr("harness.evaluate.run.EPISODES_AT_ONCE", 1)
    words = (
        "drive", "--scenario", "all-way-crossing", "--agents", "all", "--model", "proxy", "--quiet",
        "--condition", "6g", "--episodes", 3, "--first-seed", 50_000, "--seeds", 0,
    )  # fmt: skip
    assert harness(*words, "--workers", 1, "--out", "one")[0] == 0
    one = {name: (tmp_path / "one" / name).read_bytes() for name in FILES}

    assert harness(*words, "--workers", 2, "--out", "two")[0] == 0
    for n in (1, 2):
        assert harness(*words, "--workers", 1, "--shard", f"{n}/2", "--out", f"part-{n}")[0] == 0
    assert harness("run", "merge", "part-2", "part-1", "--out", "merged", "--quiet")[0] == 0
    assert (tmp_path / "two" / "decisions.parquet").is_file()

    spec = live_spec_of(prompt="v4", points=(named_point("6g"),), seeds=(0,))
    spec = replace(spec, source=LiveSource(50_000, 3, ALL))
    begun: list[int] = []

    def stopping(done: int) -> None:
        begun.append(done)
        if sum(begun) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(spec, tmp_path / "stopped", stopping)
    assert (tmp_path / "stopped" / ".work").is_dir()
    run(spec, tmp_path / "stopped")
    for other in ("two", "merged", "stopped"):
        assert {name: (tmp_path / other / name).read_bytes() for name in FILES} == one, other


@pytest.mark.slow
def test_a_page_lists_decisions_by_step_and_agent_and_has_the_prompts_that_were_sent(
    driven: Path,
) -> None:
    text = render(gather([driven]), full=True)
    index, every, there = json.loads(packed(text, "index")), details(text), folder.read(driven)
    assert [place[1:3] + place[4:] for place in index["scenes"]] == sorted(
        place[1:3] + place[4:] for place in index["scenes"]
    )
    for scene, *_, agent in index["scenes"]:
        vehicles = {v["id"]: v["part"] for v in every[scene]["world"]["vehicles"]}
        assert vehicles[agent] == "ego", "who decides is marked as the ego is"
        assert all(a["prompt"] is not None for a in every[scene]["runs"][0]["answers"])
    telling = failures(there)
    points = {(place[1], place[2], place[4]) for place in index["scenes"] if place[0] in telling}
    assert len(points) == len(telling) > len({episode for episode, *_ in points}), (
        "one of each agent"
    )


def test_alone_on_the_road_an_agent_comes_as_soon_as_its_speed_takes_it() -> None:
    scenario = scenarios.get(ALL)
    for seed, cleared_s in alone(scenario, range(4)).items():
        world = World.start(scenario, seed)
        assert cleared_s.keys() == world.journeys.keys()
        assert all(1 < time_s < scenario.parameters.time_limit_s for time_s in cleared_s.values())


def test_what_has_one_ego_says_so_of_a_scenario_of_several(tmp_path: Path) -> None:
    scenario = scenarios.get(ALL)
    with pytest.raises(
        UserError, match="agent_share is 1, and a dataset has one ego that decides; leave it"
    ):
        build(scenario, tmp_path / "set", 2, 100, 1, lambda done: None)
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize("agents", ["1e-9", "2", "nan", "-1", "half", ""])
def test_a_share_that_is_none_is_said_with_how_to_write_one(
    harness: Callable[..., tuple[int, str, str]], agents: str
) -> None:
    code, _, err = harness("drive", "--scenario", "all-way-crossing", "--agents", agents)
    assert code == 2
    assert f"--agents is '{agents}'; give ego, all, or a share from 0 to 1, written as 0.5" in err


def test_a_scenario_in_which_only_the_ego_has_a_goal_has_no_agents() -> None:
    with pytest.raises(UserError, match="agent_share"):
        scenarios.get("occluded-intersection:agent_share=1")


@pytest.mark.slow
def test_with_clocks_apart_an_agent_decides_at_times_of_its_own(tmp_path: Path) -> None:
    name = f"{ALL},clock=apart"
    spec = replace(
        live_spec_of(prompt="v4", points=(named_point("single-local"),), seeds=(0,)),
        source=LiveSource(50_000, 1, name),
    )
    run(spec, tmp_path / "run")
    there = folder.read(tmp_path / "run")
    rows = there.decisions.records(0, len(there.decisions))
    scenario, phases = scenarios.get(name), set[float]()
    lag_s = 0.16  # the card's 145 ms in whole frames
    worlds = [World.start(scenario, seed) for seed in range(50_000, 50_001)]
    for row in rows:
        world = worlds[row.episode]
        place = [v.spawn.id for v in world.vehicles].index(str(row.agent))
        offset_s = offset_of(scenario, world.seed, place) / scenario.parameters.simulation_hz
        assert row.acts_at_s == pytest.approx(row.step + offset_s + lag_s)
        phases.add(offset_s)
    assert len(phases) == 3
    names = sorted({row.scene for row in rows})
    assert [scene.id for scene in scenes_of(there, names)] == names
