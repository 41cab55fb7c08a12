"""What each viewer of a scene is asked, and what it should have intended."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from msgspec import structs

from harness.core import noise
from harness.core.arrays import Floats
from harness.dataset.load import Scene
from harness.evaluate.agent import in_mode
from harness.extensions.learn.training.answers import message
from harness.extensions.learn.training.lessons import TEACHER, Lessons
from harness.extensions.learn.training.model import VISION
from harness.prompts.versions import Prompt
from harness.world.drivers import CONSTANT, UNIFORM, choices, constant
from harness.world.perception.camera import Sight
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

ARRIVES = 0.85  # probability that a helper's message is in the ego's prompt


@dataclass(frozen=True)
class Question:
    """One prompt."""

    key: str  # scenario, scene, viewer and prompt version, and `+m` where messages are in it
    scenario: Scenario  # what is decided in
    prompt: Prompt  # which version
    graph: SceneGraph  # the viewer's scene graph
    messages: tuple[Mapping[str, str], ...]  # chat messages
    label: Floats  # soft label, (A,)
    weight: float  # how often it is learnt, beside others
    image: Sight | None = None  # what the viewer's cameras see, if the prompt shows it
    heard: Sequence[Mapping[str, Any]] = ()  # helpers' messages in the prompt
    excerpt: SceneGraph | None = None  # what of the graph the prompt shows, if not all

    @property
    def named(self) -> bool:
        """Whether the prompt names those of whom the answer may speak; a picture names nobody."""
        return any(f"{c.vehicle} " in self.messages[-1]["content"] for c in self.graph.conflicts)

    @property
    def actions(self) -> tuple[str, ...]:
        return self.scenario.actions

    @property
    def read_out(self) -> tuple[Mapping[str, str], ...]:
        """Return the chat messages that ask for a letter."""
        shown, words = self.excerpt or self.graph, self.scenario.prompt_words
        messages = self.prompt.render(shown, self.actions, self.heard, words, letter=True)
        return in_mode("readout", self.prompt, messages, self.graph, self.actions, words)


def alone(lessons: Lessons) -> Iterator[Question]:
    """Ask every viewer on its own."""
    for scene in lessons.scenes:
        for viewer in scene.viewers:
            for prompt in lessons.prompts:
                yield question(lessons, scene, viewer, prompt)


def excerpts(questions: Sequence[Question]) -> Iterator[Question]:
    """Repeat the questions that have conflicts or a picture,
    with no text in them but the conflicts.
    """
    for q in questions:
        if q.graph.conflicts or q.image:
            shown = structs.replace(q.graph, nodes=(), sectors=())
            messages = q.prompt.render(shown, q.actions, words=q.scenario.prompt_words)
            yield replace(q, messages=messages, excerpt=shown, heard=())


def with_messages(
    lessons: Lessons, scenes: Sequence[Scene], intents: Mapping[str, Floats]
) -> Iterator[Question]:
    """Ask the ego with what some of its helpers sent;
    `intents` are the helpers' read-outs, by key.
    """
    for scene in scenes:
        ego, *helpers = scene.viewers
        for prompt in lessons.prompts:
            draws = noise.uniforms((len(helpers),), "arrives", scene.record.episode_seed, scene.id)
            heard = []
            for h, u in zip(helpers, draws, strict=True):
                if u < ARRIVES:
                    asked = question(lessons, scene, h, prompt)
                    sent = message(scene.graphs[h], intents[asked.key], asked.actions, asked.named)
                    heard.append({"sender": h, **sent})
            if heard:
                yield question(lessons, scene, ego, prompt, heard)


def question(
    lessons: Lessons,
    scene: Scene,
    viewer: str,
    prompt: Prompt,
    heard: Sequence[Mapping[str, Any]] = (),
) -> Question:
    """Return what a viewer is asked in a scene, with the messages that it heard."""
    graph, scenario = scene.graphs[viewer], lessons.scenario
    sent = prompt.render(graph, scenario.actions, heard, scenario.prompt_words)
    name = key(lessons, scene, viewer, prompt) + ("+m" if heard else "")
    image = Sight(scenario, scene.state, viewer, VISION.size_px) if prompt.image else None
    label, weight = lessons.labels[scene.id], lessons.weights[scene.id]
    return Question(name, scenario, prompt, graph, sent, label, weight, image, heard)


def key(lessons: Lessons, scene: Scene, viewer: str, prompt: Prompt) -> str:
    """Return the name of a viewer's question."""
    return f"{lessons.scenario.name}/{scene.id}/{viewer}/{prompt.version}"


def value(labels: Floats, p: Floats, weights: Sequence[float]) -> float:
    """Return the mean probability that answers (n, A) give to actions after which the episode
    succeeds.

    Those are the actions that the soft labels (n, A) give any.
    """
    return float(np.average((p * (labels > 0)).sum(axis=1), weights=weights))


def references(
    questions: Sequence[Question], labels: Floats, weights: Sequence[float]
) -> dict[str, float]:
    """Return the value of those who need no model: lines beside a model's, by the driver's name."""
    scenario = questions[0].scenario
    each = np.eye(len(scenario.actions))
    policies = {UNIFORM: np.full(labels.shape, 1 / len(each))}
    if action := constant(scenario):
        policies[CONSTANT] = np.tile(each[scenario.actions.index(action)], (len(questions), 1))
    planned = choices(scenario, [(TEACHER, question.graph, None) for question in questions])
    policies[TEACHER] = each[[scenario.actions.index(action) for action in planned]]
    return {name: value(labels, policy, weights) for name, policy in policies.items()}


def kl_nats(labels: Floats, p: Floats) -> float:
    """Return the mean KL divergence of answers (n, A) from soft labels (n, A)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(labels > 0, labels * np.log(labels / np.maximum(p, 1e-12)), 0.0)
    return float(terms.sum(axis=1).mean())
