"""What is learnt from, stage by stage, and the model that learns it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from harness.backends.card import Card
from harness.backends.tokens import token_ids, whole
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.core.files import text_of
from harness.core.work import kept_file
from harness.extensions.learn.training.answers import CLASSES, answer, evidence, sights
from harness.extensions.learn.training.lessons import Lessons
from harness.extensions.learn.training.model import (
    END,
    chat,
    new_model,
    read_tokenizer,
    take_over,
    train_tokenizer,
)
from harness.extensions.learn.training.published import Published
from harness.extensions.learn.training.questions import (
    Question,
    alone,
    excerpts,
    key,
    kl_nats,
    references,
    value,
    with_messages,
)
from harness.extensions.learn.training.train import (
    Curve,
    Plan,
    Sample,
    learnt,
    read_out,
    restore,
    run_stage,
    save,
)
from harness.prompts import readout

REHEARSED = 0.5  # read-outs that are rehearsed beside the texts, a share of these
BARE = 0.25  # texts without free text, as constrained answers are; a share of all that can be
HELD_OUT = 0.05  # layouts that are not trained on, a share of all
WATCHED = 256  # most questions of held-out layouts that are read along the way

# of the stage, the sequences seen in it, the loss, and what is watched
Progress = Callable[..., None]
T = TypeVar("T")


class Student:
    """Hold a model in training, with its questions and tokenizer, and train it stage by stage.

    The stages are those of `samples`. It is made from the lessons of each scenario, of which the
    last layouts (start situations) are held out; a plan of the training; `work`, the folder of what
    a resumed training needs; PyTorch's name of the device; and the model to begin with, None for
    random weights. Attributes: `model` is the transformers model, `questions` those that it learns,
    and `letters` the token ids of the letters that stand for actions.
    """

    def __init__(
        self,
        lessons: Sequence[Lessons],
        plan: Plan,
        work: Path,
        device: str,
        base: Path | Card | None = None,
    ) -> None:
        self.plan, self.work = plan, work
        self.lessons, self.held_out = zip(*(each.split(HELD_OUT) for each in lessons), strict=True)
        self.questions = [q for each in self.lessons for q in alone(each)]
        sees = any(p.image for each in lessons for p in each.prompts)
        most = max((each.scenario.actions for each in lessons), key=len)
        self._shared: dict[str, Any] = {}
        self.taught: dict[str, Floats] = {}  # by scenario, scene and viewer
        self.published, self.digits = None, list[int]()
        if isinstance(base, Card):
            assert plan.adapt
            self.published = Published(base, plan.adapt, plan.seed, device)
            self.model = self.published.model
            self.letters = self.published.letters(readout.letters(most))
            return
        self.tokenizer = read_tokenizer(base, sees) if base else self._tokenizer(sees)
        self.letters = [self.tokenizer.token_to_id(x) for x in readout.letters(most)]
        self.digits = [self.tokenizer.token_to_id(str(digit)) for digit in range(CLASSES)]
        self.model = new_model(self.tokenizer, plan.seed, sees)
        if base:
            take_over(self.model, base)
        self.model.to(device)
        if base and sees:
            texts = [q for q in self.questions if q.image is None]
            read = self.read(self.reading(texts))
            self.taught = {_place(q): intent for q, intent in zip(texts, read, strict=True)}

    def reading(self, questions: Sequence[Question], seen: bool = False) -> list[Sample]:
        """Return training samples of questions, answered by a letter and a report in words.

        The letter is drawn from the target: the soft label, the probabilities of actions to be
        learnt. If a base model with text prompts is there, a picture's target is that model's
        read-out of the same scene in words, which has less noise. The report tells the nearest
        conflict; of a picture, if `seen`, the vehicles that it shows.
        """
        rng = np.random.default_rng(self.plan.seed)
        samples = []
        for q in questions:
            target = self.taught.get(_place(q), q.label) if q.image else q.label
            letter = readout.letters(q.actions)[rng.choice(len(q.actions), p=target)]
            report = sights(q.graph) if seen and q.image else evidence(q.graph, q.named)
            samples.append(self._sample(q, q.read_out, f"{letter}: {report}", target))
        return samples

    def writing(self, questions: Sequence[Question], intents: Sequence[Floats]) -> list[Sample]:
        """Return training samples of questions, answered by JSON that states these intents.

        There is one intent for each question: a distribution over A actions, (A,), which the
        answer's text then has.
        """
        bare = np.random.default_rng(self.plan.seed).random(len(questions)) < BARE
        samples = []
        for q, intent, is_bare in zip(questions, intents, bare.tolist(), strict=True):
            text = answer(q.prompt, q.graph, intent, q.actions, bare=is_bare, named=q.named)
            samples.append(self._sample(q, q.messages, text, None))
        return samples

    @cached_property
    def one_letter_samples(self) -> list[Sample]:
        """Return training samples with a one-letter answer, one for each question without messages.

        Such questions do not show what helpers said; the letter stands for an action.
        """
        return self.reading(self.questions)

    @cached_property
    def heard(self) -> list[Question]:
        """Return questions to the ego with helpers' messages, whose intents the model states.

        The intents, probabilities of actions, are the model's after the stage `alone`, kept in a
        file for a resumed training. Raises UserError if no message reaches the ego in the scenes
        that are taken.
        """
        prompts = sum(len(lessons.prompts) for lessons in self.lessons)
        most = self.plan.samples["messages"] // (4 * prompts)  # of each scenario
        scenes_of = [self.some(lessons.scenes, most) for lessons in self.lessons]
        helpers = set()
        for lessons, scenes in zip(self.lessons, scenes_of, strict=True):
            for scene, prompt in product(scenes, lessons.prompts):
                helpers |= {key(lessons, scene, helper, prompt) for helper in scene.viewers[1:]}
        names, samples = [], []
        for question, sample in zip(self.questions, self.one_letter_samples, strict=True):
            if question.key in helpers:
                names.append(question.key)
                samples.append(sample)
        file = self.work / "heard.pt"
        if not file.is_file():  # after a kill, a later stage's model would read otherwise
            read = [torch.from_numpy(intent) for intent in self.read(samples)]
            save({"intents": read}, file)
        with kept_file(file):
            stored = [intent.numpy() for intent in torch.load(file, weights_only=True)["intents"]]
            intents = dict(zip(names, stored, strict=True))
        heard: list[Question] = []
        for lessons, scenes in zip(self.lessons, scenes_of, strict=True):
            heard += with_messages(lessons, scenes, intents)
        if not heard:
            raise UserError(
                f"--samples: {self.plan.samples['messages']} sequences of the stage messages take "
                "too few scenes: no message reaches the ego in them; give more, or a scenario "
                "with more helpers"
            )
        return heard

    def samples(self, stage: str) -> list[Sample]:
        """Return the training samples of a stage, a part of the training, by the stage's name.

        `excerpts` have scene graphs (what a vehicle knows) with conflicts alone, `alone` whole ones
        without helpers' messages, and `messages` those to an ego that heard some, all answered by a
        letter; `answers` are answered in JSON. The last two stages repeat some one-letter samples
        of the earlier ones.
        """
        if stage == "excerpts":
            return self.reading(list(excerpts(self.questions)), seen=True)
        if stage == "alone":
            return self.one_letter_samples
        heard = self.heard if self.plan.samples["messages"] else []
        with_heard = self.reading(heard)
        if stage == "messages":
            return with_heard + self.some(self.one_letter_samples, len(heard))
        # As many texts of the ego, alone and with messages, as of all helpers: each decision needs
        # the ego's.
        pairs = list(zip(self.questions, self.one_letter_samples, strict=True))
        of_helpers = [pair for pair in pairs if pair[0].graph.role == "helper"]
        of_egos = [pair for pair in pairs if pair[0].graph.role == "ego"]
        of_heard = list(zip(heard, with_heard, strict=True))
        most = self.plan.samples["answers"] // 6
        drawn: list[tuple[Question, Sample]] = []
        for kind in (of_helpers, of_egos, of_heard):
            drawn += self.some(kind, most)
        intents = self.read([sample for _, sample in drawn])
        texts = self.writing([question for question, _ in drawn], intents)
        return texts + self.some(self.one_letter_samples + with_heard, int(REHEARSED * len(texts)))

    def some(self, items: Sequence[T], most: int) -> list[T]:
        """Return at most `most` of the items, drawn by the plan's seed, in their order."""
        places = np.random.default_rng(self.plan.seed).permutation(len(items))[:most]
        return [items[i] for i in sorted(places)]

    def stage(self, name: str, progress: Progress) -> Curve:
        """Train one stage, or load its weights if it is done, and return its loss curve.

        `name` is the stage's: `excerpts`, `alone`, `messages` or `answers`, which differ in what is
        asked. A point of the curve is the sequences seen, the mean loss, and what is watched; the
        curve is empty for a stage of no sequences. `progress` is called with the name and each
        point.
        """
        done = self.work / f"{name}.pt"
        if done.is_file():
            with kept_file(done):
                state = torch.load(done, weights_only=True, map_location=self.model.device)
                restore(self.model, state["model"])
                return [tuple(point) for point in state["curve"]]
        checkpoint = self.work / f"{name}.going.pt"
        count, show = self.plan.samples[name], partial(progress, name)
        if not count:
            return []
        curve = run_stage(
            self.model,
            self.samples(name),
            self.letters,
            self.digits,
            count,
            self.plan,
            show,
            checkpoint,
            self._watched if self.published or self.plan.objective != "imitation" else tuple,
        )
        save({"model": learnt(self.model), "curve": curve}, done)
        checkpoint.unlink(missing_ok=True)
        return curve

    @cached_property
    def _watched_samples(self) -> tuple[list[Sample], Floats]:
        questions = self.some([q for each in self.held_out for q in alone(each)], WATCHED)
        most = max(len(q.label) for q in questions)
        return self.reading(questions), np.stack(
            [np.pad(q.label, (0, most - len(q.label))) for q in questions]
        )

    def _watched(self) -> tuple[float, float]:
        """Return the KL (nats) and the value on some questions of held-out layouts."""
        samples, labels = self._watched_samples
        read = np.stack([np.pad(p, (0, labels.shape[1] - len(p))) for p in self.read(samples)])
        return kl_nats(labels, read), value(labels, read, [sample.weight for sample in samples])

    def rounded(self) -> dict[str, Any]:
        """Round the trainable weights to F16 in place, and return all weights by name.

        So every engine computes with the same numbers.
        """
        halves: dict[int, Any] = {}  # by address, since some have two names
        with torch.no_grad():
            for p in (p for p in self.model.parameters() if p.requires_grad):
                halves[p.data_ptr()] = half = p.half()
                p.copy_(half)
        return {name: halves.get(p.data_ptr(), p) for name, p in self.model.state_dict().items()}

    def held_out_facts(self) -> list[dict[str, Any]]:
        """Return how well the model's probabilities fit the right ones, a dict a scenario.

        The questions are of held-out layouts, start situations that are not learnt. The model
        answers by read-outs, the probabilities of the letters of actions. `scenario` is the name,
        and `layouts` and `questions` are counts. `kl_nats` is the KL divergence from the right
        probabilities, and `value` the mean probability of success, balanced over layouts with and
        without a danger (a vehicle that the ego would meet); names with `of_the_mean` and
        `of_the_likeliest` are the same of always giving the mean answer, and of the likeliest
        action alone. `references` has the values of drivers that need no model, and `likeliest` how
        often each action is the likeliest.
        """
        facts = []
        for each in self.held_out:
            questions = list(alone(replace(each, balanced=True)))
            weights = [q.weight for q in questions]
            labels = np.stack([q.label for q in questions])
            mean = np.broadcast_to(labels.mean(axis=0), labels.shape)
            read = np.stack(self.read(self.reading(questions)))
            actions = each.scenario.actions
            likeliest = np.eye(len(actions))[read.argmax(axis=1)]
            facts.append(
                {
                    "scenario": each.scenario.name,
                    "layouts": len(each.episodes),
                    "questions": len(questions),
                    "kl_nats": kl_nats(labels, read),
                    "kl_of_the_mean_nats": kl_nats(labels, mean),
                    "value": value(labels, read, weights),
                    "value_of_the_mean": value(labels, mean, weights),
                    "value_of_the_likeliest": value(labels, likeliest, weights),
                    "references": references(questions, labels, weights),
                    "likeliest": dict(zip(actions, likeliest.mean(axis=0).tolist(), strict=True)),
                }
            )
        return facts

    def read(self, samples: Sequence[Sample]) -> list[Floats]:
        return read_out(self.model, samples, self.letters)

    def _sample(
        self,
        question: Question,
        messages: Sequence[Mapping[str, str]],
        reply: str,
        target: Floats | None,
    ) -> Sample:
        if self.published:
            prompt, shared, kind = self.published.read(messages)
            ids = np.concatenate(
                [prompt, self.published.encode(reply + self.published.end)], dtype=np.int32
            )
            return Sample(ids, shared, kind, len(prompt), target, question.weight)
        system, rest = chat(messages)
        if system not in self._shared:
            self._shared[system] = self._encode(system)
        head, rest_ids = self._shared[system], self._encode(rest)
        ids = np.concatenate([head, rest_ids, self._encode(reply + END)])
        answer_at = len(head) + len(rest_ids)
        return Sample(ids, len(head), system, answer_at, target, question.weight, question.image)

    def _encode(self, text: str) -> Any:
        return np.array(token_ids(self.tokenizer, text), dtype=np.int32)

    def _tokenizer(self, sees: bool) -> Any:
        from tokenizers import Tokenizer

        file = self.work / "tokenizer.json"
        if not file.is_file():
            some = self.some(self.questions, 5000)
            texts = [m["content"] for q in some for m in q.read_out]
            texts += [answer(q.prompt, q.graph, q.label, q.actions) for q in some]
            train_tokenizer(texts, sees).save(str(file))
        with kept_file(file):
            return whole(Tokenizer.from_str(text_of(file, "record")))


def _place(question: Question) -> str:
    """Name a question's scenario, scene and viewer, and whether messages are in it,
    whatever its prompt.
    """
    place, _, version = question.key.rpartition("/")
    return place + "+m" * version.endswith("+m")
