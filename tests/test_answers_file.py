"""Answers that another program wrote to a file: judged as if its model had been asked here."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from another_program import Line, answered, text_of, write
from evaluating import FILES, made, run, spec_of

from harness.backends import cards
from harness.backends.answers_file import AnswersFile, Question
from harness.backends.base import Completion, Request
from harness.coordination.named_points import named_point
from harness.core.errors import Unanswered, UserError
from harness.core.formats import QUESTIONS
from harness.core.work import tidy
from harness.dataset.load import Dataset, load
from harness.evaluate import questions
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.prompts import versions
from harness.runs import folder
from harness.studies.replayed_run import ReplayedRun

Harness = Callable[..., tuple[int, str, str]]
NOBODY = "a" * 64  # the id of no question


class Live:
    """The same model, asked here."""

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        texts = [text_of(request.role, request.messages) for request in requests]
        return [
            Completion(request.id, text, None, 30, "stop", 0.5, 1)
            for request, text in zip(requests, texts, strict=True)
        ]

    def identity(self) -> dict[str, Any]:
        return {"engine": "live"}


@pytest.fixture(scope="module")
def two(two_path: Path) -> Dataset:
    return load(two_path)


def spec(data: Dataset, file: Path, *conditions: str, **options: Any) -> Spec:
    ego = Agent(cards.of_answers("theirs", str(file)), versions.load("v1"))
    points = tuple(map(named_point, conditions))
    return made(ego, FrozenSource(data), points=points, seeds=(0,), **options)


FUSED = "6g:consensus=ego-prompt"


@pytest.mark.slow
def test_a_file_is_judged_as_if_its_model_had_been_asked_here(two: Dataset, tmp_path: Path) -> None:
    """In rounds: messages and scenes that follow from answers are asked once these are there."""
    file, out, lines = tmp_path / "answers.jsonl", tmp_path / "run", list[Line]()
    asked = spec(two, file, "single-local", FUSED, ask="all")
    for _ in range(13):  # two for each decision, and then there is nothing left
        write(file, lines)
        try:
            run(asked, out)
            break
        except Unanswered as error:
            said = str(error)
        new = answered(out)
        assert f"no answer to {len(new)} question" in said
        assert not {line["id"] for line in lines} & {line["id"] for line in new}
        assert [path.name for path in out.iterdir()] == [QUESTIONS]
        lines += new
    assert not (out / QUESTIONS).exists()
    evaluate(asked, tmp_path / "live", lambda done: None, opens=lambda card, **_: Live())
    tidy(tmp_path / "live")
    tables = [name for name in FILES if name != "decisions.parquet"]
    for name in tables:
        assert (out / name).read_bytes() == (tmp_path / "live" / name).read_bytes()
    ours, live = folder.read(out), folder.read(tmp_path / "live")
    assert ours.decisions.table.equals(live.decisions.table)
    assert any(answer.role == "merge" for answer in ours.answers)
    assert ours.manifest.model["engine"] == "answers-file"


@pytest.mark.slow
def test_what_a_dry_run_asks_is_typed_answered_and_scored(
    harness: Harness, two_path: Path, tmp_path: Path
) -> None:
    scenes = ("--dataset", two_path, "--seeds", "0", "--condition", "single-local")
    typed = ("eval", *scenes, "--prompt", "v1", "--model", "theirs", "--answers", "a.jsonl")
    code, said, err = harness(*typed, "--dry-run", "--out", "asked")
    assert (code, err) == (0, "")
    first = answered(Path("asked"))
    assert f"wrote {len(first)} questions to asked/{QUESTIONS}" in said
    write(Path("a.jsonl"), first)
    lines, code = first, 3
    while code == 3:
        code, said, err = harness(*typed, "--out", "r", "--verbose")
        if code == 3:
            lines = lines + answered(Path("r"))
            write(Path("a.jsonl"), lines)
    assert (code, err) == (0, "")
    assert "came from a file that another program wrote: no model was asked here" in " ".join(
        said.split()
    )
    assert "answers took 500.0 ms" in said
    assert "as their file states; not used as latency" in " ".join(said.split())
    page = Path("r/report.html").read_text()
    assert "came from a file that another program wrote" in page
    code, said, _ = harness("run", "check", "r")
    assert (code, "equal" in said) == (0, True)
    [whose] = ReplayedRun(Path("r")).caveats
    assert "came from a file that another program wrote: no model was asked here" in whose
    again = harness("eval", "r", "--out", "again")
    assert again[2] == (
        "harness: settings r/run.toml: a.jsonl is a file of answers, and a file opens no other by "
        "itself; if you want it, type `harness eval r/run.toml --answers a.jsonl`\n"
    )


REFUSED = {
    "that is no JSON": (b"{", "line 1 is no answer (Input data was truncated)"),
    "deep": (b"[" * 100_000, "line 1 is no answer (Expected `object`, got `array`)"),
    "not UTF-8": (b'{"id": "\xff"}', "line 1 is no answer"),
    "half a character": (
        b'{"id": "%s", "text": "\\ud800"}' % NOBODY.encode(),
        "line 1 is no answer",
    ),
    "an id of another kind": (b'{"id": "\\u001b", "text": ""}', "line 1 is no answer"),
    "neither text nor error": (b'{"id": "%s"}' % NOBODY.encode(), "give a text or an error"),
    "unknown keys": (b'{"id": "%s", "text": "", "x": 1}' % NOBODY.encode(), "unknown field `x`"),
    "less than no tokens": (b'{"id": "%s", "text": "", "tokens": -1}' % NOBODY.encode(), "`int`"),
    "a year": (b'{"id": "%s", "text": "", "seconds": 3e7}' % NOBODY.encode(), "`float`"),
    "twice": (
        b'{"id": "%s", "text": ""}\n{"id": "%s", "text": "b"}' % ((NOBODY.encode(),) * 2),
        f"line 2 answers {NOBODY} once more; give one answer to each id",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_line_that_is_no_answer_is_named(tmp_path: Path, name: str) -> None:
    content, why = REFUSED[name]
    file = tmp_path / "a.jsonl"
    file.write_bytes(content)
    with pytest.raises(UserError) as refused:
        AnswersFile(file)
    message = str(refused.value)
    assert why in message
    assert message.isprintable()


def test_an_answer_to_no_question_and_one_with_too_few_tokens_are_named(
    two: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "a.jsonl", tmp_path / "out"
    asked = spec(two, file, "single-local")
    write(file, [{"id": NOBODY, "text": "yes"}])
    with pytest.raises(Unanswered):
        questions.settle(asked, out)
    assert (
        f"1 answer to what is not asked here, by this prompt in these scenes, the first {NOBODY}"
        in capsys.readouterr().err
    )
    [first, *_] = answered(out)
    write(file, [{**first, "tokens": 1}])
    with pytest.raises(UserError, match=rf"answer {first['id']} states 1 tokens of a text"):
        questions.settle(asked, out)


def left_of(asked: Spec, out: Path) -> list[Line]:
    """The lines that answer the questions which are left."""
    try:
        questions.settle(asked, out)
    except Unanswered:
        return answered(out)
    return []


def test_what_was_not_answered_is_no_answer(two: Dataset, tmp_path: Path) -> None:
    """The ego's question is left; of helpers' a few count as lost messages, as at a server."""
    file, out = tmp_path / "a.jsonl", tmp_path / "out"
    asked = spec(two, file, "6g", ask="all")
    lines = list[Line]()
    write(file, lines)
    while new := left_of(asked, out):
        lines += new
        write(file, lines)
    assert not (out / QUESTIONS).exists()
    roles = {q.id: q.content["role"] for q in questions.first(asked, two).values()}
    helpers = [n for n, line in enumerate(lines) if roles.get(line["id"]) == "helper"]
    egos = [n for n, line in enumerate(lines) if roles.get(line["id"]) == "ego"]

    def without(*places: int) -> list[str]:
        some = list(lines)
        for n in places:
            some[n] = {"id": lines[n]["id"], "error": "it refused"}
        write(file, some)
        return [line["id"] for line in left_of(asked, out)]

    assert without(egos[0]) == [lines[egos[0]]["id"]]
    with pytest.raises(Unanswered, match="; correct the 1 line there that say error, add a line"):
        run(asked, out)
    assert without(helpers[0]) == []
    left = without(*helpers)
    assert set(left) & {lines[n]["id"] for n in helpers}


def test_a_question_is_its_content(two: Dataset, tmp_path: Path) -> None:
    asked = spec(two, tmp_path / "a.jsonl", "6g")
    [first, *others] = questions.first(asked, two).values()
    line = json.loads(first.line())
    assert list(line) == ["id", "role", "messages", "schema", "max_tokens", "thinking"]
    assert line["schema"]["required"] == ["action_distribution"]
    assert first.id not in {other.id for other in others}
    other_prompt = spec_of(two, prompt="v2", points=(named_point("6g"),), seeds=(0,))
    assert not {first.id, *(o.id for o in others)} & questions.first(other_prompt, two).keys()
    assert isinstance(first, Question)


def test_rounds_go_on_in_the_folder_of_their_own_and_no_file_is_taken_for_one(
    harness: Harness, two_path: Path
) -> None:
    scenes = ("--dataset", two_path, "--limit", "1", "--condition", "single-local")
    typed = ("eval", *scenes, "--prompt", "v1", "--model", "theirs", "--answers", "a.jsonl")
    Path("a.jsonl").touch()
    for _ in range(2):
        code, _, err = harness(*typed)
        assert (code, "no answer to 1 question, " in err) == (3, True)
    [own] = Path("reports").iterdir()
    assert [path.name for path in own.iterdir()] == [QUESTIONS]
    code, _, err = harness(*typed, "--dry-run", "--quiet", "--out", "a.jsonl")
    assert (code, err) == (2, "harness: --out a.jsonl is no folder; give another name\n")


def test_questions_with_pictures_are_not_written_without_them(
    two_path: Path, harness: Harness
) -> None:
    typed = ("eval", "--model", "swarm-tiny-vl", "--prompt", "v8", "--dataset", two_path)
    code, out, err = harness(*typed, "--dry-run", "--out", "asked")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "--out: prompt v8 shows a picture, and questions are written as text" in err
    assert not Path("asked").exists()


OPTIONS = {
    (): "name what answered, such as --model my-model",
    ("--model", "m", "--engine", "openai"): "no engine answers here; leave --engine out",
    ("--model", "m", "--latency", "measured"): "no answer of a file is timed here",
    ("--model", "m", "--prompt", "v7"): "prompt v7 shows a picture",
    ("--model", "m", "--answer", "readout"): "m cannot answer so; use json",
    ("--model", "m\x1b"): "has characters that nothing can show",
    ("--model", "m"): "cannot be read (No such file or directory)",
}


@pytest.mark.parametrize("typed", OPTIONS)
def test_what_does_not_go_with_a_file_is_refused(
    harness: Harness, two_path: Path, typed: tuple[str, ...]
) -> None:
    code, out, err = harness("eval", "--dataset", two_path, "--answers", "none.jsonl", *typed)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert OPTIONS[typed] in err
