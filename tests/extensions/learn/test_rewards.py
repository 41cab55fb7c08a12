"""`harness.environment`: exact rewards on trees and in the simulator,
on layouts that may be learnt from.
"""

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import former
import numpy as np
import pytest

import harness as package
from harness import UserError
from harness.core.seeds import FIRST
from harness.dataset.load import Dataset
from harness.extensions.learn.rewards.values import BEST, Values, optimal

gymnasium = pytest.importorskip("gymnasium", reason="needs the sim extra")

pytestmark = pytest.mark.usefixtures("unrebuilt")

Make = Callable[..., Any]


@pytest.fixture
def make(small_path: Path) -> Make:
    """An environment on the four trees of the small dataset, whose layouts are of tune seeds."""
    return lambda **options: package.environment(dataset=small_path, **options)


def after(data: Dataset, point: int, action: int, driver: str) -> bool:
    """Whether an episode succeeds after an action if a driver takes the rest,
    walked edge by edge.
    """
    forest = data.forest
    edge, point = forest.edge[point, action], forest.child[point, action]
    while point >= 0:
        action = forest.drivers[driver][point]
        edge, point = forest.edge[point, action], forest.child[point, action]
    end, limit_s = forest.edges[edge].end, forest.limit_s
    return end.result == "cleared" and end.time_s <= limit_s[int(edge_tree(data, edge))]


def edge_tree(data: Dataset, edge: int) -> int:
    [at] = np.unique(data.forest.tree[(data.forest.edge == edge).any(axis=1)])
    return int(at)


def test_it_is_one_of_the_names_for_python() -> None:
    assert "environment" in dir(package)


@pytest.mark.parametrize("driver", ["cruise", "local-view", "full-view"])
def test_worth_is_what_a_walk_of_the_driver_comes_to(driver: str, small: Dataset) -> None:
    values = Values.of(small.forest, driver)
    for point in range(0, len(values.ids), 9):
        for action in range(len(values.actions)):
            assert values.table[point, action] == after(small, point, action, driver)


def test_the_best_is_at_least_as_good_as_everyone(small: Dataset) -> None:
    best = Values.of(small.forest, BEST)
    assert set(np.unique(best.table)) == {0, 1}
    for then in ("uniform", "cruise", "brake", "local-view", "full-view"):
        others = Values.of(small.forest, then).table
        assert (best.table >= others).all()
        assert (best.table > others).any() == (then != "full-view"), "which sees everything too"
    assert np.array_equal(optimal(best.table).any(axis=1), ~best.lost)
    with pytest.raises(UserError, match="unknown then 'nobody'"):
        Values.of(small.forest, "nobody")


def test_a_batch_is_one_at_a_time_and_ids_are_places(small: Dataset) -> None:
    values, rng = Values.of(small.forest, "uniform"), np.random.default_rng(3)
    places = rng.integers(len(values.ids), size=50)
    p = rng.dirichlet(np.ones(len(values.actions)), 50)
    batch = values(places, p)
    for n, place in enumerate(places.tolist()):
        [alone] = values([values.ids[place]], p[n : n + 1])
        assert alone == batch[n] == pytest.approx(sum(p[n] * values.table[place]))
    assert np.array_equal(values(places), values.table[places])
    with pytest.raises(KeyError, match="00000-9-nowhere"):
        values(["00000-9-nowhere"])


@pytest.mark.filterwarnings("ignore:.*not within the observation space")
@pytest.mark.filterwarnings("ignore:.*spec")
@pytest.mark.parametrize(
    "options",
    [{}, {"observation": "arrays"}, {"distributions": True, "viewer": "any", "reward": "success"}],
)
def test_gymnasium_finds_nothing_wrong(options: dict[str, Any], make: Make) -> None:
    from gymnasium.utils.env_checker import check_env

    check_env(make(**options), skip_render_check=True)


@pytest.mark.exhaustive
def test_several_go_side_by_side(make: Make) -> None:
    several = gymnasium.vector.SyncVectorEnv([lambda: make(observation="arrays")] * 2)
    seen, info = several.reset(seed=1)
    assert seen["numbers"].shape == seen["known"].shape == (2, len(several.envs[0].numbers))
    _, rewards, *_ = several.step([0, 2])
    assert rewards.tolist() == [
        values[action] - max(values) for action, values in enumerate(info["values"])
    ]


@pytest.mark.parametrize("driver", ["cruise", "full-view"])
def test_whoever_drives_as_a_driver_ends_as_it_does(
    driver: str, make: Make, small: Dataset
) -> None:
    env, forest = make(then=driver), small.forest
    for tree, seed in enumerate(small.seeds):
        _, info = env.reset(options={"layout_seed": seed})
        assert (info["layout_seed"], info["danger"]) == (seed, forest.dangers[tree] or "")
        over, visited = False, []
        while not over:
            visited.append(info["scene"])
            action = forest.drivers[driver][forest.place[info["scene"]]]
            worth, best = info["values"][action], info["values"].max()
            _, reward, over, cut, info = env.step(action)
            assert (reward, cut) == (worth - best, False)
            assert worth == forest.driver_success(driver)[tree], (
                "its own worth stays the same to the end"
            )
        assert info["success"] == forest.driver_success(driver)[tree]
        assert set(visited) <= {forest.ids[n] for n in forest.visited(forest.drivers[driver])}


def test_a_distribution_is_worth_its_mean_and_one_of_its_actions_is_taken(make: Make) -> None:
    env, p, taken = make(then="uniform"), np.array([0.25, 0.5, 0.25]), []
    for seed in range(40):
        _, info = env.reset(seed=seed)
        _, reward, *_, then = env.step(p * 8)  # is normalised
        assert reward == pytest.approx(p @ info["values"] - info["values"].max())
        taken.append(then["taken"])
        assert env.reset(seed=seed)[1]["scene"] == info["scene"]
        assert env.step(p)[-1]["taken"] == taken[-1]
    assert set(taken) == {0, 1, 2}


@pytest.mark.parametrize(
    "policy", ["always SLOWER", "always FASTER", "cruise", "local-view", "full-view", 1, 2]
)
def test_an_episode_earns_its_success_less_whether_it_was_possible(
    policy: str | int, make: Make, small: Dataset
) -> None:
    env, forest = make(), small.forest
    always = {"always SLOWER": 0, "always FASTER": 2}
    for tree, seed in enumerate(small.seeds):
        _, info = env.reset(
            seed=policy if isinstance(policy, int) else 0, options={"layout_seed": seed}
        )
        earned, over = 0.0, False
        while not over:
            if isinstance(policy, int):
                action = int(env.np_random.integers(3))
            elif policy in always:
                action = always[policy]
            else:
                action = forest.drivers[policy][forest.place[info["scene"]]]
            _, reward, over, _, info = env.step(action)
            earned += reward
        assert earned == int(info["success"]) - int(forest.value[forest.root[tree]])


def test_success_is_paid_once_at_the_end(make: Make, small: Dataset) -> None:
    env, paid = make(reward="success"), []
    for seed in small.seeds:
        _, info = env.reset(options={"layout_seed": seed})
        rewards, over = [], False
        while not over:
            _, reward, over, _, info = env.step(int(info["values"].argmax()))
            rewards.append(reward)
        assert rewards[:-1] == [0] * (len(rewards) - 1)
        assert (
            rewards[-1]
            == info["success"]
            == small.forest.value[small.forest.root[small.seeds.index(seed)]]
        )
        paid.append(rewards[-1])
    assert 1 in paid


@pytest.mark.slow
def test_driving_is_the_walk_through_the_tree(make: Make, small: Dataset) -> None:
    """The same actions lead to the same states, are worth the same and end the same,
    with no tree built.
    """
    seed = small.seeds[1]
    walked = make(then="local-view")
    driven = package.environment(former.NAME, seeds=seed, layouts=1, driven=True, then="local-view")
    assert small.scenario.parameters == driven.source.scenario.parameters
    (seen, a), (shown, b) = (env.reset(options={"layout_seed": seed}) for env in (walked, driven))
    over: Any = False
    for action in (1, 0, 2, 2, 2, 2, 2, 2):
        assert seen == shown
        assert (a["scene"].split("-", 1)[1], a["values"].tolist()) == (
            b["scene"].split("-", 1)[1], b["values"].tolist(),
        )  # fmt: skip
        if over:
            break
        (seen, *before, a), (shown, *after, b) = (env.step(action) for env in (walked, driven))
        assert before == after
        over = after[1]
    assert over
    assert a["success"] == b["success"]


@pytest.mark.slow
def test_trees_are_built_once_and_say_what_was_learnt(monkeypatch: pytest.MonkeyPatch) -> None:
    env = package.environment("parking-exit", layouts=1, quiet=True)
    monkeypatch.setattr("harness.extensions.learn.rewards.layouts.build", None)
    again = package.environment("parking-exit", layouts=1, quiet=True)
    assert np.array_equal(env.values.table, again.values.table)
    learnt = json.loads(json.dumps(env.learnt()))
    first = {"layouts": 1, "first_seed": FIRST["train"], "purpose": "train", "then": "best"}
    assert first.items() <= learnt.items()
    assert set(learnt["scenarios"]) == {"parking-exit"}
    assert learnt["prompts"] == {env.ask.prompt.version: env.ask.prompt.sha256}


def test_arrays_are_of_the_viewers_own_graph(make: Make, small: Dataset) -> None:
    env = make(observation="arrays")
    seen, info = env.reset(seed=1)
    graph = small.scene(info["scene"]).graphs[info["viewer"]]
    by_name = dict(zip(env.numbers, seen["numbers"].tolist(), strict=True))
    assert by_name["ego speed_mps"] == pytest.approx(graph.ego.speed_mps)
    assert by_name["ego zone_m"] == pytest.approx(graph.ego.zone_m)
    assert (seen["numbers"][seen["known"] == 0] == 0).all()
    assert 0 < seen["known"].sum() < len(env.numbers)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"seeds": "report"},
            "seeds='report': numbers are reported of layout seeds from 200000 on, and noth",
        ),
        ({"seeds": 200_000}, 'nothing may learn from them; give seeds="train" (100000 to 199999)'),
        ({"seeds": 99_999, "layouts": 2}, "are for tune and train; keep to one of"),
        ({"seeds": "tain"}, "unknown seeds 'tain'"),
        ({"seeds": -1}, "seeds -1, layouts 32: give a seed from 0 on"),
        ({"layouts": 0}, "layouts 0: give a seed from 0 on, and 1 layout or more"),
        ({"workers": 0}, "--workers 0: give 1 to 256 processes"),
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        (
            {"dataset": "occluded-intersection-v2"},
            "numbers are reported of layout seeds from 200000 on",
        ),
        ({"dataset": "prompts"}, "prompts is no dataset (no manifest.json); build one with"),
        ({"dataset": "nowhere"}, "unknown dataset 'nowhere'"),
        ({"dataset": "SMALL", "driven": True}, "leave out scenario and driven"),
        ({"dataset": "SMALL", "then": "nobody"}, "unknown then 'nobody'"),
        ({"dataset": "SMALL", "prompt": "v0"}, "unknown prompt 'v0'"),
        (
            {"dataset": "SMALL", "prompt": "v7"},
            "prompt v7 shows pictures, and here are texts alone",
        ),
        ({"dataset": "SMALL", "answer": "song"}, "unknown answer 'song'"),
        ({"dataset": "SMALL", "viewer": "v99"}, "unknown viewer of scene"),
        ({"dataset": "SMALL", "observation": "smell"}, "unknown observation 'smell'"),
        ({"dataset": "SMALL", "reward": "fame"}, "unknown reward 'fame'"),
        (
            {"driven": True},
            'reward="regret" needs values; give then="local-view", or reward="success"',
        ),
        ({"driven": True, "then": "best"}, "unknown then 'best'"),
    ],
)
def test_bad_input_is_one_line(options: dict[str, Any], said: str, small_path: Path) -> None:
    given: dict[str, Any] = {
        key: small_path if value == "SMALL" else value for key, value in options.items()
    }
    with pytest.raises(UserError) as error:
        package.environment(**given).values  # noqa: B018 # read when they are first asked for
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "action",
    [3, -1, 1.0, "IDLE", [0.5, 0.5], [0, 0, 0], [1, -1, 1], [1, np.nan, 1], [1, np.inf, 1], None],
)
def test_what_is_no_action_is_one_line_and_moves_nobody(action: Any, make: Make) -> None:
    env = make()
    with pytest.raises(UserError, match="no episode is under way; call reset"):
        env.step(1)
    _, info = env.reset(seed=1)
    with pytest.raises(
        UserError, match="give an index, 0 to 2 for SLOWER, IDLE, FASTER, or 3 probabilities"
    ):
        env.step(action)
    assert env.trip.scene.id == info["scene"]


def test_a_layout_of_report_seeds_is_not_begun(make: Make) -> None:
    driven = package.environment("occluded-intersection", driven=True, reward="success")
    with pytest.raises(UserError, match="layout seed 200003: numbers are reported of"):
        driven.reset(options={"layout_seed": 200_003})
    with pytest.raises(
        UserError, match="layout seed 200003 has no tree here; give one of 100 to 103"
    ):
        make().reset(options={"layout_seed": 200_003})
    with pytest.raises(UserError, match="rows\\(\\) of driven episodes are not known in advance"):
        driven.rows()


def test_rows_are_the_questions_of_points_where_it_matters_what_is_done(
    make: Make, small: Dataset
) -> None:
    env = make(viewer="any")
    rows, values = env.rows(per_level=2), env.values
    assert rows == env.rows(per_level=2)
    assert len({row["viewer"] for row in rows}) > 1
    assert {row["scene"] for row in env.rows(per_level=99)} == {
        values.ids[n] for n in np.flatnonzero(values.decides)
    }
    for row in rows:
        assert row["values"] == values([row["scene"]])[0].tolist() not in ([0, 0, 0], [1, 1, 1])
        assert (row["purpose"], row["danger"]) == (
            "tune",
            bool(small.dangerous[row["layout_seed"] - 100]),
        )
        scene = small.scene(row["scene"])
        assert row["prompt"] == env.ask.chat(scene.graphs[row["viewer"]])
        assert row["role"] == scene.graphs[row["viewer"]].role
    json.dumps(rows)


@pytest.mark.parametrize("per_level", [1, 2, 6])
def test_every_level_has_as_many_rows_and_both_kinds_of_layouts_weigh_alike(
    per_level: int, make: Make, small: Dataset
) -> None:
    """Of the four layouts as many have a danger as `dangerous` says;
    the rarer ones have more rows each.
    """
    rows = make().rows(per_level=per_level)
    levels = Counter((row["layout_seed"], row["scene"].split("-")[1]) for row in rows)
    dangerous = dict(zip(small.seeds, small.dangerous.tolist(), strict=True))
    sizes = {kind: sum(each == kind for each in dangerous.values()) for kind in (True, False)}
    assert min(sizes.values()) > 0
    for (seed, _), count in levels.items():
        assert count == max(1, round(per_level * len(dangerous) / 2 / sizes[dangerous[seed]]))
    scenes = Counter(row["scene"] for row in rows)
    for (seed, level), count in levels.items():
        there = [
            n for name, n in scenes.items() if name.split("-")[:2] == [f"{seed - 100:05d}", level]
        ]
        assert sum(there) == count
        assert max(there) - min(there) <= 1, "none is repeated before all are there"


def test_references_are_what_a_constant_and_those_without_a_model_earn(
    make: Make, small: Dataset
) -> None:
    env = make()
    rows, references = env.rows(), env.references()
    assert list(references) == ["constant", "uniform", "open-loop", "local-view", "full-view"]
    table, forest = np.array([row["values"] for row in rows]), small.forest
    constant = np.array([row["constant"] for row in rows])
    assert {env.actions[n] for n in constant} == {"IDLE"}, "as `constants.csv` says"
    less = table[np.arange(len(rows)), constant]
    assert references["constant"] == {
        "advantage": 0.0,
        "success": np.mean(
            [
                forest.constant_success("IDLE")[kind].mean()
                for kind in (small.dangerous, ~small.dangerous)
            ]
        ),
    }
    assert references["uniform"]["advantage"] == pytest.approx((table.mean(axis=1) - less).mean())
    for name in ("local-view", "full-view"):
        taken = [forest.drivers[name][forest.place[row["scene"]]] for row in rows]
        assert references[name]["advantage"] == pytest.approx(
            (table[np.arange(len(rows)), taken] - less).mean()
        )
    assert references["full-view"]["success"] == 1


def test_a_constant_that_nobody_measured_is_the_best_of_the_trees(
    make: Make, small: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.extensions.learn.rewards.trips.constant", lambda scenario: None)
    forest = small.forest
    balanced = [
        np.mean(
            [
                forest.constant_success(action)[kind].mean()
                for kind in (small.dangerous, ~small.dangerous)
            ]
        )
        for action in forest.actions
    ]
    assert make().rows(per_level=1)[0]["constant"] == int(np.argmax(balanced))


def columns(rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {key: [row[key] for row in rows] for key in rows[0] if key != "prompt"}


def stated(*p: float) -> str:
    return json.dumps(
        {"action_distribution": dict(zip(("SLOWER", "IDLE", "FASTER"), p, strict=True))}
    )


def test_an_answer_earns_what_its_likeliest_action_is_worth_less_the_constants(make: Make) -> None:
    env = make()
    row = next(row for row in env.rows() if row["values"] == [0, 1, 1])
    said = [
        stated(0.4, 0.5, 0.1), f"I think. {stated(0.1, 0.5, 0.4)} ",
        [{"role": "assistant", "content": stated(0, 0, 1)}],
        stated(0.5, 0.3, 0.2), stated(0.4, 0.2, 0.4), "brake!", "",
    ]  # fmt: skip
    of_constant = {"IDLE": [0, 0, 0, -1, -0.5, -1, -1], "SLOWER": [1, 1, 1, 0, 0.5, 0, 0]}
    for action, earned in of_constant.items():
        given = columns([row | {"constant": env.actions.index(action)}] * len(said))
        assert (
            env.advantage([row["prompt"]] * len(said), said, **given, trainer_state=None) == earned
        )


def test_what_a_distribution_states_is_worth_its_mean(make: Make) -> None:
    env = make()
    row = next(row for row in env.rows() if row["values"] == [0, 1, 1]) | {"constant": 1}
    said = [stated(0.4, 0.5, 0.1), stated(0, 0.2, 0.8), "brake!"]
    earned = env.expected_advantage([], said, **columns([row] * 3))
    assert earned == [pytest.approx(-0.4), 0, -1]


def test_a_letter_is_worth_its_action(make: Make) -> None:
    env = make(answer="readout")
    row = next(row for row in env.rows() if row["values"] == [0, 1, 1])
    assert row["prompt"][-1]["content"].endswith(
        "Answer with one letter: A SLOWER, B IDLE, C FASTER."
    )
    said = ["A", "B", " C\n", "B: it is clear", "BRAKE", "D", "b", ""]
    assert env.advantage([], said, **columns([row] * 8)) == [-1, 0, 0, 0, -1, -1, -1, -1]
    call = {"role": "assistant", "content": None, "tool_calls": [{"name": "brake"}]}
    without_text: list[Any] = [[call], [], [{"role": "assistant"}], [{"content": 3}], None]
    assert env.advantage([], without_text, **columns([row] * 5)) == [-1] * 5
    of_others = [[call, {"role": role, "content": "B"}] for role in ("tool", "user")]
    assert env.advantage([], of_others, **columns([row] * 2)) == [-1, -1]
    in_parts = [
        {"content": [{"type": "text", "text": said[1][:9]}, {"type": "text", "text": said[1][9:]}]}
    ]
    assert env.advantage([], [in_parts], **columns([row])) == [0]
