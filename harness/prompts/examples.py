"""Examples: earlier turns of a chat, whose questions are answered as they should be.

They lie in a version's `examples.json`. Their layouts have train seeds, so that no number is reported of what
a model was shown.
"""

from typing import Any

import msgspec
from msgspec import Struct

from harness.core.config import convert
from harness.core.errors import UserError, printable
from harness.core.files import sha256_bytes
from harness.core.seeds import FIRST
from harness.dataset.schema import Graph

EXAMPLES = "examples.json"


class Example(Struct, frozen=True):
    """One earlier turn.

    Attributes:
        layout_seed: of the layout that it is from.
        graph: the viewer's scene graph, which the version's template puts into words.
        answer: what the model should have said.
    """

    layout_seed: int
    graph: dict[str, Any]
    answer: str


class Examples(Struct, frozen=True):
    """The examples of a version, those of each role in the order in which they are shown.

    Attributes:
        scenario: the one that they are from, and the only one in which they may be shown.
        ego: whose questions are the ego's.
        helper: whose questions are a helper's.
    """

    scenario: str
    ego: tuple[Example, ...] = ()
    helper: tuple[Example, ...] = ()

    def of(self, role: str) -> tuple[Example, ...]:
        """Those of a role."""
        return self.ego if role == "ego" else self.helper

    @property
    def seeds(self) -> frozenset[int]:
        """Layout seeds that they are from."""
        return frozenset(example.layout_seed for example in (*self.ego, *self.helper))

    def __str__(self) -> str:
        listed = ", ".join(map(str, sorted(self.seeds)))
        pinned = sha256_bytes(text_of(self).encode())[:8]
        return (
            f"{len(self.ego)} ego, {len(self.helper)} helper, {self.scenario}, layout seeds {listed}, "
            f"sha256 {pinned}"
        )


def read(text: str, where: str) -> Examples:
    """The examples in a file's text.

    Args:
        text: JSON.
        where: what the file is called in messages.

    Raises:
        UserError: it is no JSON, lacks something, or an example is of another role or of no train seed.
    """
    try:
        table = msgspec.json.decode(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where} is no JSON: {printable(error)}; fix the file") from None
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
            f"{what} is of layout seed {seed}; examples come from train seeds alone, {FIRST['train']} to "
            f"{FIRST['report'] - 1}: `harness prompt examples` draws such"
        )
    convert(example.graph, Graph, f"{what}: its graph")
    if example.graph["role"] != role:
        raise UserError(f"{what} has the graph of a viewer whose role is {example.graph['role']}")


def text_of(examples: Examples) -> str:
    """What the file holds, an example a line."""
    lines = [f'{{"scenario": {_json(examples.scenario)}']
    for role in ("ego", "helper"):
        shown = ",\n".join(map(_json, examples.of(role)))
        lines.append(f'"{role}": [\n{shown}\n]')
    return ",\n".join(lines) + "}\n"


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()
