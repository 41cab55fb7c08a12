"""What each viewer of each scene is asked, and what it should have intended."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.core import noise as luck
from harness.core.arrays import Floats
from harness.dataset.load import Dataset, Scene
from harness.prompts.versions import NO_WORDS, Prompt
from harness.training.answers import message
from harness.training.teacher import labels

ARRIVES = 0.85  # probability that a helper's message is in the ego's prompt


@dataclass(frozen=True)
class Question:
    """One prompt.

    Attributes:
        key: scene, viewer and prompt version, and `+m` where messages are in it.
        prompt: which version.
        graph: the viewer's scene graph.
        messages: chat messages.
        label: soft label, (A,).
    """

    key: str
    prompt: Prompt
    graph: Mapping[str, Any]
    messages: tuple[Mapping[str, str], ...]
    label: Floats


def alone(dataset: Dataset, prompts: Sequence[Prompt]) -> Iterator[Question]:
    """Every viewer on its own."""
    for scene, label in zip(dataset.scenes, labels(dataset), strict=True):
        for viewer, graph in scene.record["graphs"].items():
            for prompt in prompts:
                sent = prompt.render(graph, dataset.actions, words=dataset.scenario.words)
                yield Question(_key(scene, viewer, prompt), prompt, graph, sent, label)


def excerpts(
    questions: Sequence[Question], actions: tuple[str, ...], words: Mapping[str, str] = NO_WORDS
) -> Iterator[Question]:
    """The same questions with nothing in them but the conflicts; those that have any."""
    for q in questions:
        if q.graph["conflicts"]:
            graph = {**q.graph, "nodes": [], "sectors": []}
            yield replace(q, graph=graph, messages=q.prompt.render(graph, actions, words=words))


def with_messages(
    dataset: Dataset, prompts: Sequence[Prompt], intents: Mapping[str, Floats]
) -> Iterator[Question]:
    """The ego with what some of its helpers sent; `intents` are the helpers' read-outs, by key."""
    for scene, label in zip(dataset.scenes, labels(dataset), strict=True):
        graphs = scene.record["graphs"]
        ego, *helpers = scene.viewers
        for prompt in prompts:
            lucky = luck.uniforms((len(helpers),), "arrives", scene.record["episode_seed"], scene.id)
            heard = [h for h, u in zip(helpers, lucky, strict=True) if u < ARRIVES]
            said = [
                {"sender": h, **message(graphs[h], intents[_key(scene, h, prompt)], dataset.actions)}
                for h in heard
            ]
            if said:
                sent = prompt.render(graphs[ego], dataset.actions, said, dataset.scenario.words)
                yield Question(f"{_key(scene, ego, prompt)}+m", prompt, graphs[ego], sent, label)


def split(dataset: Dataset, held_out: int) -> tuple[Dataset, Dataset]:
    """All but the last `held_out` episodes, and those."""
    episodes = sorted({s.record["episode"] for s in dataset.scenes})
    last = set(episodes[len(episodes) - held_out :])
    parts: tuple[list[Scene], list[Scene]] = ([], [])
    for scene in dataset.scenes:
        parts[scene.record["episode"] in last].append(scene)
    kept, apart = (Dataset(dataset.path, dataset.manifest, dataset.sha256, tuple(scenes)) for scenes in parts)
    return kept, apart


def _key(scene: Scene, viewer: str, prompt: Prompt) -> str:
    return f"{scene.id}/{viewer}/{prompt.version}"


def kl_nats(labels: Floats, p: Floats) -> float:
    """Mean KL divergence of answers (n, A) from soft labels (n, A)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(labels > 0, labels * np.log(labels / np.maximum(p, 1e-12)), 0.0)
    return float(terms.sum(axis=1).mean())
