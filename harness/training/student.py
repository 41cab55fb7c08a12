"""What is learnt from, stage by stage, and the model that learns it."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.prompts import readout
from harness.prompts.versions import Prompt
from harness.training.answers import answer, evidence
from harness.training.examples import Question, alone, excerpts, kl_nats, split, taught, with_messages
from harness.training.model import END, PAD, chat, new_model, train_tokenizer
from harness.training.train import Plan, Sample, read_out, run_stage, save

REHEARSED = 0.5  # read-outs that are rehearsed beside the texts, a share of these
BARE = 0.25  # texts without free text, as constrained answers are; a share of all that can be
HELD_OUT = 0.05  # episodes that are not trained on, a share of all


Progress = Callable[[str, int, float], None]
T = TypeVar("T")


class Student:
    """The dataset as questions, the tokenizer, and the model as it grows."""

    def __init__(
        self, dataset: Dataset, prompts: Sequence[Prompt], plan: Plan, work: Path, device: str
    ) -> None:
        self.plan, self.work, self.prompts, self.actions = plan, work, prompts, dataset.actions
        self.data, self.held_out = split(dataset, max(1, round(len(dataset.episodes) * HELD_OUT)))
        self.scenes = taught(self.data)
        self.questions = list(alone(self.data, self.scenes, prompts))
        self.tokenizer = self._tokenizer()
        self.letters = [self.tokenizer.token_to_id(x) for x in readout.letters(self.actions)]
        end, pad = (self.tokenizer.token_to_id(t) for t in (END, PAD))
        self.model = new_model(self.tokenizer.get_vocab_size(), end, pad, plan.seed).to(device)
        self._shared: dict[str, Any] = {}

    def reading(self, questions: Sequence[Question]) -> list[Sample]:
        """Samples where one letter is asked for; drawn by the label, it is followed by a report in words."""
        rng, letters = np.random.default_rng(self.plan.seed), readout.letters(self.actions)
        drawn = [letters[rng.choice(len(letters), p=q.label)] for q in questions]
        return [
            self._sample(
                readout.asked(q.messages, self.actions), f"{letter}: {evidence(q.graph)}{END}", q.label
            )
            for q, letter in zip(questions, drawn, strict=True)
        ]

    def writing(self, questions: Sequence[Question], intents: Floats) -> list[Sample]:
        """Samples whose answer states a distribution."""
        bare = np.random.default_rng(self.plan.seed).random(len(questions)) < BARE
        return [
            self._sample(q.messages, answer(q.prompt, q.graph, p, self.actions, bare=bool(b)) + END, None)
            for q, p, b in zip(questions, intents, bare, strict=True)
        ]

    @cached_property
    def asked(self) -> list[Sample]:
        """The questions, each asking for one letter."""
        return self.reading(self.questions)

    @cached_property
    def heard(self) -> list[Question]:
        """The ego's questions with messages in some scenes, as the first stage's model reads helpers out.

        Raises:
            UserError: in the scenes that are taken no message reaches the ego.
        """
        most = self.plan.samples["messages"] // (4 * len(self.prompts))
        scenes = self.some(self.scenes, most)
        ids = {scene.id for scene in scenes}
        spoke = [
            (question.key, sample)
            for question, sample in zip(self.questions, self.asked, strict=True)
            if question.graph["role"] == "helper" and question.key.split("/")[0] in ids
        ]
        kept = self.work / "heard.pt"
        if not kept.is_file():  # a later stage's model, after a kill, would read otherwise
            save({"intents": torch.from_numpy(self.read([sample for _, sample in spoke]))}, kept)
        intents = torch.load(kept, weights_only=True)["intents"].numpy()
        said = dict(zip((key for key, _ in spoke), intents, strict=True))
        heard = list(with_messages(self.data, scenes, self.prompts, said)) if said else []
        if not heard:
            raise UserError(
                f"--samples: {self.plan.samples['messages']} sequences of the stage messages take too few "
                "scenes: no message reaches the ego in them; give more, or a dataset with more helpers"
            )
        return heard

    def samples(self, stage: str) -> list[Sample]:
        """What a stage learns from; the last two rehearse the read-outs of earlier ones."""
        if stage == "excerpts":
            return self.reading(list(excerpts(self.questions, self.actions, self.data.scenario.prompt_words)))
        if stage == "alone":
            return self.asked
        with_heard = self.reading(self.heard)
        if stage == "messages":
            return with_heard + self.some(self.asked, len(self.heard))
        count = self.plan.samples["answers"]
        stated = self.some(list(zip(self.questions, self.asked, strict=True)), count // 3)
        stated += self.some(list(zip(self.heard, with_heard, strict=True)), count // 6)
        texts = self.writing([q for q, _ in stated], self.read([sample for _, sample in stated]))
        return texts + self.some(self.asked + with_heard, int(REHEARSED * len(texts)))

    def some(self, items: Sequence[T], most: int) -> list[T]:
        """At most so many of them, drawn by the plan's seed, in their order."""
        places = np.random.default_rng(self.plan.seed).permutation(len(items))[:most]
        return [items[i] for i in sorted(places)]

    def stage(self, name: str, progress: Progress) -> list[tuple[int, float]]:
        """Train one stage, or take it over where it is done already. Returns its curve."""
        done = self.work / f"{name}.pt"
        if done.is_file():
            state = torch.load(done, weights_only=True)
            self.model.load_state_dict(state["model"])
            return [tuple(point) for point in state["curve"]]
        going = self.work / f"{name}.going.pt"
        curve = run_stage(
            self.model, self.samples(name), self.letters, self.plan.samples[name], self.plan,
            lambda n, loss: progress(name, n, loss), going,
        )  # fmt: skip
        save({"model": self.model.state_dict(), "curve": curve}, done)
        going.unlink(missing_ok=True)
        return curve

    def held_out_kl(self) -> dict[str, Any]:
        """KL (nats) of the read-out to the soft labels on held-out episodes, beside the mean label's."""
        questions = list(alone(self.held_out, taught(self.held_out), self.prompts))
        labels = np.stack([q.label for q in questions])
        mean = np.broadcast_to(labels.mean(axis=0), labels.shape)
        return {
            "episodes": len(self.held_out.episodes),
            "questions": len(questions),
            "kl_nats": kl_nats(labels, self.read(self.reading(questions))),
            "kl_of_the_mean_nats": kl_nats(labels, mean),
        }

    def read(self, samples: Sequence[Sample]) -> Floats:
        """Read-outs of some samples, (n, A)."""
        return read_out(self.model, samples, self.letters)

    def _sample(self, messages: Sequence[Mapping[str, str]], said: str, target: Floats | None) -> Sample:
        system, rest = chat(messages)
        if system not in self._shared:
            self._shared[system] = self._encode(system)
        head, asked = self._shared[system], self._encode(rest)
        ids = np.concatenate([head, asked, self._encode(said)])
        return Sample(ids, len(head), system, len(head) + len(asked), target)

    def _encode(self, text: str) -> Any:
        return np.array(self.tokenizer.encode(text).ids, dtype=np.int32)

    def _tokenizer(self) -> Any:
        from tokenizers import Tokenizer

        file = self.work / "tokenizer.json"
        if not file.is_file():
            some = self.some(self.questions, 5000)
            texts = ["".join(chat(readout.asked(q.messages, self.actions))) for q in some]
            texts += [answer(q.prompt, q.graph, q.label, self.actions) for q in some]
            train_tokenizer(texts).save(str(file))
        return Tokenizer.from_file(str(file))
