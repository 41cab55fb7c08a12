"""Schedules on stored runs: choices against walks, the oracle as a bound,
fronts and areas by hand.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import live_spec_of, run, spec_of
from relabelling import relabel

from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS, named_point
from harness.coordination.schedules import SCHEDULES
from harness.core.config import toml
from harness.core.errors import UserError
from harness.core.files import sha256_file
from harness.core.resources import MARKER, find
from harness.dataset.load import Dataset, load
from harness.evaluate import asking
from harness.evaluate.frozen_world import FrozenWorld
from harness.evaluate.outlook import outlook
from harness.evaluate.table import columns
from harness.evaluate.walk import walk
from harness.extensions.schedules.choices import COSTS, Choices, choices
from harness.extensions.schedules.formulas import MARGIN
from harness.extensions.schedules.learning import fit, layouts
from harness.extensions.schedules.learnt import Learnt
from harness.extensions.schedules.study import (
    FIRST,
    Candidate,
    Compared,
    Play,
    _area,
    candidates,
    compare,
    in_order,
)
from harness.runs.folder import read
from harness.runs.metric_values import of_decisions
from harness.runs.metrics import METRICS
from harness.runs.success import Success
from harness.studies import axes
from harness.studies.replayed_run import ReplayedRun, counted

pytestmark = pytest.mark.usefixtures("unrebuilt", "svg_alone")

SEED = 100  # of the first layout of `small`
SIXG = POINTS["6g"]
POINTS_PLAYED = (
    "6g", "6g:schedule=coverage,max_helpers=2", "6g:schedule=learnt",
    "mode4:schedule=deadline,threshold=0.01",
)  # fmt: skip
MORE_POINTS = (
    "v2x", "6g:schedule=random", "6g:schedule=risk", "6g:schedule=always", "6g:radius_m=30", "6g:tau=0.9", "6g:max_helpers=1", "6g:schedule=margin", "v2x:schedule=deadline", "6g:schedule=never",
)  # fmt: skip


@pytest.fixture(scope="module")
def stored(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> ReplayedRun:
    return ReplayedRun(run(spec_of(small), tmp_path_factory.mktemp("schedules") / "run").out)


def made(stored: ReplayedRun, text: str) -> Choices:
    return choices(stored, named_point(text), stored.seeds, lambda n: None)


@pytest.mark.parametrize(
    "text",
    [*POINTS_PLAYED, *(pytest.param(text, marks=pytest.mark.exhaustive) for text in MORE_POINTS)],
)
def test_what_follows_from_choices_is_what_a_walk_comes_to(stored: ReplayedRun, text: str):
    """The oracle is at least as good in every episode, and needs as few messages for a success."""
    point = named_point(text)
    every = made(stored, text)
    success, costs = every.played(every.scheduled(point))
    [[walked]] = stored.walked([axes.Setting(text, point, stored.vehicles)], stored.seeds)
    world = FrozenWorld(stored.dataset, [point], stored.seeds)
    steps = walk(world, [point], stored, stored.spec.ties)
    airtime_ms = np.concatenate([columns(part)["airtime_ms"] for [part] in steps])
    of = {**walked.columns, "airtime_ms": airtime_ms}
    assert np.array_equal(success, walked.ends["success_rate"])
    for cost, metric in (("messages", "messages_per_episode"), ("airtime_ms", "airtime_ms")):
        values = of_decisions(METRICS[metric], of, walked.places, success.size)
        assert costs[..., COSTS.index(cost)] == pytest.approx(
            values.reshape(success.shape), abs=1e-3
        )
    mean = of_decisions(METRICS["latency_proxy_ms"], of, walked.places, success.size)
    latency, decisions = costs[..., COSTS.index("latency_ms")], costs[..., COSTS.index("decisions")]
    assert latency / decisions == pytest.approx(mean.reshape(success.shape), abs=1e-2)
    best, fewest = every.oracle()
    assert (best >= success).all()
    assert (fewest[..., 0] <= costs[..., 0])[success == 1].all()


def test_of_nobody_to_ask_the_oracle_is_the_ego_alone(stored: ReplayedRun):
    every = made(stored, "6g:max_helpers=0")
    [[alone]] = stored.walked(
        [axes.Setting("", POINTS["single-local"], stored.vehicles)], stored.seeds
    )
    success, costs = every.oracle()
    assert np.array_equal(success, alone.ends["success_rate"])
    assert not costs[..., 0].any()


@pytest.mark.parametrize("schedule", ["coverage", "deadline"])
def test_where_nobody_may_be_asked_only_the_usual_threshold_is_tried(
    stored: ReplayedRun, schedule: str
):
    text = "6g:radius_m=0.001,max_helpers=1"
    point = named_point(text)
    tried = candidates(made(stored, text), point, schedule)
    usual = point.changed(schedule=schedule, threshold=None).ask.above
    assert {candidate.threshold for candidate in tried} == {0.0, usual}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("6g:consensus=ego-prompt", "consensus ego-prompt is no function of who is heard now"),
        ("6g:messages=shuffled", "the oracle knows no messages; leave it out"),
        ("6g:attack=liar", "the oracle knows no attack; leave it out"),
        ("6g:content=objects", "the oracle knows no content; leave it out"),
    ],
)
def test_what_the_oracle_cannot_bound_is_refused(stored: ReplayedRun, text: str, says: str):
    with pytest.raises(UserError, match=says):
        made(stored, text)


def test_the_ego_knows_of_regions_what_its_graph_says(small: Dataset):
    """And a helper adds no more than the ego lacks."""
    scenes = small.scenes(small.courses())
    seen = outlook(small.scenario, scenes)
    for n, scene in enumerate(scenes):
        graph = scene.graphs[scene.viewers[0]]
        shares = [1 - sector.seen_share for sector in graph.sectors]
        assert seen.unseen[n] == pytest.approx(shares, abs=0.0051)
        assert (np.nan_to_num(seen.added[n]) <= seen.unseen[n] + 1e-9).all()
    assert (seen.added[~np.isnan(seen.added)] > 0.1).any()
    again = outlook(small.scenario, scenes[3:4])
    assert np.array_equal(again.added[0], seen.added[3], equal_nan=True)


def test_what_helpers_add_does_not_depend_on_the_other_roads():
    pytest.importorskip("harness.extensions.roads")
    roads = load(find("datasets", "sumo-merge-v1"), 20)
    scenes = roads.scenes([roads.forest.ids[root] for root in roads.forest.root.tolist()])
    together = outlook(roads.scenario, scenes)
    widths = set()
    for n, scene in enumerate(scenes):
        alone = outlook(roads.scenario, [scene])
        helpers, regions = alone.added.shape[1:]
        widths.add(regions)
        assert not np.isnan(together.added[n, :helpers]).any(), scene.id
        assert np.array_equal(together.added[n, :helpers, :regions], alone.added[0])
        assert not together.added[n, :helpers, regions:].any()
        assert np.isnan(together.added[n, helpers:]).all()
    assert len(widths) > 1


@pytest.mark.slow
def test_frozen_and_driven_ask_alike(small: Dataset, tmp_path: Path):
    texts = ("6g:schedule=coverage,max_helpers=1", "6g:schedule=random", "6g:schedule=learnt")
    same: Any = {"points": tuple(map(named_point, texts)), "latency": "paper"}
    frozen = read(run(spec_of(load(small.path, 2), **same), tmp_path / "frozen").out)
    driven = read(run(live_spec_of(episodes=2, first_seed=SEED, **same), tmp_path / "driven").out)
    assert [e.success for e in frozen.episodes] == [e.success for e in driven.episodes]
    for of in texts:
        asked = [
            done.decisions["messages"][np.array(done.decisions.labels("condition")) == of].tolist()
            for done in (frozen, driven)
        ]
        assert asked[0] == asked[1]
        assert sum(asked[0]) > 0


def test_what_ships_stands_first_and_no_file_takes_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    assert set(FIRST) == {name for name in SCHEDULES if SCHEDULES.is_ours(name)}
    assert in_order(["mine", *reversed(FIRST)]) == [*FIRST, "mine"]
    monkeypatch.chdir(tmp_path)
    (tmp_path / MARKER).touch()
    (tmp_path / "schedules").mkdir()
    (tmp_path / "schedules/margin.toml").touch()
    assert SCHEDULES["margin"] is MARGIN
    assert SCHEDULES.file_sha256("margin") is None


# -- fronts and areas, by hand ---------------------------------------------------------------------


PLAIN = Success(np.zeros(4, dtype=bool))


def play(
    schedule: str,
    most: int,
    threshold: float | None,
    success: Any,
    messages: Any,
    counting: Success = PLAIN,
) -> Play:
    """One seed. An episode takes 10 J, and 5 J a message."""
    n, joules = len(success), 10.0 + 5.0 * np.array(messages)
    costs = np.array([messages, [0.1] * n, [150.0] * n, [1.0] * n, joules]).T
    return Play(
        Candidate(schedule, threshold, most),
        np.array([success], dtype=float),
        costs[None],
        counting,
    )


def by_hand(tune: bool = True) -> Compared:
    """Four episodes. Never: 1 succeeds. Always: 3 with 4 messages each. The oracle:
    4 with 1 on average.
    """
    plays = {
        "entropy": [
            play("entropy", 2, 0.7, [1, 1, 0, 0], [4, 4, 2, 2]),
            play("entropy", 1, 0.7, [1, 1, 1, 0], [1] * 4),
        ],
        "never": [play("never", most, None, [1, 0, 0, 0], [0] * 4) for most in (1, 2)],
        "always": [
            play("always", 1, None, [1, 1, 0, 0], [2] * 4), play("always", 2, None, [1, 1, 1, 0], [4] * 4)
        ],
        "random": [play("random", 2, 0.5, [1, 1, 0, 0], [2] * 4)],
    }  # fmt: skip
    # On tune layouts the cheap entropy is worse than never, and dear.
    worse = [plays["entropy"][0], play("entropy", 1, 0.7, [0, 0, 0, 0], [1] * 4)]
    oracle = play("oracle", 2, None, [1, 1, 1, 1], [0, 1, 1, 2])
    point = SIXG.changed(max_helpers=2)
    return Compared(
        "x", point, ("entropy",), plays, {**plays, "entropy": worse} if tune else {}, oracle, 0.5
    )


def test_a_setting_is_chosen_on_tune_layouts_within_the_budget():
    """The paper's takes 3 messages an episode, half of it is 1.5: one helper alone is within."""
    compared = by_hand()
    assert compared.paper.candidate == Candidate("entropy", 0.7, 2)
    assert compared.chosen("entropy").candidate.most == 1
    assert compared.chosen("always").candidate.most == 1, "none is within the budget: the cheapest"
    assert by_hand(tune=False).chosen("entropy").candidate.most == 2, "the point's own"


def balanced() -> Compared:
    """One episode of four has a danger. Entropy with two helpers wins more often,
    with one where it counts.

    Balanced, two helpers have 1/2 (1 + 0) and one has 1/2 (1/3 + 1).
    """
    counting, once = Success(np.array([True, False, False, False])), by_hand()
    plays = {
        name: [replace(p, success_rule=counting) for p in of] for name, of in once.plays.items()
    }
    plays["entropy"] = [
        play("entropy", 2, 0.7, [0, 1, 1, 1], [1] * 4, counting),
        play("entropy", 1, 0.7, [1, 1, 0, 0], [1] * 4, counting),
    ]
    return replace(
        once,
        plays=plays,
        tune=plays,
        budget=1.0,
        oracle=replace(once.oracle, success_rule=counting),
    )


def test_balanced_success_chooses_ranks_and_is_averaged_over_budgets():
    """Never has 1/2 (1 + 0), entropy with one helper 2/3, from 1 message of 4 on."""
    compared = balanced()
    assert compared.chosen("entropy").candidate.most == 1
    assert [(p.candidate.schedule, p.candidate.most) for p in compared.front("entropy")] == [
        ("never", 1), ("entropy", 1),
    ]  # fmt: skip
    assert compared.area("entropy").value == pytest.approx((1 / 2 + 3 * 2 / 3) / 4)
    paper, one, bound = compared.rows
    assert (paper.success.value, paper.plain.value) == (0.5, 0.75)
    assert (one.success.value, one.plain.value) == (pytest.approx(2 / 3), 0.5)
    assert one.over_paper.value == pytest.approx(1 / 6)
    assert one.closed.value == pytest.approx((1 / 6) / (1 / 2))
    assert (bound.success.value, compared.regret.value) == (1.0, 0.5)
    plain = replace(
        compared,
        tune={
            name: [replace(p, success_rule=PLAIN) for p in of] for name, of in compared.tune.items()
        },
    )
    assert plain.chosen("entropy").candidate.most == 2, "as plain success chooses"


def test_the_front_takes_what_was_best_on_tune_layouts():
    taken = by_hand().front("entropy")
    assert [(p.candidate.schedule, p.candidate.most) for p in taken] == [
        ("never", 1),
        ("entropy", 2),
    ]
    flattered = by_hand(tune=False).front("entropy")
    assert [(p.candidate.schedule, p.candidate.most) for p in flattered] == [
        ("never", 1),
        ("entropy", 1),
    ]


def test_areas_are_means_over_budgets_up_to_always_asking_all():
    """Entropy on tune layouts: 1/4 below 3 messages of 4, then 2/4. The oracle:
    1/4 from 0, 4/4 from 1 on.

    A success for one message at most is one of three episodes at 2/4 messages.
    """
    compared = by_hand()
    assert compared.area("entropy").value == pytest.approx((3 * 1 / 4 + 1 * 2 / 4) / 4)
    assert compared.area("never").value == pytest.approx(1 / 4)
    # Caps of 0, 1 and 2 messages: 1/4 at 0, 3/4 at 2/4 and 4/4 at 4/4 messages an episode.
    assert compared.area("oracle").value == pytest.approx((0.5 * 1 / 4 + 0.5 * 3 / 4 + 3 * 1) / 4)


def test_joules_are_a_budget_as_messages_are():
    """Here as many joules go with each message, above those of never asking,
    so areas are the same.
    """
    compared = by_hand()
    assert compared.energy
    assert compared.paper.means["energy_j"] == 10 + 5 * 3
    for name in ("entropy", "never", "oracle"):
        assert compared.area(name, "energy_j").value == pytest.approx(compared.area(name).value)
        assert compared.area(name, "energy_j").low == pytest.approx(compared.area(name).low)
    assert compared.front("entropy", "energy_j") == compared.front("entropy")
    dear = replace(compared.plays["entropy"][1], costs=compared.everybody.costs * 2)
    other = replace(compared, plays={**compared.plays, "entropy": [compared.paper, dear]}, tune={})
    assert other.front("entropy", "energy_j") == [other.plays["never"][0], other.paper, dear]


def test_random_at_as_many_messages_lies_between_its_neighbours():
    """1 message: half of the way from never to random at 2."""
    compared = by_hand()
    like = compared.random_like(play("entropy", 1, 0.7, [1, 1, 1, 0], [1] * 4))
    assert like.tolist() == [[1, 0.5, 0, 0]]
    assert compared.random_like(compared.everybody).tolist() == [[1, 1, 1, 0]]


def test_the_table_says_how_much_of_the_gap_is_closed():
    """The paper's 2/4, the oracle 4/4, the one chosen 3/4:
    half of the gap at a third of the messages.
    """
    paper, one, bound = by_hand().rows
    assert (paper.closed.value, one.closed.value, bound.closed.value) == (0, 0.5, 1)
    assert one.messages.value == pytest.approx(1 / 3)
    assert one.over_paper.value == pytest.approx(0.25)
    assert one.over_random.value == pytest.approx(3 / 4 - 1.5 / 4)
    assert by_hand().regret.value == pytest.approx(0.5)


def test_an_area_has_the_best_rank_and_not_the_best_luck():
    success, messages = np.array([[0.2, 0.9, 0.5]]), np.array([[0.0, 1.0, 2.0]])
    assert _area(success, messages, np.array([1.0, 2.0, 3.0]), np.array([4.0])) == pytest.approx(
        (0.2 + 0.9 + 2 * 0.5) / 4
    )
    assert _area(success, messages, np.array([1.0, 0.5, 3.0]), np.array([4.0])) == pytest.approx(
        (2 * 0.2 + 2 * 0.5) / 4
    )
    nobody_in_reach = np.zeros(1)
    assert np.isnan(_area(success, 0 * messages, np.ones(3), nobody_in_reach)).all()


# -- the commands ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_schedules_are_compared_from_the_command_line(
    stored: ReplayedRun, harness: Callable[..., Any], tmp_path: Path
):
    typed = (
        "study",
        "schedule",
        "compare",
        stored.run.path,
        "--schedule",
        "entropy",
        "--schedule",
        "learnt",
    )
    code, said, _ = harness(*typed, "--json", "--seeds", "0:1", "--out", tmp_path / "out")
    assert code == 0
    rows = json.loads(said)
    assert [row["schedule"] for row in rows] == ["entropy", "entropy", "learnt", "oracle"]
    assert rows[-1]["gap_closed"] in (1.0, None)
    assert {row["lead"] for row in rows} == {"balanced_success_rate"}
    for success in ("success", "balanced_success"):
        assert all(row[success] <= rows[-1][success] for row in rows)
    assert "balanced %" in (tmp_path / "out/index.html").read_text()


@pytest.mark.exhaustive
def test_schedules_are_compared_by_what_was_best_on_tune_layouts(
    stored: ReplayedRun, two_run: Path, harness: Callable[..., Any], tmp_path: Path
):
    tune = shutil.copytree(two_run, tmp_path / "tune")
    typed = ("study", "schedule", "compare", stored.run.path, "--schedule", "entropy")
    assert harness(*typed, "--tune", tune, "--quiet", "--out", tmp_path / "tuned")[0] == 0


@pytest.mark.slow
def test_the_same_twice(stored: ReplayedRun):
    once, twice = (
        compare(
            stored, None, SIXG, ["random", "learnt"], (0, 1), 0.5, counted([stored]), lambda n: None
        )
        for _ in range(2)
    )
    for name, plays in once.plays.items():
        assert [
            np.array_equal(a.costs, b.costs) for a, b in zip(plays, twice.plays[name], strict=True)
        ]


# -- learning --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def train(two_path: Path, tmp_path_factory: pytest.TempPathFactory) -> ReplayedRun:
    """A run on layouts that say that they are of train seeds."""
    folder = tmp_path_factory.mktemp("train")
    shutil.copytree(two_path, folder / "data")
    relabel(folder / "data", {0: 150_000, 1: 150_001})
    return ReplayedRun(run(spec_of(load(folder / "data")), folder / "run").out)


@pytest.mark.slow
def test_a_schedule_is_learnt_and_then_one_of_its_name(
    stored: ReplayedRun, train: ReplayedRun, harness: Callable[..., Any], tmp_path: Path
):
    (tmp_path / MARKER).touch()
    typed = (
        "study",
        "schedule",
        "learn",
        train.run.path,
        "--tune",
        stored.run.path,
        "--out",
        "schedules/mine.toml",
    )
    assert harness(*typed)[0] == 0
    text = toml(Path("schedules/mine.toml"), "it")
    assert text["learnt_from"] == [layouts(train, "train")]
    assert "2 layouts" in text["learnt_from"][0]
    mine = SCHEDULES["mine"]
    assert isinstance(mine, Learnt)
    assert mine.threshold == text["threshold"] == named_point("6g:schedule=mine").ask.above
    once = Path("schedules/mine.toml").read_text()
    code, _, err = harness(*typed)
    assert code == 2
    assert "is there already" in err
    Path("schedules/mine.toml").unlink()
    assert harness(*typed)[0] == 0
    assert Path("schedules/mine.toml").read_text() == once
    code, _, err = harness(
        "study", "schedule", "learn", stored.run.path, "--tune", stored.run.path, "--out", "x.toml"
    )
    assert code == 2
    assert "(tune), 4 layouts" not in err
    assert "give a run on train layouts" in err


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--condition", "single-local"], "no schedule changes anything: it has no channel"),
        (["--condition", "6g:max_helpers=0"], "no schedule changes anything: max_helpers is 0"),
        (["--condition", "6g:radius_m=0.1"], "at no decision point of the train runs is a helper"),
        (["--tune", "TUNE/../run"], "TUNE/../run is given twice; give each run once"),
        (["TRAIN"], "TRAIN is given twice; give each run once"),
    ],
)
def test_where_nothing_can_be_learnt_it_is_one_line(
    stored: ReplayedRun,
    train: ReplayedRun,
    harness: Callable[..., Any],
    more: list[str],
    says: str,
):
    def placed(text: str) -> str:
        return text.replace("TRAIN", str(train.run.path)).replace("TUNE", str(stored.run.path))

    typed = ("study", "schedule", "learn", train.run.path, "--tune", stored.run.path)
    code, _, said = harness(*typed, "--out", "none.toml", "--quiet", *map(placed, more))
    assert (code, said.count("\n")) == (2, 1)
    assert placed(says) in said
    assert not Path("none.toml").exists()


def test_a_network_learns_what_there_is_to_learn():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(400, 14))
    y = np.tanh(x[:, 0]) * 0.3 + 0.1
    network = fit(x, y)
    assert np.mean((network(x) - y) ** 2) < 0.02 * y.var()
    assert network(x[7]) == pytest.approx(network(x)[7])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"entropy", ', "", "has other inputs or sizes than the program; learn it again"),
        ("into = [[", "into = [[1.0, ", "has other inputs or sizes than the program"),
        ("bias = [", "bias = [1.0, ", "has other inputs or sizes than the program"),
        ("scale = [", "scale = [0.0, ", "allowed: a number from 1e-06 to 1e"),
        ("base = ", "base = 1e300 # ", "base = 1e.300; allowed: a finite number, of a size"),
    ],
)
def test_a_file_that_does_not_fit_is_one_line(
    old: str, new: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / MARKER).touch()
    shipped = find("schedules", "learnt.toml").read_text()
    (tmp_path / "schedules").mkdir()
    (tmp_path / "schedules/odd.toml").write_text(shipped.replace(old, new))
    with pytest.raises(UserError, match=said):
        named_point("6g:schedule=odd")


def test_a_run_pins_the_file_of_its_schedule(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / MARKER).touch()
    (tmp_path / "schedules").mkdir()
    mine, shipped = tmp_path / "schedules/mine.toml", find("schedules", "learnt.toml").read_text()
    mine.write_text(shipped)
    points = tuple(map(named_point, ("6g:schedule=mine", "6g:schedule=coverage")))
    out = run(spec_of(small, points=points), tmp_path / "run").out
    assert read(out).manifest.schedules == {"mine": sha256_file(mine)}
    (out / ".work").mkdir()
    mine.write_text(shipped.replace("threshold = 0.005", "threshold = 0.006"))
    with pytest.raises(UserError, match="was begun with another schedules"):
        run(spec_of(small, points=points), out)
    with pytest.raises(UserError, match="schedule mine has changed since; restore it or run again"):
        ReplayedRun(out)


def test_the_schedule_that_ships_says_what_it_was_learnt_and_tuned_on():
    shipped = toml(find("schedules", "learnt.toml"), "it")
    assert all("(train)" in source for source in shipped["learnt_from"])
    assert all("(tune)" in source for source in shipped["tuned_on"])


@pytest.mark.exhaustive
def test_joules_of_choices_are_those_of_the_runs_decisions(small: Dataset, tmp_path: Path):
    """Read-outs of the model that ships, at the pace of another on a Jetson."""
    computers = pytest.importorskip("harness.extensions.devices.timer")
    orin = computers.Computer(computers.profiles.load("agx-orin"), "qwen3-4b")
    spec = spec_of(
        small, "swarm-tiny", answer="readout", limit=1, points=(SIXG,), seeds=(0,),
        timer=orin,
    )  # fmt: skip
    done = run(spec, tmp_path / "run")
    [energy] = [
        score
        for score in done.scores
        if score.metric == "energy_j" and score.interval == "episodes"
    ]
    stored = ReplayedRun(done.out)
    every = made(stored, "6g")
    _, costs = every.played(every.scheduled(SIXG))
    joules, decisions = (costs[..., COSTS.index(name)] for name in ("energy_j", "decisions"))
    assert joules.sum() / decisions.sum() == pytest.approx(energy.value, abs=1e-4)
    assert np.isnan(
        made(ReplayedRun(run(spec_of(small), tmp_path / "other").out), "6g").levels[0].costs[..., 4]
    ).all()


@pytest.mark.slow
def test_a_model_is_opened_once_whatever_it_is_asked(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    opened: list[Any] = []
    out = run(spec_of(small, points=(POINTS["single-local"],)), tmp_path / "run").out
    (out / "answers.jsonl").write_bytes(
        b"".join((out / "answers.jsonl").read_bytes().splitlines(True)[:1])
    )

    def counting(card: Any, **options: Any) -> Any:
        opened.append(card.name)
        return open_backend(card, **options)

    monkeypatch.setattr("harness.studies.replayed_run.open_backend", counting)
    monkeypatch.setattr("harness.studies.replayed_run.sound", read)  # lacks what it was asked
    monkeypatch.setattr(asking, "CHUNK", 2)
    made(ReplayedRun(out), "6g")
    assert opened == ["proxy"]
