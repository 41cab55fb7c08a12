"""What a viewer is asked, and what its answer is worth: texts in, rewards out."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from harness.core import noise
from harness.core.errors import UserError, printable, unknown
from harness.core.seeds import purpose
from harness.dataset.load import Dataset, Scene
from harness.evaluate.agent import in_mode
from harness.learning.values import Values, optimal
from harness.parsing.parse import parse
from harness.prompts import readout
from harness.prompts.versions import Prompt, load, unfit
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

Form = Literal["json", "readout"]
ANY = "any"  # the viewer is drawn among all


@dataclass(frozen=True)
class Asking:
    """How viewers are asked: alone, without messages of others."""

    scenario: Scenario
    prompt: Prompt
    answer: Form = "json"  # `json`, or `readout`: one letter

    def __post_init__(self) -> None:
        version = printable(self.prompt.version)
        if self.answer not in get_args(Form):
            raise unknown("answer", str(self.answer), get_args(Form))
        if self.prompt.image:
            raise UserError(f"prompt {version} shows pictures, and here are texts alone; give another")
        if reason := unfit(self.prompt, self.scenario):
            raise UserError(f"prompt {version} {reason}; give another, such as {self.scenario.prompt}")

    @classmethod
    def of(cls, scenario: Scenario, prompt: str | None, answer: str) -> "Asking":
        """Ask by a prompt version, the scenario's own for None. Raises UserError if that cannot be."""
        return cls(scenario, load(prompt or scenario.prompt), answer)  # type: ignore[arg-type]

    def chat(self, graph: SceneGraph) -> list[dict[str, str]]:
        """Return the chat messages about a viewer's scene graph."""
        actions, words = self.scenario.actions, self.scenario.prompt_words
        sent = self.prompt.render(graph, actions, (), words, letter=self.answer == "readout")
        return [{**m} for m in in_mode(self.answer, self.prompt, sent, graph, actions, words)]

    def read_by(self, role: str) -> dict[str, Any]:
        """Return how answers in a role are read: arguments of `intent`, as plain values."""
        shape = self.prompt.shape(role, self.scenario.actions)
        return {
            "answer": self.answer, "role": role, "actions": list(shape.actions), "form": shape.form,
            "extension": shape.extension, "reasons_first": role in self.prompt.reasons_first,
        }  # fmt: skip


def viewer_of(scene: Scene, viewer: str | None, draw: float) -> str:
    """Return who is asked: a viewer by id, the ego for None, one of all by a uniform draw for `any`."""
    return scene.viewers[int(draw * len(scene.viewers))] if viewer == ANY else scene.viewer(viewer)


def rows(
    data: Dataset, values: Values, asking: Asking, viewer: str | None, per_level: int
) -> Iterator[dict[str, Any]]:
    """Yield a question a row: up to so many decision points of each level of each tree, drawn by layout.

    So the levels of a layout weigh alike, as an episode passes one point of each. Points that are lost are
    left out. A row has `prompt` (chat messages), and all that `expected_value` needs.
    """
    forest = data.forest
    sizes = zip(data.seeds, np.bincount(forest.tree).tolist(), strict=True)
    draws = np.concatenate([noise.uniforms((n,), "rows", data.scenario.name, seed) for seed, n in sizes])
    levels = forest.tree * (int(forest.step.max()) + 1) + forest.step
    order = np.lexsort((draws, levels))
    order = order[~values.lost[order]]
    first = np.searchsorted(levels[order], levels[order])
    chosen = np.sort(order[np.arange(len(order)) - first < per_level])
    for at, scene in zip(chosen.tolist(), data.scenes([forest.ids[n] for n in chosen]), strict=True):
        seed = int(forest.seeds[forest.tree[at]])
        name = viewer_of(scene, viewer, float(noise.uniforms((), "viewer", scene.id)))
        graph = scene.graphs[name]
        yield {
            "prompt": asking.chat(graph), "scene": scene.id, "viewer": name,
            "values": values.table[at].tolist(), "optimal": optimal(values.table[at]).tolist(),
            "scenario": data.scenario.name, "layout_seed": seed, "purpose": purpose(seed, 1),
            "danger": forest.dangers[forest.tree[at]] is not None, **asking.read_by(graph.role),
        }  # fmt: skip


def intent(
    text: str, *, answer: str, role: str, actions: Sequence[str], form: str | None = None,
    extension: str = "", reasons_first: bool = False,
) -> tuple[float, ...] | None:  # fmt: skip
    """Return the distribution (A,) that an answer states; None if it cannot be read."""
    if answer == "readout":
        letter = readout.spelt(text)[:1]
        letters = readout.letters(actions)
        known = letter and letter in letters and not readout.spelt(text)[1:2].isalnum()
        return tuple(float(each == letter) for each in letters) if known else None
    return parse(
        text, role=role, actions=tuple(actions), form=form, extension=extension, reasons_first=reasons_first
    ).intent


def worth(text: str, values: Sequence[float], **read_by: Any) -> float:
    """Return the expected value of the distribution that an answer states; 0 if it cannot be read.

    An answer that cannot be read drives nobody. `values` has the worth of each action, (A,).
    """
    p = intent(text, **read_by)
    return 0.0 if p is None else float(np.dot(p, values))


READ_BY = ("answer", "role", "actions", "form", "extension", "reasons_first")


def expected_value(
    prompts: Sequence[Any], completions: Sequence[Any], *, values: Sequence[Sequence[float]], **columns: Any
) -> list[float]:
    """Return the reward of each completion: a reward function of TRL's trainers.

    Args:
        prompts: as the trainer has them; not read.
        completions: texts, or chats whose last message is the answer.
        values: like the further columns, those of the rows that the prompts are from.
        columns: the further columns of `rows`; others are left alone.
    """
    texts = [each if isinstance(each, str) else each[-1]["content"] for each in completions]
    read_by = ({name: columns[name][n] for name in READ_BY} for n in range(len(texts)))
    return [worth(text, v, **read) for text, v, read in zip(texts, values, read_by, strict=True)]
