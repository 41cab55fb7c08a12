"""What each viewer of a scene is asked, and what the decision tree says it should have intended.

An action is safe if the episode still succeeds when the driver that sees no more than the ego takes the rest:
what only one who sees everything could still save is not safe for who does not. Each safe action has the
weight exp(-delay / 0.25 s), so that a needless SLOWER counts little; an unsafe one has none. Where IDLE and
FASTER come to the same (at the highest speed level) most goes to IDLE. A viewer that cannot tell scenes apart
is best served by the mean of their labels, so what it cannot see makes it unsure.

Of each level of a tree up to `OF_A_LEVEL` decision points are taken, drawn by the layout: so a model sees the
scenes that its own errors lead to. Those at which nothing is safe any more, 70 % of all, are left out.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.core import noise
from harness.core.arrays import Floats
from harness.dataset.load import Dataset, Scene
from harness.prompts.versions import NO_WORDS, Prompt
from harness.training.answers import message

ARRIVES = 0.85  # probability that a helper's message is in the ego's prompt
TEACHER = "local-view"
SOFTNESS_S = 0.25
OF_A_LEVEL = 6
CALM = {"FASTER": 0.3}  # prior weight of an action, 1 if not named


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


def labels(dataset: Dataset) -> Floats:
    """Soft labels of every decision point, (N, A); NaN where no action is safe."""
    forest = dataset.forest
    last = forest.then(TEACHER)
    safe = forest.succeeds(last, forest.tree[:, None])
    time_s = np.where(safe, forest.cleared_s[last], np.inf)
    prior = np.array([CALM.get(a, 1.0) for a in dataset.actions])
    with np.errstate(invalid="ignore"):  # inf - inf, where no action is safe
        weight = prior * np.exp((time_s.min(axis=1, keepdims=True) - time_s) / SOFTNESS_S)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def taught(dataset: Dataset) -> list[Scene]:
    """The scenes that are learnt from, tree by tree."""
    place, lost = dataset.forest.place, np.isnan(labels(dataset)[:, 0])
    ids = []
    for tree in dataset.trees:
        rng = noise.generator("taught", tree.episode_seed)
        for level in tree.levels:
            some = [point.scene for point in level if not lost[place[point.scene]]]
            ids += [some[n] for n in sorted(rng.permutation(len(some))[:OF_A_LEVEL].tolist())]
    return dataset.scenes(ids)


def alone(dataset: Dataset, scenes: Sequence[Scene], prompts: Sequence[Prompt]) -> Iterator[Question]:
    """Every viewer on its own."""
    for scene, label in _labelled(dataset, scenes):
        for viewer, graph in scene.record["graphs"].items():
            for prompt in prompts:
                sent = prompt.render(graph, dataset.actions, words=dataset.scenario.prompt_words)
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
    dataset: Dataset, scenes: Sequence[Scene], prompts: Sequence[Prompt], intents: Mapping[str, Floats]
) -> Iterator[Question]:
    """The ego with what some of its helpers sent; `intents` are the helpers' read-outs, by key."""
    for scene, label in _labelled(dataset, scenes):
        graphs = scene.record["graphs"]
        ego, *helpers = scene.viewers
        for prompt in prompts:
            draws = noise.uniforms((len(helpers),), "arrives", scene.record["episode_seed"], scene.id)
            heard = [
                {"sender": h, **message(graphs[h], intents[_key(scene, h, prompt)], dataset.actions)}
                for h, u in zip(helpers, draws, strict=True)
                if u < ARRIVES
            ]
            if heard:
                sent = prompt.render(graphs[ego], dataset.actions, heard, dataset.scenario.prompt_words)
                yield Question(f"{_key(scene, ego, prompt)}+m", prompt, graphs[ego], sent, label)


def split(dataset: Dataset, held_out: int) -> tuple[Dataset, Dataset]:
    """All but the last `held_out` episodes, and those."""
    numbers = dataset.episodes
    return dataset.of_episodes(numbers[: len(numbers) - held_out]), dataset.of_episodes(
        numbers[len(numbers) - held_out :]
    )


def _labelled(dataset: Dataset, scenes: Sequence[Scene]) -> Iterator[tuple[Scene, Floats]]:
    of_points = labels(dataset)
    return ((scene, of_points[dataset.forest.place[scene.id]]) for scene in scenes)


def _key(scene: Scene, viewer: str, prompt: Prompt) -> str:
    return f"{scene.id}/{viewer}/{prompt.version}"


def kl_nats(labels: Floats, p: Floats) -> float:
    """Mean KL divergence of answers (n, A) from soft labels (n, A)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(labels > 0, labels * np.log(labels / np.maximum(p, 1e-12)), 0.0)
    return float(terms.sum(axis=1).mean())
