"""Read TOML configuration into typed records, and report each mistake in one line.

The line names the file, the table, the key, the value and what is allowed.

A record is a frozen dataclass or a `msgspec.Struct`, nested as the file's tables are. Its annotations are the
rules: `Literal[...]` lists choices; `Annotated[float, Meta(ge=0, description="seconds, 0 or more")]` bounds a
value and describes the bound; a ValueError from `__post_init__` says what is wrong with a table as a whole.
Integers are converted to floats, and nothing else is. An unknown key is refused, and the message suggests the
nearest known one.

    @dataclass(frozen=True)
    class Channel:
        model: Literal["ideal", "radio"]
        loss: Annotated[float, Meta(ge=0, le=1, description="a share, 0 to 1")] = 0.0

    convert(toml(path, f"channel file {path}"), Channel, f"channel file {path}")
"""

import dataclasses
import re
import tomllib
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_type_hints

import msgspec
from msgspec.inspect import type_info

from harness.core.errors import UserError, printable, unknown
from harness.core.files import text_of

Record = TypeVar("Record")
Count = Annotated[int, msgspec.Meta(ge=1, description="1 or more")]
LONGEST_S = 3600.0  # the longest time that a model may be declared to take for an answer
Seconds = Annotated[
    float, msgspec.Meta(ge=0, le=LONGEST_S, description=f"seconds, 0 or more, at most {LONGEST_S:g}")
]
_type_info = cache(type_info)
_MISSING = re.compile(r"Object missing required field `(.+)`")
_STEPS = re.compile(r"[^.\[\]`]+")  # the steps of a path such as `.points[1].loss`
_IN_WORDS = {"object": "a table", "array": "a list"}


def toml(path: Path, where: str) -> dict[str, Any]:
    """Read the tables of a TOML file.

    Args:
        path: the file, which must exist.
        where: its name in messages, such as `model card models/mine.toml`.

    Raises:
        UserError: the file cannot be read or is not TOML.
    """
    try:
        return loads(text_of(path), where)
    except (OSError, UnicodeDecodeError) as error:
        reason = printable(getattr(error, "strerror", None) or error)
        raise UserError(f"{where} is no TOML: {reason}; fix the file") from None


def loads(text: str, where: str) -> dict[str, Any]:
    """Parse a TOML text into tables. Raises UserError if it is not TOML."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also raised for too many digits or brackets
        raise UserError(f"{where} is no TOML: {printable(error)}; fix the file") from None


def convert(table: Mapping[str, Any], kind: type[Record], where: str, **given: Any) -> Record:
    """Convert a TOML or JSON table to a record.

    Args:
        table: the values by field name.
        kind: class of the record.
        where: name of the table in messages.
        given: fields that the program fills in; the table may not hold them.

    Raises:
        UserError: an unknown or missing key, or a value that is not allowed.
    """
    info = _type_info(cast("Hashable", kind))
    for path, key, known in _unknown_keys(table, info, (), given):
        raise unknown(f"key in {_place(where, path)}", key, known)
    try:
        return msgspec.convert({**table, **given}, kind)
    except msgspec.ValidationError as error:
        raise _mistake(str(error), table, info, where) from None


def changed(record: Record, settings: Mapping[str, str], where: str) -> Record:
    """Return a copy of a frozen dataclass with some fields set from text.

    Args:
        record: the original, which stays as it is.
        settings: new values, as text, by field name.
        where: name of the record in messages.

    Raises:
        UserError: an unknown field, or a value that is not allowed.
    """
    hints = get_type_hints(type(record), include_extras=True)
    known = {name: getattr(record, name) for name in settable(record)}
    for key in settings:
        if key not in known:
            raise unknown(f"setting of {where}", key, known)
    values = {key: value_of(known[key], text) for key, text in settings.items()}
    kind = msgspec.defstruct("Settings", [(key, hints[key]) for key in values])
    convert(values, kind, where)
    try:
        return cast("Record", dataclasses.replace(cast("Any", record), **values))
    except ValueError as problem:
        raise UserError(f"{where}: {printable(problem)}") from None


def settable(record: Any) -> list[str]:
    """Return the names of the fields that hold one number, boolean or string."""
    values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    return [name for name, value in values.items() if isinstance(value, str | bool | int | float)]


def value_of(usual: object, text: str) -> object:
    """Convert a text to the type of the `usual` value.

    A text that cannot be converted is returned unchanged; the check of the type then refuses it.
    """
    if isinstance(usual, bool):
        return {"true": True, "false": False}.get(text, text)
    if isinstance(usual, str):
        return text
    try:
        return int(text) if isinstance(usual, int) else float(text)
    except ValueError:
        return text


def _place(where: str, path: Sequence[str]) -> str:
    return f"{where} [{'.'.join(path)}]" if path else where


def _unknown_keys(
    value: Any, kind: Any, path: tuple[str, ...], exempt: Collection[str] = ()
) -> Iterator[tuple[tuple[str, ...], str, list[str]]]:
    """Yield each unknown key: the path of its table, the key, and the names of the known fields."""
    if isinstance(value, Mapping) and (fields := _fields(kind)):
        for key, inner in value.items():
            if key in exempt or key not in fields:
                yield path, key, [name for name in fields if name not in exempt]
            else:
                yield from _unknown_keys(inner, fields[key], (*path, key))
    elif isinstance(value, Mapping | list) and (item := _item(kind)):
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _unknown_keys(inner, item, (*path, str(key)))


def _mistake(message: str, table: Mapping[str, Any], kind: Any, where: str) -> UserError:
    """Rewrite a message of msgspec, such as "Expected `int`, got `str` - at `$.latency.n`", for people."""
    problem, _, location = message.partition(" - at `$")
    path = _STEPS.findall(location)
    if missing := _MISSING.fullmatch(problem):
        return UserError(f"{_place(where, path)} has no {missing[1]}; add it")
    # The message is a __post_init__'s, is about the whole, or is inside a member that msgspec does not name.
    if not problem.startswith(("Expected", "Invalid enum")) or not path or "[...]" in location[:-6]:
        return UserError(f"{_place(where, path)}: {printable(problem)}")
    value: Any = table
    for step in path:
        value = value[int(step) if isinstance(value, list) else step]
        kind = (_fields(kind) or {}).get(step) or _item(kind)
    *tables, key = path
    if problem.startswith("Invalid enum"):
        return unknown(f"{key} in {_place(where, tables)}", str(value), map(str, _plain(kind).values))
    expected, _, got = problem.removeprefix("Expected ").replace("`", "").partition(", got ")
    kinds = " or ".join(_IN_WORDS.get(name, name) for name in expected.split(" | ") if name != "null")
    allowed = kinds if got else _description(kind) or kinds
    return UserError(f"{_place(where, tables)}: {key} = {printable(repr(value))}; allowed: {allowed}")


def _fields(kind: Any) -> dict[str, Any]:
    """Return the types of a record's fields by name; empty for any other type."""
    return {field.encode_name: field.type for field in getattr(_plain(kind), "fields", ())}


def _item(kind: Any) -> Any:
    """Return the type of the items of a list, or of the values of a mapping; None for any other type."""
    plain = _plain(kind)
    return getattr(plain, "item_type", None) or getattr(plain, "value_type", None)


def _plain(kind: Any) -> Any:
    """Strip the description and the null option from a type."""
    if hasattr(kind, "extra_json_schema"):
        return _plain(kind.type)
    members = [member for member in getattr(kind, "types", ()) if type(member).__name__ != "NoneType"]
    return _plain(members[0]) if len(members) == 1 else kind


def _description(kind: Any) -> str | None:
    """Return the text of a type's `Meta(description=...)`."""
    description: str | None = (getattr(kind, "extra_json_schema", None) or {}).get("description")
    return description or next(filter(None, map(_description, getattr(kind, "types", ()))), None)
