"""Compile a template, and render its blocks."""

from collections.abc import Mapping, Sequence
from typing import Any

from jinja2 import StrictUndefined, TemplateSyntaxError, nodes
from jinja2.nodes import EvalContext
from jinja2.runtime import Context

from harness.core import templates
from harness.prompts.sandbox import Sandbox

# What a block may consist of whose text follows from names that it reads: no call, no assignment, no draw.
PLAIN = (
    nodes.Output, nodes.TemplateData, nodes.Const, nodes.Name, nodes.Getattr, nodes.For, nodes.If,
    nodes.CondExpr, nodes.Filter, nodes.Test, nodes.Compare, nodes.Operand, nodes.Not, nodes.And, nodes.Or,
)  # fmt: skip
FILTERS = ("capitalize", "join", "length", "lower", "replace", "title", "trim", "upper")
MOST_TEXTS = 256  # that are kept of a block

Path = tuple[str, ...]


class Template:
    """A compiled template.

    A block's text is kept where it follows from the actions and a few names alone, as that of most system
    messages does; so it is rendered once.

    Attributes:
        blocks: names of its blocks.
        reads: every name that occurs in it, and so every variable that it reads.
    """

    def __init__(self, text: str) -> None:
        """Compile a template's text. Raises jinja2.TemplateSyntaxError."""
        environment = Sandbox(undefined=StrictUndefined, keep_trailing_newline=False)
        tree = environment.parse(text)
        try:
            paths = {block.name: _paths(block) for block in tree.find_all(nodes.Block)}
            reads = frozenset(node.name for node in tree.find_all(nodes.Name))
        except RecursionError:
            raise TemplateSyntaxError("its parts are nested too deeply", 1) from None
        compiled = environment.from_string(tree)  # adds to the tree
        self._empty = compiled.new_context()  # Jinja's own functions and the template's blocks
        self._blocks = compiled.blocks
        self._paths = paths
        self._texts: dict[str, dict[Any, str]] = {name: {} for name in compiled.blocks}
        self.blocks = tuple(compiled.blocks)
        self.reads = reads

    def render(self, variables: Mapping[str, Any], blocks: Sequence[str]) -> list[str]:
        """Render some blocks. May raise any exception, since a template is a program."""
        templates.begin()
        context = None
        rendered = []
        for block in blocks:
            key = _key(variables, self._paths[block]) if block in self._paths else None
            texts = self._texts[block]
            text = texts.get(key)
            if text is None:
                context = context or _context(self._empty, variables)
                text = "".join(self._blocks[block](context))
                if key is not None and len(texts) < MOST_TEXTS:
                    texts[key] = text
            rendered.append(text)
        return rendered


def _context(empty: Context, variables: Mapping[str, Any]) -> Context:
    """Return a new context with these variables. `Template.new_context` takes a fifth of a prompt's time."""
    context = object.__new__(Context)
    vars(context).update(
        vars(empty), vars={}, parent={**empty.parent, **variables}, eval_ctx=EvalContext(empty.environment)
    )
    return context


def _paths(block: nodes.Block) -> tuple[Path, ...] | None:
    """Return the members that a block reads of `graph` and `words`, such as ("graph", "ego", "id").

    None if its text may follow from anything but these and the actions.
    """
    paths, stack = [], list(block.body)
    known = {"actions", "loop"} | {n.name for n in block.find_all(nodes.Name) if n.ctx == "store"}
    while stack:
        node = stack.pop()
        path = _path(node)
        if path and path[0] in ("graph", "words"):
            paths.append(path)
            continue
        if not isinstance(node, PLAIN) or (isinstance(node, nodes.Name) and node.name not in known):
            return None
        if isinstance(node, nodes.Filter) and node.name not in FILTERS:
            return None
        stack += node.iter_child_nodes()
    return tuple(dict.fromkeys(paths))


def _path(node: nodes.Node) -> Path:
    if isinstance(node, nodes.Name):
        return (node.name,)
    if isinstance(node, nodes.Getattr) and (before := _path(node.node)):
        return (*before, node.attr)
    return ()


def _key(variables: Mapping[str, Any], paths: Sequence[Path] | None) -> Any:
    """Return the actions and the texts at these paths; None if something else is there."""
    if paths is None or type(variables["actions"]) is not tuple:
        return None
    key: list[Any] = [variables["actions"]]
    for path in paths:
        value: Any = variables
        for name in path:
            if type(value) is not dict or name not in value:
                return None
            value = value[name]
        if type(value) is not str:
            return None
        key.append(value)
    return tuple(key)
