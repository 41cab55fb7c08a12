"""Render Jinja templates of strangers within limits:
none can reach out, run for ever or fill memory.

All that a template does is paid from one account of steps: the nodes of a body each time it runs,
the texts that an operation, a filter or a call reads and makes. What could be large is paid before
it is made, since nothing can stop a single operation of Python. So the limit needs no clock, and a
template that renders on one machine renders on every other.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from itertools import chain
from threading import local
from types import (
    BuiltinFunctionType,
    CodeType,
    FunctionType,
    GeneratorType,
    MappingProxyType,
    MethodType,
)
from typing import Any

from jinja2 import Environment, Template, TemplateSyntaxError, nodes
from jinja2.compiler import CodeGenerator, Frame, operators, optimizeconst
from jinja2.exceptions import SecurityError
from jinja2.filters import do_format, do_join, do_replace, make_attrgetter
from jinja2.nodes import EvalContext
from jinja2.runtime import Context, LoopContext
from jinja2.sandbox import ImmutableSandboxedEnvironment
from jinja2.utils import (
    Cycler,
    Joiner,
    Namespace,
    generate_lorem_ipsum,
    pass_environment,
    pass_eval_context,
)

MOST_STEPS = 1_000_000  # of one rendering; a prompt that ships takes 2 000 at most
MOST_TEXT = 200_000  # characters of a template
_MOST_BITS = 4096  # of a whole number
_SHORT = 64  # characters of a text that is not counted
# In a format, a width or precision of 100 or more, or one that is an argument.
_WIDE = re.compile(r"%[-+ #0]*(?:\d{3}|\d*\.?\*|\d*\.\d{3})|\{[^{}]*(?:\d{3}|\{)")
_NAMED_WIDE = re.compile(r"\d{3}|\*")  # in one with `%(name)`, whose name may hold anything
FREE = "free "  # prefix of the name of a filter that pays nothing
# name of the node that pays; as those with the prefix, no template can write it
_STEP = "spent step"

_VIEWS: tuple[type[Any], ...] = (type({}.keys()), type({}.values()), type({}.items()))
_LISTS: tuple[type[Any], ...] = (list, tuple, set, frozenset, range, *_VIEWS)
_MAPPINGS = (dict, MappingProxyType)
_FUNCTIONS = (FunctionType, BuiltinFunctionType, MethodType)
_ADDRESSED = (GeneratorType, Cycler, Joiner)  # beside these, whose text is where they lie in memory
_SMALL = frozenset({float, bool, type(None)})
PLAIN = _SMALL | {str, int, dict}  # what nearly all that a prompt writes is of
# Filters that read one thing of a value, whatever its size.
_FREE = frozenset({"attr", "count", "d", "default", "first", "last", "length"})
# Filters whose result may be as large as the value times an argument.
_GROWING = frozenset(
    {"batch", "center", "indent", "round", "slice", "tojson", "urlize", "wordwrap"}
)
# Filters whose time may grow with the square of the value.
_SLOW = frozenset({"pprint", "striptags", "urlize", "wordwrap", "xmlattr"})
# Tests that read the whole of a value.
_READING = frozenset(
    {
        "!=",
        "<",
        "<=",
        "==",
        ">",
        ">=",
        "eq",
        "equalto",
        "ge",
        "greaterthan",
        "gt",
        "in",
        "le",
        "lessthan",
        "lower",
        "lt",
        "ne",
        "upper",
    }
)
_PADDING = frozenset({"center", "expandtabs", "ljust", "rjust", "zfill"})
_DEEPEST_INDENT = 64  # of JSON: its lines are indented by a multiple of it
_WITH_LENGTH = (str, bytes, list, tuple, dict)


class TooMuch(SecurityError):
    """Report that a template exceeds its limit of steps or memory; the message says which."""

    def __init__(self, what: str = f"more than {MOST_STEPS:,} steps and characters") -> None:
        super().__init__(what)


class Unwritten(SecurityError):
    """Report that a template writes an object whose text is its memory address.

    Such a text would differ in every process.
    """

    def __init__(self, thing: object) -> None:
        super().__init__(f"a {type(thing).__name__} has no text; call it, or write what it makes")


class _Account(local):
    """The steps that a thread's rendering has left, and whether it compiles a template instead."""

    left, compiles = MOST_STEPS, False


_account = _Account()


def begin() -> None:
    """Give the template rendering that begins in this thread its full budget of work.

    It is `MOST_STEPS` steps; a step is one item that the template reads, or eight characters.
    """
    _account.left = MOST_STEPS


def spend(steps: int) -> bool:
    """Charge steps to the budget of the template rendering that runs in this thread.

    The budget limits the work of one rendering; a step is one item that is read, or eight
    characters. Raises TooMuch if the budget has fewer left. Returns True, so that it can stand in
    an expression.
    """
    _account.left -= steps
    if _account.left < 0:
        raise TooMuch
    return True


def read(value: Any) -> Any:
    """Return a value that a template reads, after charging its budget for the value's size.

    The budget is a number of steps that limits the work of one rendering.
    """
    if type(value) not in _SMALL and not (type(value) is str and len(value) < _SHORT):
        spend(_size(value))
    return value


def written(value: Any) -> Any:
    """Return a value that a template writes, after charging its budget for the value's size.

    The budget is a number of steps that limits the work of one rendering. Raises Unwritten if the
    value's text is its memory address, which differs in every process.
    """
    if isinstance(value, _ADDRESSED):
        raise Unwritten(value)
    return read(value)


def looked_in(value: Any) -> Any:
    """Return a container that a template searches (`in`), after charging for the search.

    The rendering's budget of steps, which limits its work, is charged with the container's length;
    a mapping costs nothing.
    """
    return value if isinstance(value, _MAPPINGS) else read(value)


def _size(value: Any) -> int:
    """Return what reading the whole of a value costs:
    1, and 1 for each 8 characters and for each item.

    A list that is there several times counts as often, as in its text.
    Raises TooMuch if it is too large, and Unwritten for a function.
    """
    most, total, unread = _account.left, 0, [value]
    while unread:
        item = unread.pop()
        total += 1
        if isinstance(item, str | bytes):
            total += len(item) >> 3
        elif isinstance(item, _FUNCTIONS):
            raise Unwritten(item)
        elif isinstance(item, int):
            total += item.bit_length() >> 6
        elif isinstance(item, _LISTS):
            if total + len(item) <= most:
                unread.extend(item)
            total += len(item)
        elif (members := _members(item)) is not None:
            if total + len(members) <= most:
                unread += chain(members, members.values())
            total += len(members)
        if total > most:
            raise TooMuch
    return total


def _members(value: Any) -> Mapping[Any, Any] | None:
    """Return what a mapping or one of Jinja's own objects holds; None for anything else."""
    if isinstance(value, _MAPPINGS):
        return value
    if isinstance(value, Namespace):
        held: Mapping[Any, Any] = object.__getattribute__(value, "_Namespace__attrs")
        return held
    return vars(value) if isinstance(value, Cycler | Joiner) else None


def _extent(value: Any) -> int:
    """Return how many times an argument can make a value larger."""
    if isinstance(value, bool):
        return 0
    if isinstance(value, int | float):
        return int(min(abs(value), MOST_STEPS + 1))
    return len(value) if isinstance(value, str) else _size(value)


def _charged(value: Any) -> Any:
    """Return a result after paying for it;
    items that are made one by one are paid for as they come.
    """
    if isinstance(value, str | bytes):
        spend(len(value) >> 3)
    elif isinstance(value, _WITH_LENGTH):
        spend(len(value))
    elif isinstance(value, int):
        _hold(value.bit_length())
    elif isinstance(value, Iterator) and not isinstance(value, LoopContext):
        return _one_by_one(value)
    return value


def _one_by_one(items: Iterable[Any]) -> Iterator[Any]:
    for item in items:
        spend(1 + _size(item))
        yield item


def _hold(bits: int) -> None:
    if bits > _MOST_BITS:
        raise TooMuch(f"a number of more than {_MOST_BITS} bits")


def _formatted(text: str, *values: Any) -> None:
    """Pay for a text into which values are written."""
    if _WIDE.search(text) or ("%(" in text and _NAMED_WIDE.search(text)):
        raise TooMuch(f"a format as wide as {text[:40]!r}")
    places = 1 + text.count("%") + text.count("{")
    spend((places + (len(text) >> 3)) * sum(map(_size, values)))


def _replaced(text: str, old: str, new: str) -> None:
    spend((len(text) + (text.count(old) if old else len(text) + 1) * len(new)) >> 3)


def _filter(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    at = int(hasattr(function, "jinja_pass_arg"))  # the context comes before the value

    @wraps(function)
    def paid(*given: Any, **named: Any) -> Any:
        value, arguments = given[at], [*given[at + 1 :], *named.values()]
        if not arguments and (
            type(value) in _SMALL or (type(value) is str and len(value) < _SHORT)
        ):
            return function(*given)
        size = _size(value)
        if name in _GROWING:
            extent = sum(map(_extent, arguments))
            if name == "tojson" and extent > _DEEPEST_INDENT:
                raise TooMuch(f"JSON indented by more than {_DEEPEST_INDENT}")
            spend(size * (1 + extent))
        else:
            spend(size + sum(map(_size, arguments)))
        if name in _SLOW:
            spend(size * size)
        return _charged(function(*given, **named))

    return paid


def _test(function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def paid(*given: Any) -> Any:
        for value in given:
            read(value)
        return function(*given)

    return paid


@pass_eval_context
def _replace(context: EvalContext, s: Any, old: Any, new: Any, count: int | None = None) -> Any:
    _replaced(*(str(read(text)) for text in (s, old, new)))
    return do_replace(context, s, old, new, count)


@pass_eval_context
def _join(context: EvalContext, value: Any, d: Any = "", attribute: Any = None) -> Any:
    items = list(_one_by_one(_of_each(context.environment, value, attribute)))
    spend(len(items) * (1 + (len(str(read(d))) >> 3)))
    return do_join(context, items, d)


@pass_environment
def _sum(environment: "Sandbox", iterable: Any, attribute: Any = None, start: Any = 0) -> Any:
    if isinstance(start, str):
        raise TypeError("sum() adds numbers and lists; use join for texts")
    total = start
    for item in _of_each(environment, iterable, attribute):
        spend(1)
        total = environment.call_binop(None, "+", total, item)
    return total


def _of_each(environment: Environment, values: Iterable[Any], attribute: Any) -> Iterable[Any]:
    return values if attribute is None else map(make_attrgetter(environment, attribute), values)


def _format(text: Any, *values: Any, **named: Any) -> Any:
    _formatted(str(read(text)), *values, *named.values())
    return do_format(text, *values, **named)


def _lorem_ipsum(n: int = 5, html: bool = True, min: int = 20, max: int = 100) -> Any:
    spend((1 + _extent(n)) * (1 + _extent(max)))
    return generate_lorem_ipsum(n, html, min, max)


class _Namespace(Namespace):
    """A namespace whose text does not grow with what it holds."""

    def __repr__(self) -> str:
        return "<namespace>"


class Code(CodeGenerator):
    """Generate Python code of a Jinja template which counts the steps that it takes.

    What it reads, joins and repeats is charged to the rendering's budget of steps. `environment` is
    the sandbox that the template is compiled in, which Jinja sets.
    """

    environment: "Sandbox"  # the environment that compiles the template

    @optimizeconst
    def visit_Filter(self, node: nodes.Filter, frame: Frame) -> None:
        if node.name == _STEP:
            self.write(f"spend({node.args[0].as_const()})")
        else:
            super().visit_Filter(node, frame)

    @optimizeconst
    def visit_Concat(self, node: nodes.Concat, frame: Frame) -> None:
        marked = "(markup_join if context.eval_ctx.volatile else str_join)"
        escapes = "markup_join" if frame.eval_ctx.autoescape else "str_join"
        self.write(f"{marked if frame.eval_ctx.volatile else escapes}((")
        for part in node.nodes:
            self._side(part, "written", frame)
            self.write(", ")
        self.write("))")

    @optimizeconst
    def visit_Compare(self, node: nodes.Compare, frame: Frame) -> None:
        self.write("(")
        sides = [node.expr, *(operand.expr for operand in node.ops)]
        plain = len(sides) == 2 and _is_constant(sides[1])
        plain |= (
            len(sides) == 2 and _is_constant(sides[0]) and node.ops[0].op not in ("in", "notin")
        )
        self._side(sides[0], "" if plain else "read", frame)
        for operand in node.ops:
            within = operand.op in ("in", "notin")
            self.write(f" {operators[operand.op]} ")
            self._side(operand.expr, "" if plain else "looked_in" if within else "read", frame)
        self.write(")")

    def _side(self, node: nodes.Expr, function: str, frame: Frame) -> None:
        self.write("(" if self.environment.is_small(node) else f"{function}(")
        self.visit(node, frame)
        self.write(")")

    @optimizeconst
    def visit_Getitem(self, node: nodes.Getitem, frame: Frame) -> None:
        sliced = isinstance(node.arg, nodes.Slice)
        self.write("made(" if sliced else "")
        super().visit_Getitem(node, frame)
        self.write(")" if sliced else "")

    def visit_Dict(self, node: nodes.Dict, frame: Frame) -> None:
        self.write("{")
        for pair in node.items:
            self._side(pair.key, "read", frame)
            self.write(": ")
            self.visit(pair.value, frame)
            self.write(", ")
        self.write("}")


def _is_constant(node: nodes.Node) -> bool:
    """Return whether an expression is a literal: a text, a number, or a list of these."""
    items = node.items if isinstance(node, nodes.List | nodes.Tuple) else [node]
    return all(isinstance(item, nodes.Const) for item in items)


def _cost(body: Iterable[nodes.Node]) -> int:
    """Return the steps of some statements: a node each, and their text."""
    steps, unread = 1, list(body)
    while unread:
        node = unread.pop()
        # of the template, of a constant
        text = getattr(node, "data", None) or getattr(node, "value", None)
        steps += 1 + (len(text) >> 3 if isinstance(text, str) else 0)
        unread += node.iter_child_nodes()
    return steps


class Bounded(Template):
    """Hold a compiled template, each of whose renderings begins with the full budget of steps.

    A step is one item that a rendering reads, or eight characters; the budget is `MOST_STEPS`.
    """

    def render(self, *given: Any, **named: Any) -> str:
        begin()
        return super().render(*given, **named)


class Sandbox(ImmutableSandboxedEnvironment):
    """Compile untrusted Jinja templates; each rendering is limited to `MOST_STEPS` steps.

    Compiling raises jinja2.TemplateSyntaxError for an invalid template and for one that is too
    long.
    """

    intercepted_binops = frozenset(ImmutableSandboxedEnvironment.default_binop_table)
    code_generator_class = Code
    template_class = Bounded

    def __init__(self, **options: Any) -> None:
        super().__init__(finalize=written, **options)
        own_filters = {"format": _format, "join": _join, "replace": _replace, "sum": _sum}
        for name, function in list(self.filters.items()):
            self.filters[f"{FREE}{name}"] = function
            self.add_filter(name, own_filters.get(name, function))
        tests: dict[str, Any] = {**self.tests}
        self.tests = {
            name: _test(test) if name in _READING else test for name, test in tests.items()
        }
        self.globals |= {"lipsum": _lorem_ipsum, "namespace": _Namespace}

    def add_filter(self, name: str, function: Callable[..., Any]) -> None:
        self.filters[name] = function if name in _FREE else _filter(name, function)

    def _parse(self, source: str, name: str | None, filename: str | None) -> nodes.Template:
        if len(source) > MOST_TEXT:
            raise TemplateSyntaxError(
                f"it has {len(source):,} characters; allowed: {MOST_TEXT:,}", 1
            )
        try:
            return super()._parse(source, name, filename)
        except RecursionError:
            raise TemplateSyntaxError("its expressions are nested too deeply", 1) from None

    def _generate(
        self,
        source: nodes.Template,
        name: str | None,
        filename: str | None,
        defer_init: bool = False,
    ) -> str:
        # So that no filter is applied to a constant, where nothing pays for it, and no method
        # becomes one.
        _account.left, _account.compiles = 0, True
        try:
            self._put_steps_into(source)
            code = super()._generate(source, name, filename, defer_init)
        except RecursionError:
            raise TemplateSyntaxError("its parts are nested too deeply", 1) from None
        finally:
            _account.compiles = False
        # At the end, so that lines keep their numbers.
        return (
            f"{code}\nfrom {__name__} import PLAIN, _charged as made, looked_in, read, spend, "
            "written\n"
        )

    def is_small(self, node: nodes.Node) -> bool:
        """Return whether reading an expression of a template costs nothing: it is a constant.

        `node` is the expression. The code that is generated for all others charges the budget of
        steps that limits a rendering's work.
        """
        return isinstance(node, nodes.Const)

    def _put_steps_into(self, source: nodes.Template) -> None:
        """Let each body pay whenever it runs."""
        kinds = (nodes.For, nodes.Macro, nodes.CallBlock, nodes.Block)
        bodies: list[Any] = list(source.find_all(kinds))
        for node in bodies:
            if isinstance(node, nodes.For) and node.test is not None:
                node.test = nodes.And(self._step([node.test]), node.test, lineno=node.lineno)
            node.body.insert(0, nodes.ExprStmt(self._step(node.body), lineno=node.lineno))

    def _step(self, body: Iterable[nodes.Node]) -> nodes.Filter:
        cost = nodes.Const(_cost(body))
        return nodes.Filter(nodes.Const(True), _STEP, [cost], [], None, None, environment=self)

    def _compile(self, source: str, filename: str) -> CodeType:
        try:
            return super()._compile(source, filename)
        except (SyntaxError, RecursionError, MemoryError, ValueError):
            raise TemplateSyntaxError("its parts are nested too deeply", 1) from None

    def call_binop(self, context: Context | None, operator: str, left: Any, right: Any) -> Any:
        """Compute a binary operator, such as `+`, of the values `left` and `right` in a template.

        The rendering's budget of steps is charged for both and for what comes out.
        """
        if isinstance(left, int) and isinstance(right, int):
            bits = left.bit_length(), right.bit_length()
            powers = bits[0] * abs(right) if operator == "**" else 0
            _hold(powers or (sum(bits) if operator == "*" else max(bits)))
        elif not (isinstance(left, int | float) and isinstance(right, int | float)):
            self._pay_for_texts(operator, left, right)
        return self.binop_table[operator](left, right)

    def _pay_for_texts(self, operator: str, left: Any, right: Any) -> None:
        if operator == "%" and isinstance(left, str):
            _formatted(left, right)
        elif operator == "+" and isinstance(left, _WITH_LENGTH):
            _charged(left)
            _charged(right)
        elif operator == "*" and (isinstance(left, int) or isinstance(right, int)):
            times, items = (left, right) if isinstance(left, int) else (right, left)
            length = len(items) if isinstance(items, _WITH_LENGTH) else 0
            spend((max(0, times) * length) >> (3 if isinstance(items, str | bytes) else 0))
        elif isinstance(left, bytes):
            raise SecurityError(f"{operator} is not allowed on bytes")
        else:
            read(left)
            read(right)

    def call(self, context: Context, called: Any, /, *given: Any, **named: Any) -> Any:
        """Call a function in a template, and return what it returns.

        The rendering's budget of steps is charged for its arguments and for what it returns.
        """
        if given or named:
            spend(sum(map(_size, chain(given, named.values()))))
        owner = getattr(called, "__self__", None)
        if isinstance(owner, str):
            given = self._pay_for_method(owner, called.__name__, given)
        return _charged(super().call(context, called, *given, **named))

    def _pay_for_method(self, owner: str, name: str, given: tuple[Any, ...]) -> tuple[Any, ...]:
        size = _size(owner)
        spend(size)
        if name in _PADDING:
            spend(size * sum(map(_extent, given)))
        elif (
            name == "replace"
            and len(given) > 1
            and all(isinstance(text, str) for text in given[:2])
        ):
            _replaced(owner, given[0], given[1])
        elif name == "join" and given:
            items = list(_one_by_one(given[0]))
            spend(len(items) * size)
            return (items, *given[1:])
        return given

    def getattr(self, obj: Any, attribute: str) -> Any:
        """Return an attribute of an object, or else its item of that name, as templates read it.

        While a template is compiled it raises jinja2's Impossible: nothing would be charged then.
        """
        if _account.compiles:
            raise nodes.Impossible
        return super().getattr(obj, attribute)

    def getitem(self, obj: Any, argument: Any) -> Any:
        """Return an item of an object, or else its attribute of that name, as templates read it.

        The rendering's budget is charged for comparing a key that is not a plain text or number.
        """
        return super().getitem(obj, argument if type(argument) in (str, int) else read(argument))

    def is_safe_attribute(self, obj: Any, attr: str, value: Any) -> bool:
        """Return whether a template may read the attribute `attr` of `obj`, whose value is `value`.

        It may not where Jinja's sandbox forbids it, or where it is a method that makes large
        results.
        """
        if isinstance(obj, bytes | int):
            return False
        return not (isinstance(obj, str) and attr == "translate") and super().is_safe_attribute(
            obj, attr, value
        )

    def wrap_str_format(self, value: Any) -> Callable[..., str] | None:
        """Return a text's method `format` as one that charges the rendering's budget of steps.

        `value` is what a template calls; None if it is no such method.
        """
        method = super().wrap_str_format(value)
        if method is None:
            return None
        text, form = value.__self__, method

        def paid(*given: Any, **named: Any) -> str:
            _formatted(text, *given, *named.values())
            return form(*given, **named)

        return paid
