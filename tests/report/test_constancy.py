"""A language model whose answers are the same whatever it sees is called that."""

import json
from pathlib import Path

import pytest
from evaluating import run as evaluate
from evaluating import spec_of

from harness.dataset.load import Dataset
from harness.report.constancy import ignores_input
from harness.runs import folder


def said(dataset: Dataset, out: Path, model: str, engine: str | None = None) -> list[str]:
    """What is said of a run whose answers are those of a rule, with another engine in its record."""
    evaluate(spec_of(dataset, model=model, seeds=(0,)), out)
    if engine:
        record = json.loads((out / "run.json").read_text())
        record["model"]["engine"] = engine
        (out / "run.json").write_text(json.dumps(record))
    return list(ignores_input(folder.read(out)))


@pytest.mark.parametrize(("driver", "action"), [("brake", "SLOWER"), ("cruise", "IDLE")])
def test_a_model_that_always_answers_the_same_drives_as_a_driver(
    driver: str, action: str, small: Dataset, tmp_path: Path
) -> None:
    [sentence] = said(small, tmp_path / "run", driver, "llama-cpp")
    n = sum(answer.role == "ego" for answer in folder.read(tmp_path / "run").answers)
    assert sentence == (
        f"The model ignores its input: {action} is the likeliest action in {n} of the ego's {n} readable "
        "answers, and its probability moves by 0.000 (standard deviation) between them. Without messages it "
        f"drives as the driver `{driver}`, which needs no model."
    )


def test_nothing_is_said_of_who_looks_or_of_a_driver(small: Dataset, tmp_path: Path) -> None:
    assert said(small, tmp_path / "proxy", "proxy", "llama-cpp") == []
    assert said(small, tmp_path / "brake", "brake") == []
