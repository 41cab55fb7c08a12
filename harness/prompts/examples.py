"""Few-shot examples of a prompt version: earlier turns of the chat with the right answers.

They are in the version's `examples.json`. Their layouts have train seeds,
so that no result is reported on a layout that a model was shown.
"""

from collections.abc import Sequence
from typing import Any

import msgspec
from msgspec import Struct

from harness.core.config import convert, json_loads
from harness.core.errors import UserError
from harness.core.files import sha256_bytes
from harness.core.seeds import FIRST
from harness.world.scene_graph import SceneGraph

EXAMPLES = "examples.json"


class Example(Struct, frozen=True):
    """Hold one few-shot example: an earlier turn of the chat with the right answer.

    `layout_seed` is the seed of the drawn start situation that it comes from, `graph` what the
    vehicle that is asked sees there, and `answer` the text that the model should have given.
    """

    layout_seed: int  # seed of the layout that it comes from
    graph: SceneGraph  # the viewer's scene graph, which the version's template renders
    answer: str  # the answer that the model should have given


class Examples(Struct, frozen=True):
    """Hold the few-shot examples of a prompt version by role, in the order they are shown in.

    A few-shot example is an earlier turn of the chat with the right answer; those of `ego` ask the
    ego, those of `helper` a helper. `scenario` names the kind of traffic situation that they come
    from, the only one in which they may be shown, unless `everywhere` is true.
    """

    # the scenario that they come from, and the only one in which they may be shown, unless
    # `everywhere`
    scenario: str
    ego: tuple[Example, ...] = ()  # examples with a question to the ego
    helper: tuple[Example, ...] = ()  # examples with a question to a helper
    # whether they may be shown in every scenario, since neither their text nor their answers depend
    # on it
    everywhere: bool = False

    def of(self, role: str) -> tuple[Example, ...]:
        return self.ego if role == "ego" else self.helper

    def only(self, numbers: Sequence[int]) -> "Examples | None":
        """Return the examples with these numbers, counted from 1, of each role, in this order.

        None if `numbers` is empty.
        """
        if not numbers:
            return None
        ego = tuple(self.of("ego")[number - 1] for number in numbers)
        helper = tuple(self.of("helper")[number - 1] for number in numbers)
        return msgspec.structs.replace(self, ego=ego, helper=helper)

    @property
    def seeds(self) -> frozenset[int]:
        return frozenset(example.layout_seed for example in (*self.ego, *self.helper))

    def __str__(self) -> str:
        listed = ", ".join(map(str, sorted(self.seeds)))
        where = self.scenario + (", for every scenario" if self.everywhere else "")
        pinned = sha256_bytes(text_of(self).encode())[:8]
        return (
            f"{len(self.ego)} ego, {len(self.helper)} helper, {where}, layout seeds {listed}, "
            f"sha256 {pinned}"
        )


def read(text: str, where: str) -> Examples:
    """Parse the JSON text of the file `examples.json` of a prompt version (a folder of templates).

    `where` names the file in messages. Raises UserError if it is no JSON or lacks something, or an
    example asks another role than it is listed under, or comes from a start situation that is not
    for training.
    """
    table = json_loads(text, where)
    if not isinstance(table, dict):
        raise UserError(f"{where} is no object; give scenario, ego and helper")
    examples = convert(table, Examples, where)
    for role in ("ego", "helper"):
        for number, example in enumerate(examples.of(role), 1):
            _check(example, role, f"{where}: {role} example {number}")
    return examples


def _check(example: Example, role: str, what: str) -> None:
    seed = example.layout_seed
    if not FIRST["train"] <= seed < FIRST["report"]:
        raise UserError(
            f"{what} is of layout seed {seed}; examples come from train seeds alone, "
            f"{FIRST['train']} to {FIRST['report'] - 1}: `harness prompt examples` draws such"
        )
    if example.graph.role != role:
        raise UserError(f"{what} has the graph of a viewer whose role is {example.graph.role}")


def text_of(examples: Examples) -> str:
    """Return the text of `examples.json` with these examples, one on each line."""
    lines = [f'{{"scenario": {_json(examples.scenario)}']
    if examples.everywhere:
        lines.append('"everywhere": true')
    for role in ("ego", "helper"):
        items = ",\n".join(map(_json, examples.of(role)))
        lines.append(f'"{role}": [\n{items}\n]')
    return ",\n".join(lines) + "}\n"


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()
