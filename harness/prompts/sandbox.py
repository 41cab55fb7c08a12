"""The environment in which prompt templates are compiled: Jinja's sandbox, narrower, with shorter code."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from jinja2 import nodes
from jinja2.compiler import Frame, optimizeconst
from jinja2.exceptions import SecurityError
from jinja2.runtime import Context, LoopContext

from harness.core import templates

WIDE = re.compile(r"\d{3}|\*")  # in a format: a width of 100 characters or more, or one given as an argument
PADDING = frozenset({"center", "ljust", "rjust", "zfill", "expandtabs", "format", "format_map", "translate"})
# What binds a name to something that a template works out, or works out more than a loop over given things.
BINDING = (
    nodes.Assign, nodes.AssignBlock, nodes.Call, nodes.CallBlock, nodes.Concat, nodes.FilterBlock,
    nodes.Macro, nodes.With,
)  # fmt: skip
# Filters whose result is no larger than their value, whatever small constants they are given.
SHORTENING = frozenset({
    "abs", "capitalize", "d", "default", "first", "float", "int", "last", "length", "lower", "round", "title",
    "trim", "truncate", "upper",
})  # fmt: skip
NUMBERS = frozenset({"float", "int", "length"})  # filters that return one
LONGEST_CHAIN = 3  # filters one after another that need not pay
SHORT = 32  # most items of a loop whose places are made beforehand


@dataclass(frozen=True, slots=True)
class Place:
    """What a loop says of itself at one item, where a template asks for these alone."""

    index: int
    index0: int
    first: bool
    last: bool


LOOP = frozenset(Place.__dataclass_fields__)


class Code(templates.Code):
    """Jinja's compiler with shorter code for what prompts do most; every template renders the same text.

    `_at` is a variable of the code, which no template can name.
    """

    @optimizeconst
    def visit_Getattr(self, node: nodes.Getattr, frame: Frame) -> None:
        # The first cases of `Sandbox.getattr`, without the call.
        of_loop = _is_loop(node.node) and node.attr in LOOP
        self.write(f"(_at.{node.attr}" if of_loop else f"(_at[{node.attr!r}]")
        self.write(" if type(_at := ")
        self.visit(node.node, frame)
        self.write(") is Place" if of_loop else f") is dict and {node.attr!r} in _at")
        self.write(f" else environment.getattr(_at, {node.attr!r}))")

    @optimizeconst
    def visit_Filter(self, node: nodes.Filter, frame: Frame) -> None:
        rounded = node.node
        if not (_bare(node, "int") and isinstance(rounded, nodes.Filter) and _bare(rounded, "round")):
            super().visit_Filter(node, frame)
            return
        assert rounded.node is not None
        self.write("(round(_at) if type(_at := ")
        self.visit(rounded.node, frame)
        self.write(") is float and -1e15 < _at < 1e15 else environment.whole(_at))")

    def visit_Output(self, node: nodes.Output, frame: Frame) -> None:
        escapes = frame.eval_ctx.volatile or frame.eval_ctx.autoescape
        if frame.buffer is not None or frame.require_output_check or escapes:
            super().visit_Output(node, frame)
            return
        # One text in place of one for each part. Python compiles a `%` of a constant as it does an f-string.
        data = [part.data if isinstance(part, nodes.TemplateData) else None for part in node.nodes]
        text = "".join("%s" if part is None else part.replace("%", "%%") for part in data)
        self.writeline(f"yield {text!r} % (", node)
        for part in node.nodes:
            if not isinstance(part, nodes.TemplateData):
                self._side(part, "read", frame)
                self.write(", ")
        self.write(")")


def _is_path(node: nodes.Node) -> bool:
    return isinstance(node, nodes.Name) or (isinstance(node, nodes.Getattr) and _is_path(node.node))


def _is_given(node: nodes.Node, chain: int = LONGEST_CHAIN) -> bool:
    """Whether a value is about as small as those that a template is given, in one that binds no name."""
    if isinstance(node, nodes.Filter):
        return node.node is not None and chain > 0 and _keeps_small(node) and _is_given(node.node, chain - 1)
    if isinstance(node, nodes.Or | nodes.And):
        return _is_given(node.left, chain) and _is_given(node.right, chain)
    if isinstance(node, nodes.CondExpr):
        return all(_is_given(way, chain) for way in (node.expr1, node.expr2) if way)
    return isinstance(node, nodes.Const) or _is_path(node)


def _keeps_small(node: nodes.Filter) -> bool:
    name = node.name.removeprefix(templates.FREE)
    if node.kwargs or node.dyn_args or node.dyn_kwargs:
        return False
    if name == "format":
        form = node.node
        narrow = isinstance(form, nodes.Const) and isinstance(form.value, str) and not WIDE.search(form.value)
        return narrow and all(_is_path(value) for value in node.args)
    constants = node.args[1:] if name == "truncate" else node.args  # whatever its length, it adds no more
    if not all(isinstance(value, nodes.Const) for value in constants):
        return False
    given = [value.as_const() for value in constants]
    if name == "replace":
        return (
            len(given) == 2
            and all(isinstance(x, str) and x for x in given)
            and len(given[0]) >= len(given[1])
        )
    if name == "join":
        return len(given) <= 1 and all(isinstance(x, str) and len(x) < 8 for x in given)
    return name in SHORTENING and all(not isinstance(x, int) or 0 <= x < 1000 for x in given)


def _is_loop(node: nodes.Node) -> bool:
    return isinstance(node, nodes.Name) and node.name == "loop"


def _bare(node: nodes.Filter, name: str) -> bool:
    """Return whether a filter is the one of this name, without arguments, and applied to an expression."""
    given = node.args or node.kwargs or node.dyn_args or node.dyn_kwargs
    return node.name.removeprefix(templates.FREE) == name and not given and node.node is not None


@lru_cache(maxsize=SHORT + 1)
def _places(n: int) -> tuple[Place, ...]:
    return tuple(Place(i + 1, i, i == 0, i == n - 1) for i in range(n))


def placed(items: Any, undefined: Any) -> Iterable[tuple[Any, Any]]:
    """Return items with their places, as `LoopContext` does for loops that are asked for no more."""
    if type(items) in (list, tuple) and len(items) <= SHORT:
        return zip(items, _places(len(items)), strict=True)
    return LoopContext(items, undefined)


class Sandbox(templates.Sandbox):
    """Jinja environment for prompt templates: fewer operators and filters, and shorter code.

    `graph.ego` always means the member of that name; no method of a mapping hides it.
    """

    code_generator_class = Code

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._binds_nothing = False
        for name in ("center", "indent"):
            del self.filters[name]

    def _generate(
        self, source: nodes.Template, name: str | None, filename: str | None, defer_init: bool = False
    ) -> str:
        code = super()._generate(source, name, filename, defer_init)
        read = [node for node in source.find_all(nodes.Getattr) if _is_loop(node.node) and node.attr in LOOP]
        loops = [node for node in source.find_all(nodes.Name) if node.name == "loop"]
        recursive = any(node.recursive for node in source.find_all(nodes.For))
        loop = "LoopContext" if recursive or len(loops) > len(read) else "placed as LoopContext"
        return f"{code}from {__name__} import Place, {loop}\n"

    def _put_steps_into(self, source: nodes.Template) -> None:
        # A template that binds no name can keep nothing, so its texts are as small as what it is given.
        self._binds_nothing = not any(source.find_all(BINDING)) and all(
            _is_path(loop.iter) and not loop.recursive for loop in source.find_all(nodes.For)
        )
        for node in list(source.find_all(nodes.Filter)) if self._binds_nothing else ():
            if _is_given(node):
                node.name = templates.FREE + node.name
        super()._put_steps_into(source)

    def is_small(self, node: nodes.Node) -> bool:
        """Return whether it is known of an expression that its value costs nothing to read."""
        number = isinstance(node, nodes.Filter) and node.name.removeprefix(templates.FREE) in NUMBERS
        return number or super().is_small(node) or (self._binds_nothing and _is_given(node))

    def whole(self, value: Any) -> Any:
        return self.filters["int"](self.filters["round"](value))

    def call_binop(self, context: Context | None, operator: str, left: Any, right: Any) -> Any:
        """Allow products, powers and remainders of numbers only, and only small powers."""
        if operator in ("*", "**", "%"):
            numbers = all(isinstance(side, int | float) for side in (left, right))
            if not numbers or (operator == "**" and not (abs(left) < 1e6 and abs(right) < 64)):
                raise SecurityError(f"{operator} is not allowed on such values")
        return super().call_binop(context, operator, left, right)

    def is_safe_attribute(self, obj: Any, attr: str, value: Any) -> bool:
        return not (isinstance(obj, str) and attr in PADDING) and super().is_safe_attribute(obj, attr, value)

    def getattr(self, obj: Any, attribute: str) -> Any:
        # Nearly all that a template reads is plain data, which needs no check of the sandbox.
        if type(obj) is dict and attribute in obj:
            return obj[attribute]
        if isinstance(obj, str) and attribute in PADDING:
            return self.unsafe_undefined(obj, attribute)
        return super().getattr(obj, attribute)
