"""`evaluate` with its real parts: twins that must agree, replay, and everything that is refused."""

import shlex
import shutil
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from evaluating import (
    FILES,
    all_scenes,
    course,
    decisions,
    figure,
    made,
    run,
    same_decisions,
    same_files,
    same_scores,
    scenes_of,
    spec_of,
    walked,
    with_ego,
)
from run_on_disk import UNTIMED, answers_of, rows_of

from harness.backends import cards
from harness.backends.card import Latency
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import Unanswered, UserError
from harness.dataset.load import Dataset, load
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.kept_answers import read_kept
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts
from harness.report import panels
from harness.runs.contradictions import contradictions
from harness.runs.export import decisions_csv
from harness.runs.folder import read
from harness.runs.records import Answer, FrozenScenes
from harness.runs.settings import words
from harness.world.drivers import DRIVERS

ALL = tuple(POINTS)


def without_company(answers: list[Answer]) -> list[Answer]:
    """Answers less what may differ with the batch:
    its size, and the seconds of an answer asked alone.
    """
    return [msgspec.structs.replace(answer, batch_size=0, **UNTIMED) for answer in answers]


# -- twins -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "batch_size", [3, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in (1, 64, 1000))]
)
def test_the_batch_size_changes_no_byte_of_the_proxys_run(
    batch_size: int, proxy_run: Path, small: Dataset, tmp_path: Path
) -> None:
    run(spec_of(small, batch_size=batch_size), tmp_path / "run")
    assert same_files(tmp_path / "run", proxy_run)


@pytest.mark.parametrize(
    ("trees", "walks", "workers"),
    [
        pytest.param(1, 99, 1, marks=pytest.mark.exhaustive),
        pytest.param(3, 99, 1, marks=pytest.mark.slow),
        pytest.param(1, 99, 2, marks=pytest.mark.exhaustive),
        pytest.param(9, 1, 1, marks=pytest.mark.exhaustive),
        pytest.param(1, 1, 2, marks=pytest.mark.slow),
    ],
)
def test_how_many_walks_are_taken_at_once_and_by_whom_changes_no_byte(
    trees: int, walks: int, workers: int, proxy_run: Path, small: Dataset, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("harness.evaluate.run.TREES_AT_ONCE", trees)
    monkeypatch.setattr("harness.evaluate.run.WALKS_AT_ONCE", walks)  # 1: one seed at a time
    answered, owed = list[int](), list[int]()
    evaluate(spec_of(small), tmp_path / "run", answered.append, more=owed.append, workers=workers)
    assert same_files(tmp_path / "run", proxy_run)
    assert sum(answered) == sum(owed) == len(answers_of(proxy_run))


@pytest.mark.slow
def test_decisions_in_row_groups_are_the_same_rows(
    proxy_run: Path, small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.evaluate.run.TREES_AT_ONCE", 1)
    monkeypatch.setattr("harness.runs.decisions.ROW_GROUP", 1)
    run(spec_of(small), tmp_path / "run")
    groups = pq.ParquetFile(tmp_path / "run" / "decisions.parquet").num_row_groups
    assert groups == len(small.episodes) > 1
    assert rows_of(tmp_path / "run") == rows_of(proxy_run)


@pytest.mark.slow
def test_a_table_that_stays_packed_reads_as_one_in_memory(
    proxy_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its row groups end within scenes, as those of a stranger's file may."""
    whole = read(proxy_run)
    out = Path(shutil.copytree(proxy_run, tmp_path / proxy_run.name))
    pq.write_table(whole.decisions.table, out / "decisions.parquet", row_group_size=41)
    monkeypatch.setattr("harness.runs.decisions.ROW_GROUP", 40)
    packed = read(out)
    a, b = whole.decisions, packed.decisions
    assert len(list(a.pieces())) == 1 < len(list(b.pieces())) == -(-len(a) // 41)
    order = np.random.default_rng(0).permutation(len(a))[:99]
    assert a.take(order).table.to_pylist() == b.take(order).table.to_pylist()
    assert a.row(45) == b.row(45)
    assert a.labels("helper_1") == b.labels("helper_1")
    assert a.scenes == b.scenes
    assert list(contradictions(packed)) == []
    for panel in (panels.reliability, panels.errors, panels.replies, panels.arrivals):
        assert panel(whole) == panel(packed)
    files = [
        decisions_csv(run.decisions, tmp_path / f"{n}.csv") for n, run in enumerate((whole, packed))
    ]
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real Qwen3 with random weights, whose context is too short for some prompts."""
    if find_spec("torch") is None or find_spec("transformers") is None:
        pytest.skip("needs the transformers extra")
    import tiny_qwen3

    return tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny", context_tokens=700)


def tiny_spec(tiny: Path, data: Dataset, **options: Any) -> Spec:
    card = replace(
        cards.resolve(str(tiny)),
        max_new_tokens=6,
        latency=Latency("card", 0.1, "declared: for this test"),
    )
    points = tuple(POINTS.values())
    source = FrozenSource(data)
    ego, device = Agent(card, prompts.load("v2")), {"device": "cpu", "dtype": "float32"}
    return made(ego, source, points=points, seeds=(0,), **device, **options)


@pytest.mark.exhaustive
def test_the_batch_size_changes_no_answer_of_a_language_model(
    tiny: Path, small_path: Path, tmp_path: Path
) -> None:
    data, runs, tables = load(small_path, limit=1), {}, {}
    for batch_size in (1, 3):
        spec = tiny_spec(tiny, data, batch_size=batch_size)
        done = walked(
            spec, open_backend(spec.ego.card, device="cpu", dtype="float32", batch_size=batch_size)
        )
        runs[batch_size], tables[batch_size] = (
            without_company(list(done.answers)),
            done.decisions.table,
        )
    assert runs[1] == runs[3]
    assert tables[1].equals(tables[3])
    assert {a.finish_reason for a in runs[1]} >= {"length", "error"}
    assert len({a.raw for a in runs[1]}) > 5, "answers that are all alike would show no order"


@pytest.mark.exhaustive
def test_prompts_that_are_too_long_for_the_model_got_no_answer(
    tiny: Path, small_path: Path, tmp_path: Path
) -> None:
    """The helpers' are: more of them than messages that may be lost."""
    spec = tiny_spec(tiny, load(small_path, limit=1))
    said = r"^context overflow: \d+ tokens > 700 .*: no answer to \d+ of \d+ questions to helpers"
    for _ in range(2):
        with pytest.raises(Unanswered, match=said):
            run(spec, tmp_path / "run")
    assert not (tmp_path / "run/run.json").exists()
    [kept] = (tmp_path / "run/.work").glob("episodes-*.jsonl")
    answers = read_kept(kept)
    assert answers
    assert {answer.finish_reason for answer in answers.values()} <= {"stop", "length"}


# -- replay ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("prompt", ["v1", "v2"])
def test_a_replay_makes_the_tables_of_the_run_it_replays(
    prompt: str, small: Dataset, tmp_path: Path
) -> None:
    first = run(spec_of(small, prompt=prompt), tmp_path / "run")
    again = run(spec_of(small, f"replay:{tmp_path / 'run'}", prompt), tmp_path / "again")
    assert same_record(tmp_path / "again", tmp_path / "run")
    assert same_scores(first, again)
    assert again.manifest.answerers == first.manifest.answerers


def same_record(one: Path, other: Path) -> bool:
    """Whether two runs have the same answers and decisions, whoever their model was."""
    answers = [(run / "answers.jsonl").read_bytes() for run in (one, other)]
    return answers[0] == answers[1] and same_decisions(one, other)


@pytest.mark.exhaustive
def test_a_replay_is_replayed(proxy_run: Path, small: Dataset, tmp_path: Path) -> None:
    run(spec_of(small, f"replay:{proxy_run}"), tmp_path / "a")
    run(spec_of(small, f"replay:{tmp_path / 'a'}"), tmp_path / "b")
    assert same_record(tmp_path / "b", proxy_run)


def refused(spec: Spec, out: Path) -> str:
    """What a run is refused with, after which nothing of it is there."""
    before = {p: p.read_bytes() for p in out.parent.rglob("*") if p.is_file()}
    with pytest.raises(UserError) as caught:
        run(spec, out)
    assert not out.exists()
    assert {p: p.read_bytes() for p in out.parent.rglob("*") if p.is_file()} == before
    message = str(caught.value)
    assert message.isprintable(), message
    return message


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"prompt": "v1"}, "/v1 with another prompt or dataset; replay it with that run's"),
        ({"thinking": True}, "was run with thinking off; leave --thinking out"),
        ({"answer": "constrained"}, "was run with --answer json; replay it with the same"),
        ({"answer": "readout"}, "was run with --answer json; replay it with the same"),
    ],
)
def test_a_replay_of_other_questions_is_refused(
    options: dict[str, Any], said: str, proxy_run: Path, small: Dataset, tmp_path: Path
) -> None:
    assert said in refused(spec_of(small, f"replay:{proxy_run}", **options), tmp_path / "out")


def test_a_replay_of_another_dataset_or_fewer_scenes_is_refused(
    proxy_run: Path, small: Dataset, small_path: Path, tmp_path: Path
) -> None:
    run(spec_of(load(small_path, limit=3)), tmp_path / "three")
    said = refused(spec_of(small, f"replay:{tmp_path / 'three'}"), tmp_path / "out")
    assert said.endswith(
        f"holds no answer for {small.scene('00003-0').id}/v1; replay a run of the same dataset and "
        "limit"
    )
    root, after = scenes_of(small)[:2]
    moved = root.changed(graphs=after.graphs)
    other = replace(small, _scenes={root.id: moved})
    assert "another prompt or dataset" in refused(
        spec_of(other, f"replay:{proxy_run}"), tmp_path / "out"
    )


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        (
            "answers.jsonl",
            None,
            "answers.jsonl is broken (No such file or directory); make the run again",
        ),
        (
            "run.json",
            None,
            "is no finished run: it has no run.json; give a folder made by `harness eval`",
        ),
        (
            "run.json",
            "{}",
            "run.json has format 'None', not 'swarmdrive-run/2'; give a folder made by",
        ),
        ("run.json", "[", "run.json is broken ("),
        ("answers.jsonl", "{}\n", "answers.jsonl is broken (Object missing required field"),
        ("answers.jsonl", "[]\n", "answers.jsonl is broken ("),
    ],
)
def test_a_replay_of_something_else_is_refused(
    file: str, content: str | None, said: str, proxy_run: Path, small: Dataset, tmp_path: Path
) -> None:
    shutil.copytree(proxy_run, tmp_path / "broken")
    if content is None:
        (tmp_path / "broken" / file).unlink()
    else:
        (tmp_path / "broken" / file).write_text(content)
    assert said in refused(spec_of(small, f"replay:{tmp_path / 'broken'}"), tmp_path / "out")


def test_a_broken_table_of_a_run_with_answers_is_named_with_its_remedy_once(
    proxy_run: Path, tmp_path: Path
) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(proxy_run, broken)
    (broken / "episodes.csv").write_text("condition\n")
    with pytest.raises(UserError) as caught:
        len(read(broken).decisions)
    remedy = f"--model replay:{broken} asks its model nothing"
    assert str(caught.value).startswith(f"{broken}/episodes.csv is broken (")
    assert str(caught.value).count(remedy) == 1


def test_a_drivers_run_is_not_replayed_but_run_again(small: Dataset, tmp_path: Path) -> None:
    run(spec_of(small, "local-view"), tmp_path / "driver")
    said = refused(spec_of(small, f"replay:{tmp_path / 'driver'}"), tmp_path / "out")
    assert said.endswith("is a run of a driver; run it again with --model local-view")


# -- refused, and nothing written ------------------------------------------------------------------


def test_a_folder_in_use_is_refused_and_left_as_it_is(
    proxy_run: Path, small: Dataset, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("all of it")
    file = tmp_path / "file"
    file.write_text("x")
    in_file = file / "run"
    for out, said in (
        (proxy_run, "already holds a finished run; choose another folder or delete it"),
        (other, "is a folder with other files in it; choose an empty or a new one"),
        (file, "is no folder; choose an empty or a new one"),
        (in_file, "cannot be made (Not a directory); choose another folder"),
    ):
        before = {p: p.read_bytes() for p in (*proxy_run.glob("*.*"), other / "thesis.tex", file)}
        with pytest.raises(UserError) as caught:
            run(spec_of(small), out)
        assert str(caught.value).endswith(said)
        assert {p: p.read_bytes() for p in before} == before


def test_an_empty_folder_is_a_fine_place(small: Dataset, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    run(spec_of(small, "cruise"), tmp_path / "empty")
    assert {p.name for p in (tmp_path / "empty").iterdir()} == {
        *FILES,
        "run.json",
        "run.toml",
        "sources",
    }


def test_a_model_that_cannot_be_had_leaves_nothing(small: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    pytest.importorskip("transformers", reason="needs the transformers extra")
    assert "no-such-model" in refused(spec_of(small, "nobody/no-such-model"), tmp_path / "out")
    (tmp_path / "hollow").mkdir()
    (tmp_path / "hollow" / "config.json").write_text("{}")
    assert "has no weights" in refused(spec_of(small, str(tmp_path / "hollow")), tmp_path / "out")


def test_a_prompt_that_does_not_render_some_scene_leaves_no_run(
    small: Dataset, tmp_path: Path
) -> None:
    """The template fails at the third step only.
    The answers until then have been paid for, and stay.
    """
    prompt = prompts.load("v2")
    text = prompt.texts["ego"].replace(
        "Distribution:", "{{ graph.step + (0 if graph.step < 2 else 'x') }}"
    )
    broken = replace(prompt, texts={**prompt.texts, "ego": text})
    with pytest.raises(UserError, match=r"prompt v2 ego\.j2 does not render"):
        run(with_ego(spec_of(small), prompt=broken), tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {".work"}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"seeds": ()}, "--seeds []: give one or more different whole numbers"),
        ({"seeds": (3, 3)}, "--seeds [3, 3]: give one or more different"),
        ({"batch_size": 0}, "--batch-size 0: give 1 or more"),
        ({"thinking": True}, "--thinking: proxy cannot think; leave it out"),
        (
            {"device": "cuda"},
            "--device cuda: proxy has no weights here (engines transformers",
        ),
        (
            {"dtype": "float32"},
            "--dtype float32: proxy has no weights here (engines transformers",
        ),
    ],
)
def test_settings_that_mean_nothing_are_refused(
    options: dict[str, Any], said: str, small: Dataset
) -> None:
    with pytest.raises(UserError) as caught:
        spec_of(small, **options)
    assert str(caught.value).startswith(said)


def test_a_served_model_thinks_where_its_card_says_so() -> None:
    card = cards.load("openai-example")
    assert Agent(card, prompts.load("v2"), thinking=True).thinking is True
    with pytest.raises(UserError, match="--thinking: openai-example cannot think; leave it out"):
        Agent(replace(card, thinking="none"), prompts.load("v2"), thinking=True)


def test_a_model_that_always_thinks_is_read_as_one_that_was_asked_to() -> None:
    card = replace(cards.load("qwen3-4b"), thinking="always")
    assert Agent(card, prompts.load("v2")).thinking is True
    assert Agent(cards.load("qwen3-4b"), prompts.load("v2")).thinking is False


# -- conditions ------------------------------------------------------------------------------------


def test_single_local_never_sends_and_hears_nobody(proxy_run: Path) -> None:
    alone = decisions(proxy_run, "single-local")
    assert len(alone) == 24 * 2
    for d in alone:
        assert (d.triggered, d.messages, d.own_weight) == (False, (), 1.0)
        assert d.latency_ms == 145.0


@pytest.mark.slow
def test_conditions_share_their_luck_so_more_loss_never_lets_more_through(
    small: Dataset, tmp_path: Path
) -> None:
    data = course(small)  # whatever is heard, all come to the same scenes
    losses = (0.0, 0.05, 0.3, 0.6, 1.0)
    points = tuple(OperatingPoint.of(f"loss-{x}", "6g", loss=x, tau_nats=0.0) for x in losses)
    run(spec_of(data, points=points, seeds=(0, 1, 2)), tmp_path / "run")
    heard = []
    for point in points:
        made = decisions(tmp_path / "run", point.name)
        assert all(len(d.messages) == 3 for d in made)
        heard.append([{m.sender for m in d.messages if m.delivered} for d in made])
    for clearer, worse in pairwise(heard):
        assert all(w <= c for c, w in zip(clearer, worse, strict=True))
    counts = [sum(map(len, by_name)) for by_name in heard]
    assert counts[0] == len(all_scenes(data)) * 3 * 3
    assert counts[0] > counts[1] > counts[2] > counts[3] > counts[4] == 0


def test_a_blocked_link_stays_blocked_for_its_episode_and_for_no_other(
    small: Dataset, tmp_path: Path
) -> None:
    point = OperatingPoint.of("half", "6g", loss=0.3, tau_nats=0.0)
    run(spec_of(small, points=(point,), seeds=tuple(range(5))), tmp_path / "run")
    up: dict[tuple[int, int, str], set[bool]] = {}
    for d in decisions(tmp_path / "run"):
        for m in d.messages:
            up.setdefault((d.episode, d.seed, m.sender), set()).add(m.delivered)
    assert all(len(states) == 1 for states in up.values())
    links = {key: states.pop() for key, states in up.items()}
    for kind in range(3):  # episodes, seeds and helpers each have luck of their own
        others = {key[:kind] + key[kind + 1 :] for key in links}
        along = [[links[k] for k in sorted(links) if k[:kind] + k[kind + 1 :] == o] for o in others]
        assert any(len(set(states)) == 2 for states in along)


@pytest.mark.slow
def test_the_luck_is_the_same_for_every_prompt_and_model(small: Dataset, tmp_path: Path) -> None:
    """Asked by a proxy with v1 or v2, a helper's link is up or down alike."""
    data = course(small)  # whatever is decided, both come to the same scenes
    point = OperatingPoint.of("half", "6g", loss=0.3, tau_nats=0.0)
    links = []
    for prompt in ("v1", "v2"):
        run(spec_of(data, prompt=prompt, points=(point,)), tmp_path / prompt)
        links.append(
            [
                [(m.sender, m.delivered) for m in d.messages]
                for d in decisions(tmp_path / prompt, "half")
            ]
        )
    assert links[0] == links[1]


@pytest.mark.parametrize(
    "driver",
    [
        "full-view",
        *(pytest.param(n, marks=pytest.mark.exhaustive) for n in DRIVERS if n != "full-view"),
    ],
)
def test_a_driver_decides_alike_in_every_condition_and_sends_nothing(
    driver: str, small: Dataset, tmp_path: Path
) -> None:
    done = run(spec_of(small, driver), tmp_path / "run")
    forest = small.forest
    course = forest.visited(forest.drivers[driver])
    chosen = [small.actions[i] for i in forest.drivers[driver][course]]
    for condition in ALL:
        for seed in (0, 1):
            made = [d for d in decisions(tmp_path / "run", condition) if d.seed == seed]
            assert [d.action for d in made] == chosen
            assert all((d.messages, d.latency_ms) == ((), 145.0) for d in made)
        assert figure(done, condition, "messages_per_episode").value == 0
    assert [a.id for a in answers_of(tmp_path / "run")] == [f"{forest.ids[n]}/v1" for n in course]
    succeeds = forest.driver_success(driver)
    assert figure(done, "6g", "success_rate").value == succeeds.mean()
    assert figure(done, "6g", "off_lag_rate").value == 0, "a driver takes the lag of the dataset"
    for metric in ("success_rate", "regret_rate", "brier", "entropy_nats"):
        assert len({figure(done, condition, metric).value for condition in ALL}) == 1
    assert figure(done, "6g", "success_gain_over_single-local").value == 0


@pytest.mark.slow
def test_the_driver_that_sees_everything_is_the_upper_reference(
    small: Dataset, tmp_path: Path
) -> None:
    best = run(spec_of(small, "full-view"), tmp_path / "full")
    worst = run(spec_of(small, "brake"), tmp_path / "brake")
    assert figure(best, "6g", "success_rate").value == 1.0
    assert figure(worst, "6g", "success_rate").value < 1.0


# -- the record ------------------------------------------------------------------------------------


def test_the_summary_can_be_made_again_from_the_decisions(proxy_run: Path) -> None:
    """Recounted with pandas, from nothing but `decisions.parquet`:
    the last decision tells the success.
    """
    table = pd.DataFrame([
        {"episode": d["episode"], "condition": d["condition"], "seed": d["seed"], "sent": d["messages"],
         "triggered": d["triggered"], "ms": d["latency_ms"], "missed": d["deadline_missed"],
         "entropy": d["entropy_nats"],
         "safe": d["safe"], "regret": d["regret"], "delay": d["delay_s"], "off_lag": d["off_lag"]}
        for d in rows_of(proxy_run)
    ]).astype({"regret": float, "off_lag": float})  # fmt: skip
    episodes = table.groupby(["condition", "seed", "episode"]).agg(
        sent=("sent", "sum"), triggered=("triggered", "mean"), ms=("ms", "mean"), missed=("missed", "mean"),
        entropy=("entropy", "mean"), success=("safe", "last"), regret=("regret", "mean"),
        delay=("delay", "mean"), off_lag=("off_lag", "mean"),
    )  # fmt: skip
    means = episodes.groupby(["condition", "episode"]).mean().groupby("condition").mean()
    summary = pd.read_csv(proxy_run / "summary.csv").query("interval == 'episodes'")
    figures = summary.set_index(["condition", "metric"]).value
    for condition in ALL:
        for column, metric in {
            "success": "success_rate", "sent": "messages_per_episode", "triggered": "trigger_rate",
            "ms": "latency_proxy_ms", "missed": "deadline_miss_rate", "entropy": "entropy_nats",
            "regret": "regret_rate", "delay": "delay_s", "off_lag": "off_lag_rate",
        }.items():  # fmt: skip
            assert figures[condition, metric] == pytest.approx(means[column][condition], abs=1e-3)


def test_the_episodes_table_agrees_with_the_decisions(proxy_run: Path) -> None:
    table = pd.read_csv(proxy_run / "episodes.csv", keep_default_na=False)
    assert len(table) == 4 * 3 * 2
    rows = rows_of(proxy_run)
    e: Any
    for e in table.itertuples():
        wanted = (e.episode, e.condition, e.seed)
        mine = [d for d in rows if (d["episode"], d["condition"], d["seed"]) == wanted]
        assert len(mine) == e.decisions
        assert e.messages == sum(d["messages"] for d in mine)
        assert e.deadline_misses == sum(d["deadline_missed"] for d in mine)
        regrets = [d["regret"] for d in mine if d["value"]]
        assert e.success == mine[-1]["safe"] == (regrets == [False] * len(mine))
        assert e.success or sum(regrets) == 1 or regrets == [], (
            "one decision lost it, or it was lost before"
        )
        assert (e.failure == "") == e.success
        cleared = e.failure in ("", "late")
        assert (e.delay_s != "") == cleared
        assert not cleared or e.success == (float(e.delay_s) <= 1.01)


def test_the_manifest_says_how_to_run_it_again(small_path: Path, tmp_path: Path) -> None:
    """Whatever the folder is called, a shell reads the command as it was meant."""
    out = tmp_path / "a run; rm -rf $HOME 'quoted'"
    done = run(spec_of(load(small_path, limit=2), limit=2), out)
    words = shlex.split(done.manifest.command)
    assert words[:2] == ["harness", "eval"]
    options = dict(zip(words[2::2], words[3::2], strict=True))
    assert options["--out"] == str(out)
    assert options["--limit"] == "2"
    assert isinstance(done.manifest.world, FrozenScenes)
    assert (done.manifest.world.limit, done.manifest.world.episodes) == (2, 2)


def test_a_model_folder_named_like_a_card_is_not_taken_for_the_card(
    small: Dataset, tmp_path: Path
) -> None:
    (tmp_path / "proxy").mkdir()
    (tmp_path / "proxy" / "config.json").write_text("{}")
    spec = spec_of(small, str(tmp_path / "proxy"))
    assert f"--model {tmp_path / 'proxy'} " in shlex.join(words(spec.settings))
