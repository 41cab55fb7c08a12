"""`--flip`: a read-out asked once more with the list of actions reversed, which decides nothing."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import all_scenes, run, same_decisions, spec_of, with_ego
from run_on_disk import answers_of
from tiers import some

from harness.backends import cards
from harness.backends.base import Completion, Letters, Request
from harness.backends.orders import average_orders
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate.agent import Agent
from harness.evaluate.answers import answer_of
from harness.evaluate.asking import Asker
from harness.evaluate.latency import PAPER
from harness.evaluate.lifecycle import finished_with
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.prompts import readout, versions
from harness.report.caveats import flipped
from harness.runs import folder
from harness.runs.records import Answer

Said = tuple[int, str, str]
LETTERS = pytest.mark.parametrize("letters", ["raw", "cyclic"])


def spec_with(small: Dataset, letters: Letters = "raw", flip: bool = True) -> Spec:
    card = cards.resolve("swarm-tiny", "transformers")
    points = (POINTS["single-local"], POINTS["6g"])
    one = small.of_episodes([0])
    spec = spec_of(one, prompt="v4", limit=1, points=points, seeds=(0,), ask="all")
    return with_ego(spec, card=card, answer="readout", letters=letters, flip=flip)


def answered(
    spec: Spec, backend: Any, small: Dataset, scenes: int = 4
) -> tuple[list[Request], list[Answer]]:
    asked = list(requests(spec, all_scenes(small)[:scenes]))
    asker = Asker(spec, lambda: backend, PAPER)
    asker.ask(asked)
    return asked, [asker.answers[request.id] for request in asked]


class Taking:
    """Says the same of its letters whatever stands behind them, or the same of its actions."""

    def __init__(self, of_letters: Sequence[float] = (), **of_actions: float) -> None:
        self.of_letters, self.of_actions = of_letters, of_actions
        self.lists: list[tuple[str, ...]] = []

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.lists += [request.actions for request in requests]
        return [Completion(r.id, self.text(r), 9, 1, "stop", None, 1) for r in requests]

    def text(self, request: Request) -> str:
        if self.of_actions:
            return readout.answer_json(
                request.actions, [self.of_actions[a] for a in request.actions]
            )
        if request.orders:
            return average_orders(
                request.actions, [self.of_letters] * (1 + len(request.orders))
            ).text
        return readout.answer_json(request.actions, self.of_letters)


@LETTERS
def test_whoever_takes_the_first_letter_flips_unless_letters_cancel(
    letters: Letters, small: Dataset
) -> None:
    backend = Taking((0.7, 0.2, 0.1))
    asked, answers = answered(spec_with(small, letters), backend, small)
    assert [answer.flipped for answer in answers] == [letters == "raw"] * len(asked)
    assert backend.lists == [small.actions] * len(asked) + [small.actions[::-1]] * len(asked)


@LETTERS
def test_whoever_takes_an_action_never_flips(letters: Letters, small: Dataset) -> None:
    _, answers = answered(
        spec_with(small, letters), Taking(SLOWER=0.1, IDLE=0.2, FASTER=0.7), small
    )
    assert {answer.flipped for answer in answers} == {False}


def test_a_reversed_list_without_an_answer_leaves_the_answer_as_it_is(small: Dataset) -> None:
    class Refusing(Taking):
        def complete(self, requests: Sequence[Request]) -> list[Completion]:
            said = super().complete(requests)
            of = zip(requests, said, strict=True)
            return [
                c if r.actions == small.actions else replace(c, text="", error="no") for r, c in of
            ]

    for flip in (True, False):
        _, answers = answered(spec_with(small, flip=flip), Refusing((0.7, 0.2, 0.1)), small)
        assert {(a.cell("flipped"), a.error, a.intent) for a in answers} == {
            (None, None, (0.7, 0.2, 0.1))
        }


def by_hand(
    backend: Any, request: Request, listed: tuple[str, ...], cyclic: bool
) -> dict[str, float]:
    """What a model says of the same scene with another list, asked as a question of its own."""
    *before, last = request.messages
    assert readout.question(request.actions) in last["content"]
    messages, *orders = (
        (
            *before,
            {
                **last,
                "content": last["content"].replace(readout.question(request.actions), question),
            },
        )
        for question in map(readout.question, readout.cyclic(listed) if cyclic else [listed])
    )
    asked = request.alike(messages=messages, orders=tuple(orders), flips=(), actions=listed)
    intent = answer_of(asked, backend.complete([asked])[0]).intent
    assert intent is not None
    return dict(zip(listed, intent, strict=True))


@pytest.mark.parametrize("letters", some(["raw"], exhaustive=["cyclic"]))
def test_a_model_flips_where_two_questions_by_hand_say_so(letters: Letters, small: Dataset) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    spec = spec_with(small, letters)
    backend = open_backend(spec.ego.card, device="cpu")
    asked, answers = answered(spec, backend, small)
    sure = []
    for request, answer in zip(asked, answers, strict=True):
        lists = (small.actions, small.actions[::-1])
        one, other = (by_hand(backend, request, listed, letters == "cyclic") for listed in lists)
        if all(np.diff(sorted(p.values()))[-1] > 1e-4 for p in (one, other)):  # no batch decides it
            assert answer.flipped == (
                max(one, key=one.__getitem__) != max(other, key=other.__getitem__)
            )
            sure.append(answer.flipped)
    assert len(sure) > len(asked) / 2
    assert any(sure)


@pytest.mark.exhaustive
@LETTERS
def test_a_run_and_its_replay_count_it_and_decide_as_without(
    letters: Letters, small: Dataset, tmp_path: Path
) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    plain = run(spec_with(small, letters, flip=False), tmp_path / "plain")
    spec = spec_with(small, letters)
    done = run(spec, tmp_path / "run")
    assert same_decisions(plain.out, done.out)
    assert (plain.out / "episodes.csv").read_bytes() == (done.out / "episodes.csv").read_bytes()
    answers = answers_of(done.out)
    assert [but_flip(answer) for answer in answers] == [
        but_flip(answer) for answer in answers_of(plain.out)
    ]
    rates = {s.metric: s for s in done.scores if s.metric.startswith("flip_rate")}
    for role in ("ego", "helper"):
        of_role = [answer.flipped for answer in answers if answer.role == role]
        assert (rates[f"flip_rate_{role}"].value, rates[f"flip_rate_{role}"].n) == (
            pytest.approx(np.mean(of_role)), len(of_role),
        )  # fmt: skip
    assert [s for s in done.scores if s.metric not in rates] == list(plain.scores)
    assert any(
        "ego's" in said and "when the list of actions is reversed" in said
        for said in flipped(folder.read(done.out))
    )
    assert done.manifest.flip
    assert "--flip" in done.manifest.command
    with pytest.raises(UserError, match="flip"):
        finished_with({"flip": False}, done.out)
    other: Letters = "raw" if letters == "cyclic" else "cyclic"
    with pytest.raises(UserError, match="another letters"):
        finished_with(spec_with(small, other, flip=False).record(), plain.out)
    again = run(with_ego(spec, card=cards.resolve(f"replay:{done.out}")), tmp_path / "again")
    assert (again.out / "answers.jsonl").read_bytes() == (done.out / "answers.jsonl").read_bytes()
    with pytest.raises(
        UserError, match="was run without --flip; leave it out, or make the run again"
    ):
        run(with_ego(spec, card=cards.resolve(f"replay:{plain.out}")), tmp_path / "refused")


def but_flip(answer: Answer) -> dict[str, Any]:
    fields = {name: getattr(answer, name) for name in answer.__struct_fields__}
    return {name: value for name, value in fields.items() if name != "flipped"}


def test_what_is_no_read_out_of_a_language_model_is_refused(harness: Callable[..., Said]) -> None:
    with pytest.raises(
        UserError, match="--flip: proxy is no language model; leave it out, or give"
    ):
        Agent(cards.resolve("proxy"), versions.load("v2"), "readout", flip=True)
    code, _, err = harness("eval", "--model", "proxy", "--flip", "--limit", "1")
    said = "proxy answers in json; leave it out, or give a language model and --answer readout"
    assert (code, err) == (2, f"harness: --flip: {said}\n")


@pytest.mark.parametrize(
    "command", some([(("eval", "--limit", "1"),)], exhaustive=[(("drive", "--episodes", "1"),)])
)
def test_the_terminal_says_how_often_beside_the_letter(
    command: tuple[str, ...], harness: Callable[..., Said], tmp_path: Path
) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    code, out, err = harness(
        *command, "--model", "swarm-tiny:transformers", "--prompt", "v4", "--answer", "readout", "--flip",
        "--seeds", "0:1", "--condition", "single-local", "--out", str(tmp_path / "run"), "--verbose",
    )  # fmt: skip
    assert code == 0, err
    score = folder.read(tmp_path / "run").score("all", "flip_rate_ego")
    hits = round(score.value * score.n)
    assert (
        f"letters read once; the reversed list changes the likeliest action in {hits} of {score.n};"
        in " ".join(out.split())
    )
