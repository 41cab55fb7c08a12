"""A language model whose answers are the same whatever it sees is called that."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from evaluating import run as evaluate
from evaluating import spec_of
from run_on_disk import configure

from harness.dataset.load import Dataset
from harness.report.caveats import causes
from harness.report.constancy import ignores_input, in_a_line, tile
from harness.runs import folder
from harness.runs.answers import Answers
from harness.runs.records import Answer


def said(dataset: Dataset, out: Path, model: str, engine: str | None = None) -> list[str]:
    """What is said of a run whose answers are those of a rule,
    with another engine in its record.
    """
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
        f"The model ignores its input: {action} is the likeliest action in {n} of the ego's {n} "
        "readable answers, and its probability moves by 0.000 (standard deviation) between them. "
        f"Without messages it drives as the driver `{driver}`, which needs no model."
    )


def test_nothing_is_said_of_who_looks_or_of_a_driver(small: Dataset, tmp_path: Path) -> None:
    assert said(small, tmp_path / "proxy", "proxy", "llama-cpp") == []
    assert said(small, tmp_path / "brake", "brake") == []


def test_who_holds_every_action_for_equally_likely_drives_as_uniform(
    small: Dataset, tmp_path: Path
) -> None:
    [sentence] = said(small, tmp_path / "run", "uniform", "llama-cpp")
    assert "SLOWER, IDLE, FASTER are equally likely in" in sentence
    assert sentence.endswith(
        "Without messages it drives as the driver `uniform`, which needs no model."
    )
    configure(tmp_path / "run", ties="first")
    [sentence] = ignores_input(folder.read(tmp_path / "run"))
    assert sentence.endswith("drives as the driver `brake`, which needs no model.")


def test_of_who_looks_a_line_and_a_figure_say_how_much_it_moves(
    small: Dataset, tmp_path: Path
) -> None:
    assert said(small, tmp_path / "run", "proxy", "llama-cpp") == []
    run = folder.read(tmp_path / "run")
    p = np.array([answer.intent for answer in run.answers if answer.role == "ego"])
    counts = np.bincount(p.argmax(axis=1))
    share, moves = 100 * counts.max() / len(p), p[:, counts.argmax()].std()
    [line] = in_a_line(run)
    action = run.actions[counts.argmax()]
    assert line == (
        f"ego answers: {action} is the likeliest action in {share:.0f} % of {len(p)}; its "
        f"probability moves by {moves:.2f} (standard deviation)"
    )
    [figure] = tile(run)
    assert (figure["value"], figure["n"]) == (f"{share:.0f} %", f"n = {len(p)} readable answers")


def test_of_a_rule_no_line_and_no_figure(small: Dataset, tmp_path: Path) -> None:
    assert said(small, tmp_path / "run", "proxy") == []
    run = folder.read(tmp_path / "run")
    assert [*in_a_line(run), *tile(run)] == []


def test_all_sentences_about_answers_take_one_pass(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said(small, tmp_path / "run", "proxy-faulty", "llama-cpp")
    run, passes = folder.read(tmp_path / "run"), 0
    through = Answers.__iter__

    def counted(answers: Answers) -> Iterator[Answer]:
        nonlocal passes
        passes += 1
        return through(answers)

    monkeypatch.setattr(Answers, "__iter__", counted)
    sentences = [*ignores_input(run), *causes(run), *in_a_line(run), *tile(run)]
    assert any("commonest cause" in str(sentence) for sentence in sentences)
    assert passes == 1
