"""Who makes something of a run's intents reads the texts of its answers again."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import pytest
from evaluating import spec_of
from run_on_disk import Row, answers_of, damage

from harness.backends.registry import open_backend
from harness.core.errors import UserError
from harness.core.progress import Progress
from harness.dataset.load import load
from harness.evaluate.asking import Asker
from harness.evaluate.kept_answers import KeptAnswers, read_kept
from harness.evaluate.latency import PAPER
from harness.evaluate.run import read_or_evaluate
from harness.evaluate.texts import refuse_others
from harness.runs.folder import read
from harness.studies.replayed_run import MORE, ReplayedRun


@pytest.fixture
def run(two_run: Path, tmp_path: Path) -> Path:
    """A run that a test may change."""
    return Path(shutil.copytree(two_run, tmp_path / "run"))


def surer(row: Row) -> None:
    row["intent"] = (1.0, 0.0, 0.0)


def unread(row: Row) -> None:
    if row["role"] == "helper":
        row |= {"status": "no_json", "verdict": "failed", "intent": None}


def bolder(row: Row) -> None:
    if row["message"]:
        row["message"] = {**row["message"], "evidence": "nothing is there"}


def test_a_run_as_it_was_made_says_what_its_texts_say(run: Path) -> None:
    refuse_others(read(run))


@pytest.mark.parametrize(
    ("tamper", "field"), [(surer, "intent"), (unread, "status"), (bolder, "message")]
)
def test_what_no_text_says_is_refused(tamper: Callable[[Row], None], field: str, run: Path) -> None:
    damage(run, answer=tamper)
    with pytest.raises(UserError, match=rf"answer 0\S+ states another {field} than its text says;"):
        refuse_others(read(run))


def test_a_study_takes_no_intent_that_no_text_states(run: Path) -> None:
    ReplayedRun(run)
    damage(run, answer=surer)
    with pytest.raises(UserError, match="another intent than its text says"):
        ReplayedRun(run)


def test_nor_one_that_was_added_to_the_run_later(run: Path) -> None:
    first = msgspec.structs.replace(
        answers_of(run)[0], scene="00000-1-none", intent=(0.0, 0.0, 1.0)
    )
    (run / MORE).write_bytes(msgspec.json.encode(first) + b"\n")
    with pytest.raises(UserError, match="answer 00000-1-none/v1 states another intent"):
        ReplayedRun(run)


def test_nor_is_a_finished_run_of_a_study_read_back_so(two_path: Path, run: Path) -> None:
    damage(run, answer=surer)
    with pytest.raises(UserError, match="another intent than its text says"):
        read_or_evaluate(spec_of(load(two_path)), run, Progress(), None, open_backend)


def test_nor_does_a_run_go_on_from_one_that_was_kept(
    two_path: Path, run: Path, tmp_path: Path
) -> None:
    spec, file = spec_of(load(two_path)), tmp_path / "answers.jsonl"
    KeptAnswers(file).append(answers_of(run))
    going_on = partial(Asker, spec, lambda: open_backend(spec.ego.card), PAPER, kept=file)
    assert going_on().answers.keys() == {answer.id for answer in answers_of(run)}
    forged = msgspec.structs.replace(answers_of(run)[0], intent=(1.0, 0.0, 0.0))
    file.unlink()
    KeptAnswers(file).append([forged])
    with pytest.raises(UserError, match=f"{file}: answer {forged.id} states another intent than"):
        going_on()


def test_nor_from_one_with_two_answers_to_a_question(run: Path, tmp_path: Path) -> None:
    answer, file = answers_of(run)[0], tmp_path / "answers.jsonl"
    KeptAnswers(file).append([answer, answer])
    assert read_kept(file) == {answer.id: answer}
    KeptAnswers(file).append([msgspec.structs.replace(answer, raw=f" {answer.raw}")])
    with pytest.raises(UserError, match=f"has two answers to question {answer.id}; delete"):
        read_kept(file)
