"""What a model check finds out, where it is kept, and which pages say it."""

import json
from pathlib import Path
from typing import Any

import pytest
from evaluating import run as made
from evaluating import spec_of
from msgspec.structs import replace

from harness.backends import cards
from harness.backends.base import Completion, Request
from harness.core import kept
from harness.dataset.load import Dataset
from harness.evaluate.agent import Agent
from harness.extensions.checkups.read_outs import (
    COUNT,
    Findings,
    Moved,
    examine,
    keep_findings,
    recall_findings,
)
from harness.prompts import versions
from harness.report.caveats import by_letter
from harness.report.findings import findings
from harness.runs.folder import Run
from harness.runs.records import Manifest, Score

CARD = cards.resolve("qwen3-4b")
AGENT = Agent(CARD, versions.load("v2"))
AGAIN = 2 * 8  # halves of pairs of scenes that are asked with letters read the other way


class Model:
    """Reads out as a rule says: `p` gives the likelihood of SLOWER or YES from the text of a
    question.
    """

    def __init__(self, p: Any) -> None:
        self.p, self.asked = p, 0

    def complete(self, requests: Any) -> list[Completion]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Completion:
        self.asked += 1
        first, *others = request.actions
        p = self.p(request.messages[-1]["content"], bool(request.orders))
        text = json.dumps(
            {"action_distribution": {first: p, **{a: (1 - p) / len(others) for a in others}}}
        )
        more: dict[str, Any] = (
            {"letter_share": 0.97, "follows_letter": True} if request.orders else {}
        )
        return Completion(request.id, text, 9, 1, "stop", 0.1, 1, label_mass=0.2, **more)


def examined(p: Any) -> Findings:
    model = Model(p)
    found = examine(model, AGENT)  # type: ignore[arg-type]
    assert isinstance(found, Findings)
    assert model.asked == COUNT + (0 if found.reads_scene else AGAIN)
    return found


def test_a_model_that_brakes_for_a_listed_conflict_reads_the_scene() -> None:
    found = examined(lambda text, cyclic: 0.2 if "none in sight" in text else 0.8)
    assert {pair.fact: pair.moved for pair in found.pairs} == {
        "conflict": 4, "gap": 0, "danger": 0, "number": 0,
    }  # fmt: skip
    assert found.reads_scene
    assert (found.n, found.letter_share, found.follows_letter, found.label_mass) == (
        12,
        0.97,
        12,
        0.2,
    )
    assert [s.partition(" follows")[0] for s in found.sentences()] == ["its likeliest action"]
    assert (found.prompt, found.prompt_sha256, found.answer) == (
        "v2",
        AGENT.prompt.sha256,
        "readout",
    )


def test_a_model_that_answers_ever_the_same_does_not_read_the_scene() -> None:
    first, *_ = examined(lambda text, cyclic: 0.5).sentences()
    assert first.startswith("it does not read the scene: a conflict put in or taken out, or a gap")
    assert (
        "in 0 of 8 pairs; with --letters raw in 0 of 8 (model check, answer readout, prompt v2)"
        in first
    )


def test_weights_that_learnt_one_order_of_the_letters_are_asked_in_it() -> None:
    """Over cyclic orders they follow the letter;
    in the order of the list they brake for a conflict.
    """
    found = examined(lambda text, cyclic: 0.5 if cyclic or "none in sight" in text else 0.8)
    assert not found.reads_scene
    assert {pair.fact: (pair.moved, pair.n) for pair in found.others} == {
        "conflict": (4, 4),
        "gap": (0, 4),
    }
    first, *_ = found.sentences()
    assert first.startswith("with letters read cyclic it does not read the scene: a conflict")
    assert "in 0 of 8 pairs; with --letters raw in 4 of 8 (" in first


def test_a_question_without_an_answer_finds_nothing() -> None:
    class Broken(Model):
        def _answer(self, request: Request) -> Completion:
            return Completion(request.id, "", None, None, "error", None, 1, "out of memory")

    assert examine(Broken(None), AGENT) == "out of memory"  # type: ignore[arg-type]


def test_findings_are_kept_by_identity_and_a_damaged_file_is_none() -> None:
    found = Findings("v2", "p", "readout", "cyclic", 12, 0.9, 12, 0.2, (Moved("gap", 4, 0, 0.001),))
    asked = ("p", "readout")
    folder = kept.folder() / "findings"
    before = set(folder.iterdir()) if folder.is_dir() else set()
    keep_findings({"engine": "e", "weights": "w"}, found)
    assert recall_findings({"engine": "e", "weights": "w", "helpers": [{}]}, *asked) == found
    assert recall_findings({"engine": "e", "weights": "other"}, *asked) is None
    assert recall_findings({"engine": "e", "weights": "w"}, "another text", "readout") is None
    assert recall_findings({"engine": "e", "weights": "w"}, "p", "json") is None
    [file] = set(folder.iterdir()) - before
    whole = json.loads(file.read_text())
    unsaid = [
        {key: value for key, value in whole.items() if key != name}
        for name in ("prompt_sha256", "answer")
    ]
    for damaged in ("{", *map(json.dumps, unsaid), json.dumps(whole | {"answer": "json"})):
        file.write_text(damaged)
        assert recall_findings({"engine": "e", "weights": "w"}, *asked) is None
    file.unlink()


def test_a_run_that_asked_a_model_as_it_was_checked_says_so_and_no_other(
    small: Dataset, tmp_path: Path
) -> None:
    """A run of another answer mode,
    prompt text or weights is not what was found to read nothing.
    """
    done = made(spec_of(small), tmp_path / "run")
    ran = replace(done.manifest, answer="readout", letters="cyclic")

    def said(manifest: Manifest) -> list[str]:
        every = [finding.sentence for finding in findings(Run(done.out, manifest))]
        return [s for s in every if "read the scene" in s or "letter" in s]

    assert not said(ran)
    mute = (Moved("gap", 4, 0, 0.0),)
    sha256 = ran.prompt["sha256"]
    keep_findings(ran.identity, Findings("v2", sha256, "readout", "cyclic", 12, 1.0, 12, 1.0, mute))
    scene, letter = said(ran)
    assert scene.startswith("proxy: it does not read the scene")
    assert scene.endswith("in 0 of 4 pairs (model check, answer readout, prompt v2).")
    assert letter.startswith("proxy: its likeliest action follows the letter in 12 of 12 questions")
    helped = replace(
        ran, helpers=(ran.agent(0),), identity={**ran.identity, "helpers": [ran.identity]}
    )
    assert said(helped) == [scene, letter], "once, though two agents are the same model"
    others = (
        replace(ran, answer="json"),
        replace(ran, answer="decision"),
        replace(ran, prompt={**ran.prompt, "sha256": "of another text under the same name"}),
        replace(ran, identity={**ran.identity, "weights": "others under the same name"}),
    )
    for other in others:
        assert not said(other)
    in_json = replace(helped, answer="json")
    assert said(in_json) == [scene, letter], "of its helper alone"
    for file in (kept.folder() / "findings").iterdir():
        file.unlink()
    assert not list(by_letter(Run(done.out, ran)))


@pytest.mark.parametrize(("share", "says"), [(0.97, True), (0.3, False)])
def test_a_page_says_whose_read_outs_follow_the_letter(share: float, says: bool) -> None:
    scores = [
        Score("all", f"{name}_ego", value, None, None, 40, 0, "answers")
        for name, value in (("letter_share", share), ("follows_letter", 0.95))
    ]
    run = Run(Path("run"), None)
    run.__dict__["scores"] = scores  # as if it had read them from its file
    said = list(by_letter(run))
    assert len(said) == says
    if says:
        assert said[0].startswith("97 % of what the ego's read-outs say follows the letter")
        assert "in 38 of 40" in said[0]
