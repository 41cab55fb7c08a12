"""Check a model before a run: ask it in every answer mode, with and without pictures,
and examine it.
"""

from dataclasses import dataclass, replace
from typing import cast

from harness.backends.base import Completion, Rendering, Request
from harness.backends.card import Card
from harness.backends.registry import capabilities, open_backend
from harness.core.progress import Progress
from harness.core.resources import DATASET
from harness.dataset import load
from harness.evaluate.agent import Agent
from harness.evaluate.answers import answer_of
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.extensions.checkups.answers import Checkup
from harness.extensions.checkups.answers import check as ask
from harness.extensions.checkups.read_outs import COUNT, Findings, examine, keep_findings
from harness.prompts import versions
from harness.runs.settings import Settings

PROMPT, IMAGE_PROMPT = "v2", "v7"


@dataclass(frozen=True)
class Check:
    """Hold the result of `harness model check`: a model's answers, and what they showed.

    `spec` has the model, prompt and settings with which it was asked, and `seen` its prompt and
    answers. `findings` say whether its read-outs, the probabilities of one letter an action, follow
    the letter or the scene; None where that was not examined. `unanswered` says why the questions
    for that got no answer.
    """

    spec: Spec  # how the model was asked: model, prompt and settings
    seen: Checkup  # its prompt and answers
    # what its read-outs (probabilities of one letter an action) follow, the letter or the scene;
    # None where it was not examined
    findings: Findings | None
    unanswered: str | None = None  # why the fixed questions got no answer

    @property
    def completions(self) -> list[Completion]:
        """Return every answer that the model must be able to give.

        That is one in each answer mode (free text, one letter and so on) to a prompt in words, and
        to one with a camera picture if it takes pictures; not those to blank pictures.
        """
        return [
            *self.seen.answers.values(),
            *(self.seen.looks.answers.values() if self.seen.looks else ()),
        ]

    @property
    def usable(self) -> bool:
        """Return whether the model can be used: an answer of it says how probable each action is.

        One answer that can be parsed, in any answer mode (free text, one letter and so on), is
        enough.
        """
        request = self.spec.ego.blank("ego", self.spec.actions)
        answers = self.seen.answers.items()
        return any(answer_of(request.alike(answer=mode), reply).intent for mode, reply in answers)


def check(
    card: Card, thinking: bool, device: str | None, dtype: str | None, progress: Progress
) -> Check:
    """Check a language model in every answer mode, with and without pictures.

    An answer mode is a way to answer, such as free text or one letter for an action. If the model
    can answer by letters, fixed questions also show whether these answers follow the scene or the
    letter; that is then kept in the user's cache.

    Args:
        card: the file that describes the model, with the engine that runs it.
        thinking: whether the model is asked to think first.
        device: where it is loaded, such as `cuda`; None lets the engine choose.
        dtype: number format of the weights, such as `float32`; None takes the card's.
        progress: told how many answers there will be, and called with 1 after each.
    """
    data = load.load(load.find(DATASET), 1)
    can = capabilities(card.engine).answer_modes
    if "readout" in can:  # which asks for letters, as a decision does
        can = tuple(mode for mode in can if mode != "decision")
    ego = Agent(card, versions.load(PROMPT), can[0], thinking=thinking)
    sees = None
    if card.vision:
        sees = Agent(card, versions.load(IMAGE_PROMPT), can[0], thinking=thinking)
    settings = Settings(batch_size=1, device=device, dtype=dtype)
    spec = Spec(ego, FrozenSource(data), (), (0,), settings=settings)
    modes = ("json",) if ego.thinking else can
    scenes = data.scenes(data.forest.ids[:1])

    def question(agent: Agent) -> Request:
        # the first of a scene's is the ego's
        return next(requests(replace(spec, ego=agent), scenes))

    questions = [question(replace(ego, answer=mode)) for mode in modes]
    of_pictures = []
    if sees:
        for mode in modes:
            picture = replace(sees, answer=mode)
            blank, none = replace(picture, image="blank"), replace(picture, image="none")
            of_pictures.append((question(picture), question(blank), question(none)))
    backend = open_backend(card, device=device, dtype=dtype, batch_size=1)
    progress.more(len(questions) + 2 * len(of_pictures))
    checkup = ask(cast("Rendering", backend), questions, of_pictures, progress)
    read_out = checkup.answers.get("readout")
    blind = checkup.looks and checkup.looks.fault
    if read_out is None or read_out.error is not None or blind:
        return Check(spec, checkup, None)
    progress.more(COUNT)
    result = examine(backend, ego, progress)
    if isinstance(result, str):
        return Check(spec, checkup, None, result)
    keep_findings(checkup.identity, result)
    return Check(spec, checkup, result)
