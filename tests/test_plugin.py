"""The seams from outside: `tests/plugin`, installed beside the harness,
adds one of each kind of plug-in.

Commands run as typed, in processes of their own: one that has the package, for most of them, and
one that has not. This one only reads what they wrote and said.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from packaged import install

import harness
from harness.dataset.load import Dataset
from harness.runs.tables import Tables

CARD = """engine = "cautious"
description = "Slows down where it sees a conflict"
[latency]
source = "card"
inference_s = 0.01
basis = "declared: for this test"
"""
SMOOTHED, FOG_SMOOTHED, CLOSE = (
    "6g:consensus=smoothing",
    "fog:consensus=smoothing",
    "fog:radius_m=60",
)
MUMBLED, NEAREST = "6g:attack=mumble:share=1", "6g:schedule=near,max_helpers=1"
FROZEN = ("single-local", "6g", SMOOTHED, "fog", FOG_SMOOTHED, CLOSE, MUMBLED, NEAREST)
DRIVEN = (SMOOTHED, FOG_SMOOTHED)
ACTIONS, PLACES = ("SLOWER", "IDLE", "FASTER"), (1, 2, 3)

Words = tuple[str, ...]
# What is typed, and what is said of it.
MISTAKES: dict[Words, str] = {
    ("--condition", "fogg"): "unknown operating point 'fogg'; did you mean 'fog'? known: 6g, ",
    (
        "--condition",
        "fog:loss=0",
    ): "loss is 0.0; it must be left out: channel profile fog has no such",
    ("--condition", "6g:consensus=smooth"): "unknown consensus 'smooth'; did you mean 'smoothing'?",
}
NAMES: dict[Words, str] = {
    ("--condition", "fog"): "unknown operating point 'fog'; known: 6g, ",
    ("--model", "mine"): "unknown engine in model card",
}
# Types commands one after the other, and writes down how each ended and what it said.
TYPES = """
import contextlib, io, json, sys
from harness import cli
from harness.studies import study
study.DRAWN = ("svg",)  # of which others take longest
told = []
for words in json.load(sys.stdin):
    sys.argv = ["harness", *words]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as ended:
            told.append((ended.code or 0, out.getvalue(), err.getvalue()))
json.dump(told, sys.stdout)
"""

pytestmark = pytest.mark.slow


class Said(NamedTuple):
    """How a command ended, and what it said."""

    code: int
    out: str
    err: str


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with a card of the package's engine; beside it lies the package."""
    folder = tmp_path_factory.mktemp("plugged-in") / "project"
    (folder / "models").mkdir(parents=True)
    (folder / "swarmdrive.toml").touch()
    (folder / "models" / "mine.toml").write_text(CARD)
    install(folder.parent / "site")
    return folder


@pytest.fixture(scope="module")
def with_package(project: Path, small_path: Path) -> dict[Words, Said]:
    """What is typed where the package is installed: two runs, a sweep, a report and mistakes."""
    evaluated = ("eval", "--model", "mine", "--dataset", str(small_path), "--limit", "2")
    driven = ("drive", "--model", "mine", "--episodes", "2", "--seeds", "0:2", "--out", "driven")
    over = (
        "--over",
        "consensus",
        "--grid",
        "linear,smoothing",
        "--condition",
        "6g",
        "--condition",
        "fog",
    )
    lines = [
        (*evaluated, *conditions(FROZEN), "--tracker", "notebook", "--out", "frozen"),
        (*driven, *conditions(DRIVEN)),
        ("study", "sweep", "frozen", *over, "--quiet"),
        ("report", "driven", "--out", "driven.html"),
    ]
    wrong = [("eval", "--model", "mine", *words) for words in MISTAKES]
    told = typed(project, [*lines, *wrong], package=True)
    assert [told[line].code for line in lines] == [0] * len(lines), told
    return told


@pytest.fixture(scope="module")
def without_package(project: Path, with_package: dict[Words, Said]) -> dict[Words, Said]:
    """What is typed there once the package is gone: a report, and its names."""
    report = ("report", "frozen", "--out", "frozen.html")
    return typed(project, [report, *(("eval", *words) for words in NAMES)], package=False)


@pytest.fixture(scope="module")
def frozen(project: Path, with_package: dict[Words, Said]) -> Tables:
    return harness.load(project / "frozen")


@pytest.fixture(scope="module")
def driven(project: Path, with_package: dict[Words, Said]) -> Tables:
    return harness.load(project / "driven")


def conditions(names: Words) -> list[str]:
    return [f"--condition={name}" for name in names]


def typed(project: Path, lines: list[Words], *, package: bool) -> dict[Words, Said]:
    """What commands say that are typed one after the other, in one process."""
    site = [str(project.parent / "site")] if package else []
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([*site, str(Path(__file__).parents[1])])
    }
    command = [sys.executable, "-c", TYPES]
    done = subprocess.run(
        command, cwd=project, env=environment, input=json.dumps(lines), capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = [Said(*each) for each in json.loads(done.stdout)]
    return dict(zip(lines, told, strict=True))


def decided(run: Tables, condition: str) -> pd.DataFrame:
    """The decisions under a condition, each episode's in their order."""
    found = run.decisions[run.decisions.condition == condition]
    return found.sort_values(["seed", "episode", "step"], ignore_index=True)


def replies(decisions: pd.DataFrame) -> pd.DataFrame:
    """A row a message of these decisions."""
    names = ("helper", "delivered", "on_time", "arrival_ms", "weight")
    parts = [
        decisions[["scene", "seed", *(f"{name}_{n}" for name in names)]].set_axis(
            ["scene", "seed", *names], axis=1
        )
        for n in PLACES
    ]
    return (
        pd.concat(parts)
        .dropna(subset="helper")
        .astype({"scene": str, "helper": str, "delivered": bool})
    )


def smoothed(run: Tables, decisions: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """What smoothing makes of the answers, and the linear pool, (n, A):
    by hand, decision by decision.
    """
    said = {
        (answer.scene, answer.viewer): np.array(
            [getattr(answer, f"intent_{action}") for action in ACTIONS]
        )
        for answer in run.answers.itertuples()
    }
    memory: dict[tuple[int, int], np.ndarray] = {}
    policies, pools = [], []
    for row in decisions.to_dict("records"):
        heard = [n for n in PLACES if row[f"on_time_{n}"] is True]
        own = said[row["scene"], "v1"]
        now = row["own_weight"] * own
        for n in heard:
            now = now + row[f"weight_{n}"] * said[row["scene"], row[f"helper_{n}"]]
        episode = row["seed"], row["episode"]
        memory[episode] = now if row["step"] == 0 else (now + memory[episode]) / 2
        policies.append(memory[episode] if heard else own)
        pools.append(now)
    return np.array(policies), np.array(pools)


def test_the_hook_is_told_of_the_run(frozen: Tables, project: Path):
    begin, *answered, end = (project / "noted.txt").read_text().splitlines()
    assert (begin, end) == ("begin mine", "end frozen")
    assert answered[-1] == f"answered {len(frozen.answers)}"


def test_the_backend_answers_by_its_rule_on_what_each_viewer_sees(frozen: Tables, small: Dataset):
    assert frozen.config["identity"] == {"engine": "cautious", "answers": 1, "version": 1}
    asked = small.scenes(frozen.answers.scene.unique().tolist())
    graphs = {scene.id: scene.graphs for scene in asked}
    answers = frozen.answers
    assert sum(answers.role == "ego") == len(graphs)
    wary = np.array(
        [bool(graphs[str(a.scene)][str(a.viewer)].conflicts) for a in answers.itertuples()]
    )
    assert 0 < wary.sum() < len(wary)
    expected = np.where(wary[:, None], (0.6, 0.3, 0.1), (0.2, 0.4, 0.4))
    assert answers[[f"intent_{action}" for action in ACTIONS]].to_numpy() == pytest.approx(expected)
    assert set(answers.status) == {"strict"}


@pytest.mark.parametrize("condition", DRIVEN)
@pytest.mark.parametrize("kind", ["frozen", "driven"])
def test_the_rule_remembers_from_step_to_step(
    kind: str, condition: str, request: pytest.FixtureRequest
):
    run: Tables = request.getfixturevalue(kind)
    decisions = decided(run, condition)
    policies, pools = smoothed(run, decisions)
    fused = decisions[[f"fused_{action}" for action in ACTIONS]].to_numpy()
    assert fused == pytest.approx(policies, abs=5e-6)
    assert np.abs(policies - pools).max() > 0.05, "it is no linear pool"


def test_the_channel_takes_its_time_and_loses_with_distance(frozen: Tables, small: Dataset):
    """An answer takes 10 ms, its way 10 ms more; one transmission is lost with 1 % a metre."""
    asked_scenes = small.scenes(frozen.answers.scene.unique().tolist())
    range_m = {(s.id, v): known_m for s in asked_scenes for v, known_m in s.record.range_m.items()}
    for condition, farthest_m in (("fog", 100.0), (CLOSE, 60.0)):
        decisions = decided(frozen, condition)
        sent = replies(decisions)
        assert sent.delivered.any()
        assert not sent.delivered.all()
        assert set(sent.arrival_ms[sent.delivered]) == {20.0}
        sent["range_m"] = [range_m[place] for place in zip(sent.scene, sent.helper, strict=True)]
        assert sent.range_m.max() <= farthest_m
        asked = decisions[decisions.messages > 0].set_index(["scene", "seed"])
        mean_m = sent.groupby(["scene", "seed"]).range_m.mean()
        assert asked.effective_loss.to_dict() == pytest.approx((0.01 * mean_m).to_dict(), abs=1e-6)
        assert set(asked.latency_ms) == {20.0}


def test_what_crosses_the_fog_crosses_a_better_channel_by_the_same_luck(frozen: Tables):
    """In the decision points to which both come: a lost message may lead elsewhere."""
    key = ["scene", "seed", "helper"]
    both = replies(decided(frozen, "fog")).merge(
        replies(decided(frozen, "6g")), on=key, suffixes=("_fog", "_clear")
    )
    fog, clear = (both.filter(like=f"_{name}").rename(columns=lambda c: c.rpartition("_")[0])
                  for name in ("fog", "clear"))  # fmt: skip
    assert len(both) > 30
    assert (clear.delivered | ~fog.delivered).all()
    assert fog.delivered.sum() < clear.delivered.sum()


def test_helpers_that_mumble_are_half_as_sure(frozen: Tables):
    """The linear pool of what the ego intends and of what helpers do, halfway to a third each."""
    said = {
        (a.scene, a.viewer): np.array([getattr(a, f"intent_{action}") for action in ACTIONS])
        for a in frozen.answers.itertuples()
    }
    heard = 0
    for row in decided(frozen, MUMBLED).to_dict("records"):
        there = [n for n in PLACES if row[f"on_time_{n}"] is True]
        policy = (row["own_weight"] if there else 1.0) * said[row["scene"], "v1"]
        for n in there:
            policy = (
                policy + row[f"weight_{n}"] * (said[row["scene"], row[f"helper_{n}"]] + 1 / 3) / 2
            )
        assert [row[f"fused_{action}"] for action in ACTIONS] == pytest.approx(policy, abs=5e-6)
        heard += len(there)
    assert heard > 30


def test_the_nearest_helper_within_half_the_way_is_asked(frozen: Tables, small: Dataset):
    known_m = {
        scene.id: scene.record.range_m
        for scene in small.scenes(frozen.answers.scene.unique().tolist())
    }
    decisions, asked = decided(frozen, NEAREST), 0
    sent = replies(decisions)
    assert sent.groupby(["scene", "seed"]).size().max() == 1
    asked_there = {(row.scene, row.seed): row.helper for row in sent.itertuples()}
    for row in decisions.to_dict("records"):
        helper, range_m = min(known_m[row["scene"]].items(), key=lambda pair: pair[1])
        assert asked_there.get((row["scene"], row["seed"])) == (helper if range_m < 50 else None)
        asked += range_m < 50
    assert 0 < asked < len(decisions)


def test_the_metric_is_in_the_summary(frozen: Tables):
    table = frozen.summary[
        (frozen.summary.metric == "sure_rate") & (frozen.summary.interval == "episodes")
    ]
    decisions = frozen.decisions[frozen.decisions.condition == "fog"]
    by_episode = (
        (decisions.normalised_entropy < 0.5).groupby([decisions.seed, decisions.episode]).mean()
    )
    assert table[table.condition == "fog"].value.item() == pytest.approx(
        by_episode.mean(), abs=1e-6
    )


def test_a_sweep_plays_the_rule_on_what_is_stored(project: Path, frozen: Tables):
    table = pd.read_csv(project / "frozen" / "sweep-consensus" / "conditions.csv")
    swept = table.set_index(["condition", "value", "metric", "interval"])["mean"].sort_index()
    own = frozen.summary.set_index(["condition", "metric", "interval"]).value.sort_index()
    for name, point in (("6g", SMOOTHED), ("fog", FOG_SMOOTHED)):
        for value, condition in (("linear", name), ("smoothing", point)):
            played = swept[name, value]
            assert played.to_dict() == pytest.approx(own[condition][played.index].to_dict())
    success = swept["fog", :, "success_rate", "episodes"]
    assert success["linear"] != success["smoothing"]


def test_a_report_of_a_run_needs_no_package(
    project: Path, with_package: dict[Words, Said], without_package: dict[Words, Said]
):
    told = with_package | without_package
    for kind in ("driven", "frozen"):
        assert told["report", kind, "--out", f"{kind}.html"].code == 0
        page = (project / f"{kind}.html").read_text()
        assert all(name in page for name in ("mine", "cautious", SMOOTHED, "fog"))


@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_is_one_line_that_knows_the_package(
    words: Words, with_package: dict[Words, Said]
):
    code, _, message = with_package["eval", "--model", "mine", *words]
    assert code == 2
    assert MISTAKES[words] in message
    assert message.count("\n") == 1


@pytest.mark.parametrize("words", NAMES)
def test_without_the_package_its_names_mean_nothing(
    words: Words, without_package: dict[Words, Said]
):
    code, _, message = without_package["eval", *words]
    assert code == 2
    assert NAMES[words] in message
    assert message.count("\n") == 1
