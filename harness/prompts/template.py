"""Compile a template, and render its blocks."""

from collections.abc import Mapping, Sequence
from typing import Any

from jinja2 import StrictUndefined, TemplateSyntaxError, nodes
from jinja2.nodes import EvalContext
from jinja2.runtime import Context

from harness.core import templates
from harness.prompts.sandbox import Sandbox


class Template:
    """Hold a compiled prompt template.

    A block is a named part of it, such as the system message.

    Attributes:
        blocks: names of its blocks.
        reads: every name that occurs in it, and so every variable that it reads.
    """

    def __init__(self, text: str) -> None:
        """Compile a template's text. Raises jinja2.TemplateSyntaxError."""
        environment = Sandbox(undefined=StrictUndefined, keep_trailing_newline=False)
        tree = environment.parse(text)
        try:
            self.reads = frozenset(node.name for node in tree.find_all(nodes.Name))
        except RecursionError:
            raise TemplateSyntaxError("its parts are nested too deeply", 1) from None
        compiled = environment.from_string(tree)  # adds to the tree
        self._empty = compiled.new_context()  # Jinja's own functions and the template's blocks
        self._blocks = compiled.blocks
        self.blocks = tuple(compiled.blocks)

    def render(self, variables: Mapping[str, Any], blocks: Sequence[str]) -> list[str]:
        """Render some blocks (named parts) of the template, and return their texts in that order.

        `variables` has the values that the template can read, by name. May raise any exception,
        since a template is a program.
        """
        templates.begin()
        # `Template.new_context` takes a quarter of a prompt's time
        context = object.__new__(Context)
        vars(context).update(
            vars(self._empty),
            vars={},
            parent={**self._empty.parent, **variables},
            eval_ctx=EvalContext(self._empty.environment),
        )
        texts = ["".join(self._blocks[block](context)) for block in blocks]
        if not all(map(_is_written, texts)):
            raise ValueError(
                "it writes half of a surrogate pair, which no file and no server can hold"
            )
        return texts


def _is_written(text: str) -> bool:
    try:
        return text.isascii() or bool(text.encode())
    except UnicodeEncodeError:
        return False
