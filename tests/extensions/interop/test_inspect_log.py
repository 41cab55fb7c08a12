"""`harness run export --inspect`: the log as Inspect AI itself reads it."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from evaluating import run as evaluate
from evaluating import spec_of
from run_on_disk import Row, answers_of, change, configure, made_up, rows_of

from harness.coordination.named_points import POINTS
from harness.core.files import digest
from harness.dataset.load import Dataset
from harness.runs.folder import read

inspect_log = pytest.importorskip("inspect_ai.log", reason="needs the inspect extra")

Said = tuple[int, str, str]
Harness = Callable[..., Said]
HOSTILE = "# no JSON <img src=x onerror=alert(1)> \x1b[31m"


@pytest.fixture(scope="module")
def run(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One helper's answer cannot be read;
    the ego gives success away at one point, in one seed of two.
    """
    spec = spec_of(small, prompt="v6", points=(POINTS["single-local"], POINTS["6g"]), seeds=(0, 1))
    done = evaluate(spec, tmp_path_factory.mktemp("inspect") / "run").out
    first = rows_of(done)[0]["scene"]

    def spoil(row: Row) -> None:
        if (row["scene"], row["viewer"]) == (first, "v2"):
            row |= {
                "raw": HOSTILE,
                "verdict": "failed",
                "status": "no_json",
                "intent": None,
                "message": None,
            }

    def lose(row: Row) -> None:
        if row["scene"] == first:
            row["regret"] = (row["condition"], row["seed"]) == ("6g", 1)

    change(done, decision=lose, answer=spoil)
    return done


def log_of(run: Path, harness: Harness, file: str = "run.eval") -> Any:
    code, out, err = harness("run", "export", run, "--inspect", file)
    assert (code, out, err) == (0, f"{file}\n", "")
    return inspect_log.read_eval_log(file)


@pytest.mark.parametrize("file", ["run.eval", "run.json"])
def test_a_sample_is_an_answer_with_its_prompt_and_scores(
    file: str, run: Path, harness: Harness
) -> None:
    log = log_of(run, harness, file)
    answers, rows = answers_of(run), rows_of(run)
    assert [sample.id for sample in log.samples] == [answer.id for answer in answers]
    for sample, answer in zip(log.samples, answers, strict=True):
        asked = [{"role": message.role, "content": message.text} for message in sample.input]
        assert digest(asked) == answer.prompt_sha256 == sample.metadata["prompt_sha256"]
        assert sample.output.completion == sample.messages[-1].text == answer.raw
        here = [row for row in rows if row["scene"] == answer.scene]
        assert sample.target == [a for a in ("SLOWER", "IDLE", "FASTER") if here[0][f"safe_{a}"]]
        decided = {
            f"regret {row['condition']}" for row in here if row["value"] and answer.role == "ego"
        }
        assert {*sample.scores} == {"parsed"} | decided
    ego, spoilt = log.samples[:2]
    assert ego.scores["regret 6g"].value == 0.5
    assert (
        ego.scores["regret 6g"].explanation == "1 of 2 seeds decide so that success is given away"
    )
    assert ego.scores["regret single-local"].value == 0
    assert (ego.scores["parsed"].value, ego.scores["parsed"].answer.split()[::2]) == (
        "C", ["SLOWER", "IDLE", "FASTER"],
    )  # fmt: skip
    assert (spoilt.scores["parsed"].value, spoilt.scores["parsed"].answer) == ("I", "failed")
    assert spoilt.output.completion == HOSTILE


def test_the_header_says_who_answered_what_and_what_came_out(run: Path, harness: Harness) -> None:
    log = log_of(run, harness)
    assert (log.status, log.eval.task, log.eval.model) == ("success", "small v6", "proxy/proxy")
    assert log.eval.task_args["prompt"]["version"] == "v6"
    assert log.eval.viewer.trust_content is False
    scores = {score.name: score.metrics for score in log.results.scores}
    for score in read(run).scores:
        if score.interval != "seed means" and score.value is not None:
            metric = scores[score.condition][score.metric]
            assert (metric.value, metric.metadata["n"]) == (pytest.approx(score.value), score.n)


def test_a_prompt_or_dataset_that_is_not_here_leaves_the_digest(
    tmp_path: Path, harness: Harness
) -> None:
    made_up(tmp_path / "run")
    configure(tmp_path / "run", prompt={"version": "mine", "sha256": "1" * 64, "released": False})
    for sample in log_of(tmp_path / "run", harness).samples:
        assert sample.input == f"a prompt that is not here, sha256 {'0' * 64}"


def test_a_kept_prompt_is_in_the_log_once_the_version_is_gone(
    tmp_path: Path, harness: Harness
) -> None:
    Path("swarmdrive.toml").touch()
    shutil.copytree(Path(__file__).parents[3] / "prompts" / "v6", "prompts/mine")
    typed = (
        "eval",
        "--model",
        "proxy",
        "--prompt",
        "mine",
        "--limit",
        "1",
        "--seeds",
        "0",
        "--quiet",
    )
    assert harness(*typed, "--condition", "6g", "--out", "run")[0] == 0
    shutil.rmtree("prompts")
    for sample in log_of(Path("run"), harness).samples:
        asked = [{"role": message.role, "content": message.text} for message in sample.input]
        assert digest(asked) == sample.metadata["prompt_sha256"]
    before = Path("run.eval").read_bytes()
    shutil.rmtree("run/sources")
    code, out, err = harness("run", "export", "run", "--inspect", "run.eval")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "run.eval is kept: a new page would lack its prompts" in err
    assert Path("run.eval").read_bytes() == before


def test_a_driven_run_has_no_regret(tmp_path: Path, harness: Harness) -> None:
    made_up(tmp_path / "driven", closed_loop=True)
    log = log_of(tmp_path / "driven", harness)
    assert len(log.samples) == len(answers_of(tmp_path / "driven"))
    assert all({*sample.scores} == {"parsed"} for sample in log.samples)
