"""The environment in which prompt templates are compiled:
Jinja's sandbox, narrower, with shorter code.
"""

import re
from typing import Any

from jinja2 import nodes
from jinja2.compiler import Frame, optimizeconst
from jinja2.exceptions import SecurityError
from jinja2.runtime import Context, LoopContext

from harness.core import templates

# in a format: a width of 100 characters or more, or one given as an argument
WIDE = re.compile(r"\d{3}|\*")
PADDING = frozenset(
    {"center", "ljust", "rjust", "zfill", "expandtabs", "format", "format_map", "translate"}
)
# What binds a name to something that a template works out, or works out more than a loop over given
# things.
BINDING = (
    nodes.Assign,
    nodes.AssignBlock,
    nodes.Call,
    nodes.CallBlock,
    nodes.Concat,
    nodes.FilterBlock,
    nodes.Macro,
    nodes.With,
)
# Filters whose result is no larger than their value, whatever small constants they are given.
SHORTENING = frozenset(
    {
        "abs",
        "capitalize",
        "d",
        "default",
        "first",
        "float",
        "int",
        "last",
        "length",
        "lower",
        "round",
        "title",
        "trim",
        "truncate",
        "upper",
    }
)
NUMBERS = frozenset({"float", "int", "length"})  # filters that return one
OF_A_LOOP = frozenset({"first", "index", "index0", "last"})  # what a loop says of its place
LONGEST_CHAIN = 3  # filters one after another that need not pay


class Code(templates.Code):
    """Generate Python code of a prompt template, shorter than Jinja's, with the same result.

    It is shorter for what prompts do most. `_at` is a variable of the generated code, which no
    template can name.
    """

    @optimizeconst
    def visit_Getattr(self, node: nodes.Getattr, frame: Frame) -> None:
        # The first case of `Sandbox.getattr`, without the call.
        self.write(f"(_at[{node.attr!r}] if type(_at := ")
        self.visit(node.node, frame)
        self.write(
            f") is dict and {node.attr!r} in _at else environment.getattr(_at, {node.attr!r}))"
        )

    @optimizeconst
    def visit_Filter(self, node: nodes.Filter, frame: Frame) -> None:
        rounded = node.node
        if not (
            _bare(node, "int") and isinstance(rounded, nodes.Filter) and _bare(rounded, "round")
        ):
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
        # One text in place of one for each part. Python compiles a `%` of a constant as it does an
        # f-string.
        data = [part.data if isinstance(part, nodes.TemplateData) else None for part in node.nodes]
        text = "".join("%s" if part is None else part.replace("%", "%%") for part in data)
        self.writeline(f"yield {text!r} % (", node)
        for part in node.nodes:
            if not isinstance(part, nodes.TemplateData):
                self._part(part, frame)
                self.write(", ")
        self.write(")")

    def _part(self, node: nodes.Expr, frame: Frame) -> None:
        """Write the code of a part of the text; a path may lead to a method, which has no text."""
        if not (_is_path(node) and self.environment.is_small(node)):
            self._side(node, "written", frame)
            return
        self.write("(_at if type(_at := ")
        self.visit(node, frame)
        self.write(") in PLAIN else written(_at))")


def _is_path(node: nodes.Node) -> bool:
    return isinstance(node, nodes.Name) or (isinstance(node, nodes.Getattr) and _is_path(node.node))


def _is_given(node: nodes.Node, chain: int = LONGEST_CHAIN) -> bool:
    """Whether a value is about as small as those that a template is given,
    in one that binds no name.
    """
    if isinstance(node, nodes.Filter):
        return (
            node.node is not None
            and chain > 0
            and _keeps_small(node)
            and _is_given(node.node, chain - 1)
        )
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
        narrow = (
            isinstance(form, nodes.Const)
            and isinstance(form.value, str)
            and not WIDE.search(form.value)
        )
        return narrow and all(_is_path(value) for value in node.args)
    # whatever its length, it adds no more
    constants = node.args[1:] if name == "truncate" else node.args
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


def _bare(node: nodes.Filter, name: str) -> bool:
    """Return whether a filter is the one of this name, without arguments,
    and applied to an expression.
    """
    given = node.args or node.kwargs or node.dyn_args or node.dyn_kwargs
    return node.name.removeprefix(templates.FREE) == name and not given and node.node is not None


class Sandbox(templates.Sandbox):
    """Compile prompt templates with Jinja, with fewer operators and filters than its base class.

    `graph.ego` always means the member of that name; no method of a mapping hides it.
    """

    code_generator_class = Code

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._binds_nothing = False
        for name in ("center", "indent"):
            del self.filters[name]

    def _put_steps_into(self, source: nodes.Template) -> None:
        # A template that binds no name can keep nothing, so its texts are as small as what it is
        # given.
        self._binds_nothing = not any(source.find_all(BINDING)) and all(
            _is_path(loop.iter) and not loop.recursive for loop in source.find_all(nodes.For)
        )
        for node in list(source.find_all(nodes.Filter)) if self._binds_nothing else ():
            if _is_given(node):
                node.name = templates.FREE + node.name
        super()._put_steps_into(source)

    def is_small(self, node: nodes.Node) -> bool:
        """Return whether an expression of a template, `node`, is known to cost nothing to read.

        Such is a number. The rendering's budget of steps, which limits its work, is charged for all
        others.
        """
        number = (
            isinstance(node, nodes.Filter) and node.name.removeprefix(templates.FREE) in NUMBERS
        )
        return number or super().is_small(node) or (self._binds_nothing and _is_given(node))

    def whole(self, value: Any) -> Any:
        return self.filters["int"](self.filters["round"](value))

    def call_binop(self, context: Context | None, operator: str, left: Any, right: Any) -> Any:
        """Compute a binary operator, such as `*`, of `left` and `right` in a prompt template.

        `*`, `**` and `%` are for numbers only, and powers must be small; raises jinja2's
        SecurityError otherwise. Jinja calls it, with the `context` of the rendering.
        """
        if type(left) is float and operator in ("+", "-", "*") and type(right) in (float, int):
            # costs nothing; the rest takes a microsecond
            return self.binop_table[operator](left, right)
        if operator in ("*", "**", "%"):
            numbers = all(isinstance(side, int | float) for side in (left, right))
            if not numbers or (operator == "**" and not (abs(left) < 1e6 and abs(right) < 64)):
                raise SecurityError(f"{operator} is not allowed on such values")
        return super().call_binop(context, operator, left, right)

    def is_safe_attribute(self, obj: Any, attr: str, value: Any) -> bool:
        return not (isinstance(obj, str) and attr in PADDING) and super().is_safe_attribute(
            obj, attr, value
        )

    def getattr(self, obj: Any, attribute: str) -> Any:
        # Nearly all that a template reads is plain data, which needs no check of the sandbox.
        if type(obj) is dict and attribute in obj:
            return obj[attribute]
        if type(obj) is LoopContext and attribute in OF_A_LOOP:
            return getattr(obj, attribute)
        if isinstance(obj, str) and attribute in PADDING:
            return self.unsafe_undefined(obj, attribute)
        return super().getattr(obj, attribute)
