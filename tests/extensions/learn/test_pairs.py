"""`harness run export --sft`: a run's questions, the answers that its trees ask for,
and training on them.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import run as evaluate
from evaluating import spec_of
from run_on_disk import ACTIONS, Row, answers_of, change, configure, damage, made_up, rows_of

from harness.coordination.named_points import POINTS
from harness.core.files import digest
from harness.dataset.load import Dataset, find, load
from harness.extensions.learn.training.lessons import Lessons, label
from harness.extensions.learn.training.pairs import pairs, preferences
from harness.extensions.learn.training.questions import question
from harness.parsing.parse import parse
from harness.parsing.status import Status
from harness.prompts import versions as prompts
from harness.runs.folder import read

pytestmark = pytest.mark.usefixtures("unrebuilt")

Said = tuple[int, str, str]
Harness = Callable[..., Said]


@pytest.fixture(scope="module")
def evaluated(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    spec = spec_of(small, prompt="v3", points=(POINTS["single-local"], POINTS["6g"]), seeds=(0,))
    done = evaluate(spec, tmp_path_factory.mktemp("pairs") / "run").out

    def merge(row: Row) -> None:
        """Where the last helper answered stands a fusion call with the others' messages."""
        if row["viewer"] == "v4":
            row |= {"viewer": "v1", "heard": ("v2", "v3"), "role": "merge"}
            shares(row, row["intent"])

    change(done, answer=merge)
    return done


def shares(row: Row, intent: Sequence[float]) -> None:
    """State an intent in an answer, and in its text alone."""
    text = json.dumps({"action_distribution": dict(zip(ACTIONS, intent, strict=True))})
    row |= {"intent": tuple(intent), "raw": text, "message": None, "mass": sum(intent)}


@pytest.fixture
def run(evaluated: Path, tmp_path: Path) -> Path:
    import shutil

    return shutil.copytree(evaluated, tmp_path / "run")


def test_a_question_has_the_goal_of_its_layout() -> None:
    crossing = load(find("sumo-crossing-v1")).of_episodes(frozenset({9}))
    [scene, *_] = scenes = tuple(crossing.scenes(crossing.courses()))
    prompt, level = prompts.load("v4"), np.full(5, 0.2)
    lessons = Lessons(crossing.scenario, (prompt,), scenes, {each.id: level for each in scenes})
    asked = question(lessons, scene, scene.viewers[0], prompt)
    task = crossing.scenario.at(crossing.seeds[0]).prompt_words["task"]
    assert task != crossing.scenario.prompt_words["task"]
    for messages in (asked.messages, asked.read_out):
        assert task in messages[0]["content"]


def unreadable(row: Row) -> None:
    row |= {"raw": "brake!", "status": "no_json", "verdict": "failed"}
    row |= {"intent": None, "mass": None, "message": None}


def lines_of(run: Path, harness: Harness, *options: str) -> list[dict[str, Any]]:
    code, out, err = harness("run", "export", run, "--sft", "pairs.jsonl", *options)
    assert (code, out, err) == (0, "pairs.jsonl\n", "")
    return [json.loads(line) for line in Path("pairs.jsonl").read_text().splitlines()]


def test_every_question_of_a_point_that_can_be_won_has_the_answer_of_its_tree(
    run: Path, harness: Harness
) -> None:
    lines = lines_of(run, harness)
    rows = {row["scene"]: row for row in rows_of(run)}
    answers = {(a.scene, a.key): a for a in answers_of(run)}
    actions = read(run).actions
    assert [(at["scene"], at["viewer"]) for at in lines] == [
        at for at in answers if rows[at[0]]["value"]
    ]
    assert {answers[at["scene"], at["viewer"]].role for at in lines} == {"ego", "helper", "merge"}
    for line in lines:
        row, asked = rows[line["scene"]], answers[line["scene"], line["viewer"]]
        if asked.role == "merge":
            assert "\nv2 " in line["prompt"][1]["content"].partition("\nMESSAGES ")[2]
        else:
            assert digest(line["prompt"]) == asked.prompt_sha256, "what the run asked, word by word"
        [said] = line["completion"]
        parsed = parse(
            said["content"], role="helper" if asked.role == "helper" else "ego", actions=actions
        )
        assert (said["role"], parsed.status) == ("assistant", Status.STRICT)
        ends_s = {a: row[f"delay_s_{a}"] if row[f"safe_{a}"] else float("inf") for a in actions}
        assert (line["actions"], line["probabilities"]) == ([*actions], label(ends_s).tolist())
        assert line["values"] == [float(row[f"safe_{a}"]) for a in actions]
        assert max(abs(parsed.intent - label(ends_s))) <= 0.05
        assert all(
            p == 0 for a, p in zip(actions, parsed.intent, strict=True) if not row[f"safe_{a}"]
        )
    assert {(line["layout_seed"], line["purpose"]) for line in lines} <= {
        (100 + n, "tune") for n in range(4)
    }


def test_a_read_out_is_answered_by_the_letter_of_the_best_action(run: Path) -> None:
    configure(run, answer="readout")
    change(run, answer=lambda row: shares(row, row["intent"]))
    rows = {row["scene"]: row for row in rows_of(run)}
    for pair in pairs(read(run)):
        assert pair["prompt"][-1]["content"].endswith(
            "\nAnswer with one letter: A SLOWER, B IDLE, C FASTER."
        )
        action = {"A": "SLOWER", "B": "IDLE", "C": "FASTER"}[pair["completion"][0]["content"]]
        assert rows[pair["scene"]][f"safe_{action}"]


def test_helpers_with_a_prompt_and_answer_mode_of_their_own_have_their_own_pairs(run: Path) -> None:
    model = json.loads((run / "run.json").read_text())["model"]
    prompt = {"version": "v1", "sha256": prompts.load("v1").sha256}
    configure(
        run, helpers=[{"model": model, "prompt": prompt, "answer": "readout", "thinking": False}]
    )
    change(run, answer=lambda row: row["role"] == "helper" and shares(row, row["intent"]))
    for pair in pairs(read(run)):
        system, user = (message["content"] for message in pair["prompt"])
        helps = pair["viewer"] in ("v2", "v3")
        assert user.endswith("Answer with one letter: A SLOWER, B IDLE, C FASTER.") == helps
        assert ("recommended_maneuver" in system) == helps, "what v1 asks a helper for"
        assert (len(pair["completion"][0]["content"]) == 1) == helps


def test_layouts_that_numbers_are_of_become_no_training_data_silently(
    run: Path, harness: Harness
) -> None:
    change(run, episode=lambda row: row.update(layout_seed=row["layout_seed"] + 199_897))
    assert "--dpo pairs.jsonl: " in harness("run", "export", run, "--dpo", "pairs.jsonl")[2]
    code, out, err = harness("run", "export", run, "--sft", "pairs.jsonl")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert (
        "has layout seeds 199997 to 200000 (train and report), and a model that learns from them"
        in err
    )
    assert err.endswith("or give --report-seeds-too\n")
    assert not Path("pairs.jsonl").exists()
    assert lines_of(run, harness, "--report-seeds-too")


@pytest.mark.slow
def test_report_layouts_that_a_run_calls_others_become_no_training_data(
    tmp_path: Path, harness: Harness
) -> None:
    report = load(find("occluded-intersection-v3"), limit=1)
    spec = spec_of(report, prompt="v3", points=(POINTS["single-local"],), seeds=(0,))
    done = evaluate(spec, tmp_path / "run").out
    change(done, episode=lambda row: row.update(layout_seed=row["layout_seed"] - 100_000))
    code, _, err = harness("run", "export", done, "--sft", "pairs.jsonl")
    assert (code, err.count("\n")) == (2, 1)
    assert "has layout seeds 200000 to 200000 (report)" in err
    assert not (tmp_path / "pairs.jsonl").exists()


@pytest.mark.parametrize(
    ("key", "said"), [("prompt", "prompt v3 with sha256 1111"), ("world", "is not the one that")]
)
def test_what_is_not_here_as_it_was_is_one_line(
    key: str, said: str, run: Path, harness: Harness
) -> None:
    stated = json.loads((run / "run.json").read_text())[key]
    configure(run, **{key: {**stated, "sha256": "1" * 64}})
    code, out, err = harness("run", "export", run, "--sft", "pairs.jsonl")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert not Path("pairs.jsonl").exists()


def test_a_run_whose_prompts_showed_pictures_is_one_line(run: Path, harness: Harness) -> None:
    stated = json.loads((run / "run.json").read_text())["prompt"]
    configure(run, prompt={**stated, "version": "v7", "sha256": prompts.load("v7").sha256})
    code, out, err = harness("run", "export", run, "--sft", "pairs.jsonl")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "showed pictures by prompt v7" in err
    assert not Path("pairs.jsonl").exists()


@pytest.mark.parametrize(
    ("name", "changed", "said"),
    [
        (
            "decision",
            {"scene": "x"},
            "decisions.parquet has scene 'x', which its dataset has not; make",
        ),
        ("answer", {"scene": "x"}, "answers.jsonl has scene 'x', which its dataset has not; make"),
        ("answer", {"viewer": "v9"}, "answers.jsonl has an answer of 'v9' in 00000-"),
    ],
)
def test_a_run_of_scenes_that_its_dataset_has_not_is_one_line(
    name: str, changed: Row, said: str, run: Path, harness: Harness
) -> None:
    scene = next(iter(read(run).decisions.scenes))
    here = {"scene": scene, **({"viewer": "v2"} if name == "answer" else {})}
    damage(run, **{name: lambda row: here.items() <= row.items() and row.update(changed)})
    code, out, err = harness("run", "export", run, "--sft", "pairs.jsonl", "--report-seeds-too")
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert said in err
    assert not Path("pairs.jsonl").exists()


def test_a_preference_is_not_made_of_an_intent_that_no_text_states(
    run: Path, harness: Harness
) -> None:
    damage(run, answer=lambda row: row.update(intent=(0.0, 0.0, 1.0)))
    code, out, err = harness("run", "export", run, "--dpo", "dpo.jsonl")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "states another intent than its text says; `harness eval --model replay:" in err
    assert not Path("dpo.jsonl").exists()


def test_a_driven_run_knows_no_best_action(tmp_path: Path, harness: Harness) -> None:
    made_up(tmp_path / "driven", closed_loop=True)
    code, _, err = harness("run", "export", "driven", "--sft", "pairs.jsonl")
    assert (code, err.count("\n")) == (2, 1)
    assert "driven was driven, and only frozen scenes know what each action leads to" in err


@pytest.mark.slow
def test_an_answer_is_rejected_where_it_is_worth_less_by_the_margin(
    run: Path, harness: Harness
) -> None:
    """Half on a lost action is worth .5 less; an unreadable answer is worth nothing;
    no answer is none.
    """

    def worse(row: Row) -> None:
        kind = sum(map(ord, row["scene"] + row["viewer"])) % 3
        if kind == 0 and row["role"] != "helper":
            shares(row, (0.5, 0.5, 0.0))
            return
        unreadable(row)
        if kind == 2:
            lost = {"raw": "", "error": "gone", "finish_reason": "error"}
            row |= {**lost, "status": "engine_error"}

    change(run, answer=worse)
    by_tree = {(line["scene"], line["viewer"]): line for line in pairs(read(run))}
    for margin, most in ((0.1, 0.9), (0.5, 0.5), (0.6, 0.4), (1, 0.0)):
        given = () if margin == 0.1 else ("--margin", str(margin))
        code, out, err = harness("run", "export", run, "--dpo", "dpo.jsonl", *given)
        assert (code, out, err) == (0, "dpo.jsonl\n", "")
        lines = [json.loads(line) for line in Path("dpo.jsonl").read_text().splitlines()]
        expected = set()
        for answer in answers_of(run):
            asked = by_tree.get((answer.scene, answer.key))
            if asked and answer.error is None:
                worth = sum(asked["values"][:2]) / 2 if answer.intent else 0
                if worth <= most:
                    expected.add((answer.scene, answer.key, answer.raw, worth))
        assert expected == {
            (at["scene"], at["viewer"], at["rejected"][0]["content"], at["value_rejected"])
            for at in lines
        }
        assert (len({at[2] for at in expected}) == 2) == (margin <= 0.5)
        for line in lines:
            asked = by_tree[line["scene"], line["viewer"]]
            assert (line["prompt"], line["chosen"]) == (
                [*map(dict, asked["prompt"])],
                asked["completion"],
            )


def test_a_rejected_letter_is_the_likeliest(run: Path) -> None:
    configure(run, answer="readout")
    change(run, answer=lambda row: shares(row, (0.2, 0.3, 0.5)))
    lines = [*preferences(read(run), 0.1)]
    assert {line["rejected"][0]["content"] for line in lines} == {"C"}
    assert all(line["values"][2] == line["value_rejected"] == 0 for line in lines)
    assert all(line["chosen"][0]["content"] in "AB" for line in lines)


@pytest.mark.slow
def test_a_model_learns_from_the_pairs(run: Path, harness: Harness, tmp_path: Path) -> None:
    """Steps as TRL takes them: the chat template over both, the loss of the completion alone."""
    torch = pytest.importorskip("torch", reason="needs the transformers extra")
    transformers = pytest.importorskip("transformers", reason="needs the transformers extra")
    from tiny_qwen3 import build

    lines = lines_of(run, harness)[:4]
    folder = build(tmp_path / "tiny", context_tokens=4096)
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    model = transformers.AutoModelForCausalLM.from_pretrained(folder)
    optimiser = torch.optim.AdamW(model.parameters(), lr=1e-3)

    def loss_of(line: dict[str, Any]) -> Any:
        asked = tokenizer.apply_chat_template(
            line["prompt"], tokenize=False, add_generation_prompt=True
        )
        whole = tokenizer.apply_chat_template(line["prompt"] + line["completion"], tokenize=False)
        assert whole.startswith(asked)
        ids, start = (tokenizer(text, return_tensors="pt").input_ids for text in (whole, asked))
        labels = ids.clone()
        labels[:, : start.shape[1]] = -100
        assert tokenizer.decode(ids[0, start.shape[1] :]).startswith(
            line["completion"][0]["content"]
        )
        return model(input_ids=ids, labels=labels).loss

    before = [loss_of(line).item() for line in lines]
    for line in lines:
        optimiser.zero_grad()
        loss_of(line).backward()
        optimiser.step()
    assert sum(loss_of(line).item() for line in lines) < sum(before)


@pytest.mark.exhaustive  # what the file holds, and that a model learns from it, are shown above
@pytest.mark.filterwarnings("default")
def test_trl_trains_on_the_file_as_it_is(run: Path, harness: Harness, tmp_path: Path) -> None:
    trl = pytest.importorskip("trl", reason="needs the trl extra")
    datasets = pytest.importorskip("datasets", reason="needs the trl extra")
    from tiny_qwen3 import build
    from transformers import AutoTokenizer

    lines = lines_of(run, harness)
    read_by = {"data_files": "pairs.jsonl", "split": "train", "cache_dir": tmp_path / "hf"}
    folder = build(tmp_path / "tiny", context_tokens=4096)
    trainer = trl.SFTTrainer(
        model=str(folder),
        processing_class=AutoTokenizer.from_pretrained(folder),
        train_dataset=datasets.load_dataset("json", **read_by),
        args=trl.SFTConfig(
            output_dir=str(tmp_path / "out"), max_steps=2, per_device_train_batch_size=2, use_cpu=True,
            bf16=False, max_length=4096, report_to="none",
        ),
    )  # fmt: skip
    assert len(trainer.train_dataset) == len(lines)
    assert trainer.train().global_step == 2


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("default")
def test_trl_prefers_by_the_file_as_it_is(run: Path, harness: Harness, tmp_path: Path) -> None:
    trl = pytest.importorskip("trl", reason="needs the trl extra")
    datasets = pytest.importorskip("datasets", reason="needs the trl extra")
    from tiny_qwen3 import build
    from transformers import AutoTokenizer

    change(run, answer=unreadable)
    assert harness("run", "export", run, "--dpo", "dpo.jsonl")[0] == 0
    read_by = {"data_files": "dpo.jsonl", "split": "train", "cache_dir": tmp_path / "hf"}
    folder = build(tmp_path / "tiny", context_tokens=4096)
    trainer = trl.DPOTrainer(
        model=str(folder),
        processing_class=AutoTokenizer.from_pretrained(folder),
        train_dataset=datasets.load_dataset("json", **read_by),
        args=trl.DPOConfig(
            output_dir=str(tmp_path / "out"), max_steps=1, per_device_train_batch_size=2, use_cpu=True,
            bf16=False, max_length=4096, report_to="none",
        ),
    )  # fmt: skip
    assert trainer.train().global_step == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), "--junit, --schema, --every-eval, --inspect, --sft, --dpo: give exactly one of them"),
        (
            ("--junit", "a.xml", "--report-seeds-too"),
            "--report-seeds-too only goes with --sft and --dpo; give one, or leave it out",
        ),
        (
            ("--csv", "--margin", "0.5"),
            "--margin 0.5: it goes with --dpo, and is above 0 and at most 1",
        ),
        (
            ("--sft", "a.jsonl", "--margin", "0.5"),
            "--margin 0.5: it goes with --dpo, and is above 0",
        ),
        (
            ("--dpo", "a.jsonl", "--margin", "0"),
            "--margin 0: it goes with --dpo, and is above 0 and at most",
        ),
        (
            ("--dpo", "a.jsonl", "--margin", "nan"),
            "--margin nan: it goes with --dpo, and is above 0",
        ),
        (
            ("--csv", "--dataset", "there"),
            "--dataset only goes with --every-eval, --inspect, --sft and --dpo; leave it out",
        ),
    ],
)
def test_options_that_do_not_go_together_are_one_line(
    options: tuple[str, ...], said: str, proxy_run: Path, harness: Harness
) -> None:
    code, out, err = harness("run", "export", proxy_run, *options)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
