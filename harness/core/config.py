"""Read TOML configuration into typed records, and report each mistake in one line.

The line names the file, the table, the key, the value and what is allowed.

A record is a frozen dataclass or a `msgspec.Struct`, nested as the file's tables are. Its
annotations are the rules: `Literal[...]` lists choices; `Annotated[float, Meta(ge=0,
description="seconds, 0 or more")]` bounds a value and describes the bound; a ValueError from
`__post_init__` says what is wrong with a table as a whole. Integers are converted to floats, and
nothing else is. An unknown key is refused, and the message suggests the nearest known one. So is a
number beyond `LARGEST`, also where a record has no bounds, and a text with the character NUL, which
no path, name or process can hold.

    @dataclass(frozen=True)
    class Channel:
        model: Literal["ideal", "radio"]
        loss: Annotated[float, Meta(ge=0, le=1, description="a share, 0 to 1")] = 0.0

    convert(toml(path, f"channel file {path}"), Channel, f"channel file {path}")
"""

import dataclasses
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec

from harness.core.depth import shallow
from harness.core.errors import UserError, printable, unknown
from harness.core.files import text_of

Record = TypeVar("Record")
Count = Annotated[int, msgspec.Meta(ge=1, description="1 or more")]
LARGEST = 2**63 - 1  # of a number in a file, which is what NumPy's and Parquet's integers hold
Whole = Annotated[int, msgspec.Meta(ge=0, le=LARGEST, description="a whole number, 0 or more")]
_ANY_NUMBER = f"a finite number, of a size of at most {LARGEST:.2g}"
LONGEST_S = 3600.0  # the longest time that a model may be declared to take for an answer
Seconds = Annotated[
    float,
    msgspec.Meta(ge=0, le=LONGEST_S, description=f"seconds, 0 or more, at most {LONGEST_S:g}"),
]


def between(least: float, most: float) -> msgspec.Meta:
    """Return an annotation for a number from a file: it must be from `least` to `most`.

    It is used as `Annotated[float, between(0, 1)]` in a dataclass that `convert` fills from a file;
    its description is what messages say is allowed.
    """
    return msgspec.Meta(ge=least, le=most, description=f"a number from {least:g} to {most:g}")


_MISSING = re.compile(r"Object missing required field `(.+)`")
_OF_VALUES = ("Expected", "Invalid", "Number out of range", "Integer")
_DOTS = 100
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+"""
_LONG_KEY = re.compile(rf"(?<![\w.-])(?:{_PART}\.[ \t]*+){{{_DOTS}}}")
_IN_WORDS = {
    "object": "a table",
    "array": "a list",
    "str": "a text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
}


def toml(path: Path, where: str) -> dict[str, Any]:
    """Read a TOML file into tables, as nested dicts.

    `where` names the file in messages, such as `model card models/mine.toml`. Raises UserError if
    it cannot be read or is no TOML.
    """
    try:
        return loads(text_of(path, "settings"), where)
    except OSError as error:
        reason = printable(error.strerror or error)
        raise UserError(f"{where} cannot be read: {reason}; replace the file") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{where} is no TOML: {printable(error)}; fix the file") from None


def loads(text: str, where: str) -> dict[str, Any]:
    """Parse a TOML text into tables; `where` names it in messages.

    Raises UserError if it is no TOML. A dotted key of more than 100 parts is refused, since the
    parser takes time and memory that grow with the square of their number.
    """
    if _LONG_KEY.search(text):
        raise UserError(f"{where} is no TOML: a key has more than {_DOTS} dots; fix the file")
    try:
        tables = tomllib.loads(text)
        repr(
            tables
        )  # which fails for a number of thousands of hexadecimal digits, as messages would
        return shallow(tables)
    except (ValueError, RecursionError) as error:  # also raised for too many digits or brackets
        mend = "put a text in quotes" if str(error).startswith("Invalid value") else "fix the file"
        raise UserError(f"{where} is no TOML: {printable(error)}; {mend}") from None


def json_loads(text: str, where: str) -> Any:
    """Parse a JSON text into dicts, lists, texts, numbers, booleans and None.

    `where` names the text in messages. Raises UserError if it is not JSON.
    """
    try:
        return shallow(msgspec.json.decode(text))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where} is no JSON: {printable(error)}; fix the file") from None


def convert(table: Mapping[str, Any], kind: type[Record], where: str, **given: Any) -> Record:
    """Convert a table, as read from TOML or JSON, to a typed record, and check its values.

    Args:
        table: keys and values, nested as in the file.
        kind: the record's type: a frozen dataclass or a msgspec.Struct, whose annotations say what
            is allowed.
        where: names the table in messages, such as `channel file channels/v2x.toml`.
        given: values of fields that the program sets itself; the table may not have them.

    Raises:
        UserError: a key is unknown or missing, or a value is not allowed.
    """
    for path, key, known_keys in _unknown_keys(table, kind, (), given):
        raise unknown(f"key in {_place(where, path)}", key, known_keys)
    whole = {**table, **given}
    try:
        record = msgspec.convert(whole, kind)
    except (msgspec.ValidationError, UnicodeEncodeError, OverflowError):
        raise _mistake(whole, kind, where) from None
    for path, value in _beyond(table, ()):  # last, since a bound has better words
        *tables, key = path
        allowed = "a text without NUL" if isinstance(value, str) else _ANY_NUMBER
        raise UserError(f"{_place(where, tables)}: {key} = {printable(value)}; allowed: {allowed}")
    return record


def changed(record: Record, settings: Mapping[str, str], where: str) -> Record:
    """Return a copy of a frozen dataclass with some fields set from text that a user typed.

    `settings` has the text of each new value by the field's name; `where` names the record in
    messages. Raises UserError for an unknown field or a value that is not allowed.
    """
    hints = get_type_hints(type(record), include_extras=True)
    current_values = {name: getattr(record, name) for name in settable(record)}
    for key in settings:
        if key not in current_values:
            raise unknown(f"setting of {where}", key, current_values)
    values = {key: value_of(current_values[key], text) for key, text in settings.items()}
    kind = msgspec.defstruct("Settings", [(key, hints[key]) for key in values])
    convert(values, kind, where)
    try:
        return cast("Record", dataclasses.replace(cast("Any", record), **values))
    except ValueError as problem:
        raise UserError(f"{where}: {printable(problem)}") from None


def check(record: Any) -> None:
    """Raise UserError unless a dataclass's numbers and choices are what its annotations allow.

    It is called when `record` was made in Python and not from a file. NaN is not allowed.
    """
    for name, hint in _fields(record.__class__).items():
        value = getattr(record, name)
        bounds = [
            meta for meta in getattr(hint, "__metadata__", ()) if isinstance(meta, msgspec.Meta)
        ]
        allowed = [str(choice) for choice in get_args(hint)] if get_origin(hint) is Literal else []
        if not all(meta.ge <= value <= meta.le for meta in bounds) or (
            allowed and str(value) not in allowed
        ):
            raise UserError(f"{name} is {value}: give {' or '.join(allowed) or description(hint)}")


def settable(record: Any) -> list[str]:
    """Return the names of a dataclass's fields that a user can set by a text.

    These are the fields of `record` that hold a single number, boolean or text; `changed` sets
    them.
    """
    values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    return [name for name, value in values.items() if isinstance(value, str | bool | int | float)]


def value_of(usual: object, text: str) -> object:
    """Convert a typed text to the type of the value that it replaces: bool, int, float or str.

    `usual` is that value. A text that cannot be converted is returned unchanged, for a later type
    check to refuse.
    """
    if isinstance(usual, bool):
        return {"true": True, "false": False}.get(text, text)
    if isinstance(usual, str) or not text.isascii():
        return text
    try:
        return int(text) if isinstance(usual, int) else float(text)
    except ValueError:
        return text


def _place(where: str, path: Sequence[str]) -> str:
    return f"{where} [{'.'.join(path)}]" if path else where


def _unknown_keys(
    value: Any, hint: Any, path: tuple[str, ...], exempt: Collection[str] = ()
) -> Iterator[tuple[tuple[str, ...], str, list[str]]]:
    """Yield each unknown key: the path of its table, the key, and the names of the known fields."""
    members = [member for member in _members(hint, value) if member is not NoneType]
    fields = _fields(members[0]) if len(members) == 1 and isinstance(value, Mapping) else {}
    for key, inner, hints in _entries(value, hint):
        if fields and (key in exempt or key not in fields):
            yield path, key, [name for name in fields if name not in exempt]
        elif len(hints) == 1:
            yield from _unknown_keys(inner, hints[0], (*path, printable(key)))


def _beyond(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], object]]:
    """Yield each number that is none or beyond `LARGEST`, and each text with NUL, both of which
    TOML can write: its path and itself.
    """
    too_large = isinstance(value, int | float) and not abs(value) <= LARGEST
    if too_large or (isinstance(value, str) and "\0" in value):
        yield path, value
    elif isinstance(value, Mapping | list):
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _beyond(inner, (*path, printable(key)))


def _mistake(table: Mapping[str, Any], kind: Any, where: str) -> UserError:
    """Describe the first value that does not fit its type;
    msgspec's words are rewritten for people.
    """
    path, value, hint = _wrong(table, kind)
    here, (*tables, key) = _place(where, path), path or ("",)
    problem, of_key, _ = (_problem(value, hint) or "").partition(" - at `key`")
    if missing := _MISSING.fullmatch(problem):
        return UserError(f"{here} has no {missing[1]}; add it")
    if not problem.startswith(_OF_VALUES) or not path:  # a __post_init__'s, or about the whole
        return UserError(f"{here}: {printable(problem)}")
    if of_key:
        names = [get_args(member)[0] for member in _members(hint, value) if get_args(member)]
        name = next((name for name in value if _problem(name, names[0])), "")
        return UserError(
            f"{here}: {printable(repr(name))} is no name for this; {printable(problem)}"
        )
    choices = _choices(hint)
    if choices and int in _members(hint):
        allowed = " or ".join([_IN_WORDS["int"], *choices])
        return UserError(
            f"{_place(where, tables)}: {key} = {printable(repr(value))}; allowed: {allowed}"
        )
    if problem.startswith("Invalid") and choices:
        return unknown(f"{key} in {_place(where, tables)}", str(value), choices)
    expected, _, got = problem.removeprefix("Expected ").replace("`", "").partition(", got ")
    kinds = " or ".join(_in_words(name) for name in expected.split(" | ") if name != "null")
    allowed = (" or ".join(choices) or kinds) if got else description(hint) or kinds
    if not problem.startswith("Expected"):
        allowed = description(hint) or _ANY_NUMBER
    return UserError(
        f"{_place(where, tables)}: {key} = {printable(repr(value))}; allowed: {allowed}"
    )


def _in_words(kind: str) -> str:
    """Return msgspec's name of a type in words: `int >= 1` as `a whole number >= 1`."""
    name, space, bound = kind.partition(" ")
    return _IN_WORDS.get(name, name) + space + bound


def _wrong(value: Any, hint: Any, path: tuple[str, ...] = ()) -> tuple[tuple[str, ...], Any, Any]:
    """Find the innermost first value that does not fit its type: its path, itself and the type."""
    for key, inner, hints in _entries(value, hint):
        if hints and all(_problem(inner, each) for each in hints):
            tags = [tag for each in hints if get_origin(each) is Literal for tag in get_args(each)]
            return _wrong(
                inner, Literal[tuple(tags)] if tags else hints[0], (*path, printable(key))
            )
    return path, value, hint


def _problem(value: Any, hint: Any) -> str | None:
    """Return msgspec's words for why a value does not fit a type; None if it does."""
    try:
        msgspec.convert(value, hint)
    except (msgspec.ValidationError, OverflowError) as error:
        return str(error)
    except UnicodeEncodeError:  # of a lone surrogate
        return "Expected `str` of characters that UTF-8 has, got `str`"
    return None


def _entries(value: Any, hint: Any) -> Iterator[tuple[Any, Any, list[Any]]]:
    """Yield key, value and possible types of each entry of a table or list;
    no type where none is known.
    """
    if isinstance(value, Mapping | list):
        is_table = isinstance(value, Mapping)
        members = _members(hint, value)
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            fields = [
                _fields(member)[key] for member in members if is_table and key in _fields(member)
            ]
            yield (
                key,
                inner,
                fields or [each for member in members for each in _items(member, key, is_table)],
            )


def _members(hint: Any, value: Any = None) -> list[Any]:
    """Return the types of a union, without descriptions;
    of tagged records the one that a value names.
    """
    while get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    if get_origin(hint) not in (Union, UnionType):
        return [hint]
    members = [member for each in get_args(hint) for member in _members(each, value)]
    tags = [getattr(member, "__struct_config__", None) for member in members]
    named = [
        member
        for member, tag in zip(members, tags, strict=True)
        if tag
        and tag.tag is not None
        and isinstance(value, Mapping)
        and value.get(tag.tag_field) == tag.tag
    ]
    return named or members


@cache
def _fields(kind: Any) -> dict[str, Any]:
    """Return the types of a record's fields by their names in a file; empty for any other type."""
    if not hasattr(kind, "__struct_fields__") and not dataclasses.is_dataclass(kind):
        return {}
    hints = get_type_hints(kind, include_extras=True)
    names = getattr(kind, "__struct_fields__", hints)
    tag = getattr(kind, "__struct_config__", None)
    tagged = {tag.tag_field: Literal[tag.tag]} if tag and tag.tag_field else {}
    in_file = getattr(kind, "__struct_encode_fields__", names)
    return tagged | dict(zip(in_file, map(hints.get, names), strict=True))


def _items(hint: Any, key: Any, is_table: bool) -> list[Any]:
    """Return the type of an entry of a list or a mapping; none for another type."""
    origin, arguments = get_origin(hint), get_args(hint)
    if not arguments or not isinstance(origin, type) or issubclass(origin, Mapping) != is_table:
        return []
    if is_table:
        return [arguments[1]]
    if issubclass(origin, tuple) and arguments[-1] is not ...:
        return list(arguments[key : key + 1])
    return [arguments[0]]


def _choices(hint: Any) -> list[str]:
    """Return the choices of a type; none if it has no list of them."""
    return [
        str(name)
        for kind in _members(hint)
        if get_origin(kind) is Literal
        for name in get_args(kind)
    ]


def description(hint: Any) -> str | None:
    """Return what a type annotation allows, in words for messages, such as `seconds, 0 or more`.

    It is the `description` of the first `msgspec.Meta` in the annotation `hint`; None if there is
    none.
    """
    texts = (
        meta.description
        for meta in getattr(hint, "__metadata__", ())
        if isinstance(meta, msgspec.Meta)
    )
    members = get_args(hint) if get_origin(hint) in (Annotated, Union, UnionType) else ()
    of_members = [description(member) for member in members]
    return next(filter(None, [*texts, *of_members]), None)
