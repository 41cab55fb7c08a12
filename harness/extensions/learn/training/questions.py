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
    """Hold one prompt for one viewer of a scene, and the answer (soft label) that it should get.

    A viewer is the vehicle that is asked: the ego, or a helper. `key` identifies the question (see
    `key`), `scenario` and `prompt` are the scene's scenario and the prompt version, `graph` is what
    the viewer knows, `messages` the chat, and `label` (A,) the probabilities that the answer should
    give to A actions. `weight` is relative to other questions'. `heard` has helpers' messages that
    the prompt shows, `image` its picture, and `excerpt` the part of the graph that it shows, if not
    all.
    """

    # scenario, scene, viewer and prompt version, and `+m` where helpers' messages are in it
    key: str
    scenario: Scenario  # the scene's
    prompt: Prompt  # the prompt version that asks
    graph: SceneGraph  # what the viewer knows of the scene
    messages: tuple[Mapping[str, str], ...]  # the chat: each message's role and content
    label: Floats  # soft label, (A,): probabilities of the scenario's A meta-actions
    weight: float  # training weight, relative to that of other questions
    image: Sight | None = None  # what the viewer's cameras see, if the prompt shows it
    heard: Sequence[Mapping[str, Any]] = ()  # helpers' messages in the prompt
    excerpt: SceneGraph | None = None  # what of the graph the prompt shows, if not all

    @property
    def named(self) -> bool:
        """Return whether the prompt names a vehicle whose path conflicts with the ego's.

        Then the answer's words may name it, too. It is false for a picture, which shows no names.
        """
        return any(f"{c.vehicle} " in self.messages[-1]["content"] for c in self.graph.conflicts)

    @property
    def actions(self) -> tuple[str, ...]:
        return self.scenario.actions

    @property
    def read_out(self) -> tuple[Mapping[str, str], ...]:
        """Return the prompt's chat messages, which ask to answer with one letter for an action."""
        graph, words = self.excerpt or self.graph, self.scenario.prompt_words
        messages = self.prompt.render(graph, self.actions, self.heard, words, letter=True)
        return in_mode("readout", self.prompt, messages, self.graph, self.actions, words)


def alone(lessons: Lessons) -> Iterator[Question]:
    """Yield a question without helpers' messages for every scene, viewer and prompt version.

    `lessons` has the scenes; viewers are the vehicles that are asked, the ego and its helpers.
    """
    for scene in lessons.scenes:
        for viewer in scene.viewers:
            for prompt in lessons.prompts:
                yield question(lessons, scene, viewer, prompt)


def excerpts(questions: Sequence[Question]) -> Iterator[Question]:
    """Yield shorter copies of questions, in whose scene graph only the conflicts are left.

    They are learnt first, since they are easier. A scene graph is what the asked vehicle knows of
    the scene. A conflict is a vehicle whose path meets the ego's, with both arrival times.
    Questions with neither conflicts nor a picture are left out.
    """
    for q in questions:
        if q.graph.conflicts or q.image:
            conflicts = structs.replace(q.graph, nodes=(), sectors=())
            messages = q.prompt.render(conflicts, q.actions, words=q.scenario.prompt_words)
            yield replace(q, messages=messages, excerpt=conflicts, heard=())


def with_messages(
    lessons: Lessons, scenes: Sequence[Scene], intents: Mapping[str, Floats]
) -> Iterator[Question]:
    """Yield training questions to the ego that show helpers' messages, by scene and prompt version.

    `lessons` has the scenario and the right answers, and `scenes` are those to ask about. `intents`
    has each helper's probabilities of A actions, (A,), by the key of the question that it answered,
    `scenario/scene/viewer/prompt version`. Each message arrives with probability 0.85, by draws
    keyed by layout (start situation) and scene; a scene in which none arrives is left out.
    """
    for scene in scenes:
        ego, *helpers = scene.viewers
        for prompt in lessons.prompts:
            draws = noise.uniforms((len(helpers),), "arrives", scene.record.episode_seed, scene.id)
            heard = []
            for h, u in zip(helpers, draws, strict=True):
                if u < ARRIVES:
                    q = question(lessons, scene, h, prompt)
                    sent = message(scene.graphs[h], intents[q.key], q.actions, q.named)
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
    """Return the question to one viewer (a vehicle's id) of a scene, for a prompt version.

    `lessons` has the scene's soft label, the probabilities of actions that the answer should have.
    `heard` has the helpers' messages that the prompt shows, each as a dict with its `sender`.
    """
    graph, scenario = scene.graphs[viewer], scene.seat or lessons.scenario
    sent = prompt.render(graph, scenario.actions, heard, scenario.prompt_words)
    name = key(lessons, scene, viewer, prompt) + ("+m" if heard else "")
    image = Sight(scenario, scene.state, viewer, VISION.size_px) if prompt.image else None
    label, weight = lessons.labels[scene.id], lessons.weights[scene.id]
    return Question(name, scenario, prompt, graph, sent, label, weight, image, heard)


def key(lessons: Lessons, scene: Scene, viewer: str, prompt: Prompt) -> str:
    """Return the key that tells a training question apart: `scenario/scene/viewer/prompt version`.

    The scenario is that of `lessons`, the scene is given by its id, and `viewer` is the id of the
    vehicle that is asked.
    """
    return f"{lessons.scenario.name}/{scene.id}/{viewer}/{prompt.version}"


def value(labels: Floats, p: Floats, weights: Sequence[float]) -> float:
    """Return the weighted mean probability of success of a model's answers to n questions.

    `p` (n, A) has the distributions over A actions that the answers state, and `labels` (n, A) the
    right ones, which are above 0 for the actions after which the episode succeeds; `weights` has
    how much each of the n counts.
    """
    return float(np.average((p * (labels > 0)).sum(axis=1), weights=weights))


def references(
    questions: Sequence[Question], labels: Floats, weights: Sequence[float]
) -> dict[str, float]:
    """Return the value of drivers that need no model at n questions, by the driver's name.

    They are `uniform` (all actions alike), `local-view` (a rule that goes by what it sees) and,
    where the scenario has one, `constant` (one action always). `labels` (n, A) are the right
    probabilities of A actions, and `weights` has how much each question counts. A value is the
    weighted mean probability of success.
    """
    scenario = questions[0].scenario
    each = np.eye(len(scenario.actions))
    policies = {UNIFORM: np.full(labels.shape, 1 / len(each))}
    if action := constant(scenario):
        policies[CONSTANT] = np.tile(each[scenario.actions.index(action)], (len(questions), 1))
    planned = choices(scenario, [(TEACHER, question.graph, None) for question in questions])
    policies[TEACHER] = each[[scenario.actions.index(action) for action in planned]]
    return {name: value(labels, policy, weights) for name, policy in policies.items()}


def kl_nats(labels: Floats, p: Floats) -> float:
    """Return the mean KL divergence in nats of answers `p` (n, A) from soft labels (n, A).

    Soft labels are what answers should be; both are distributions over A actions, for n questions.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(labels > 0, labels * np.log(labels / np.maximum(p, 1e-12)), 0.0)
    return float(terms.sum(axis=1).mean())
