"""Configuration as typed records. A mistake is one line: file, table and key, the value, what is allowed.

A record is a frozen dataclass or a `msgspec.Struct`, nested as the file's tables are. Its annotations are the
rules: `Literal[...]` lists choices; `Annotated[float, Meta(ge=0, description="seconds, 0 or more")]` bounds a
value and says so in words; a ValueError from `__post_init__` says what is wrong with a table as a whole. No
value is converted but an integer to a float. An unknown key is refused, with the nearest one that exists.

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
LONGEST_S = 3600.0  # of an answer that a model can be declared to take
Seconds = Annotated[
    float, msgspec.Meta(ge=0, le=LONGEST_S, description=f"seconds, 0 or more, at most {LONGEST_S:g}")
]
_type_info = cache(type_info)
_MISSING = re.compile(r"Object missing required field `(.+)`")
_STEPS = re.compile(r"[^.\[\]`]+")  # of a path such as `.points[1].loss`
_IN_WORDS = {"object": "a table", "array": "a list"}


def toml(path: Path, where: str) -> dict[str, Any]:
    """The tables of a TOML file.

    Args:
        path: the file, which is there.
        where: what it is called in messages, such as `model card models/mine.toml`.

    Raises:
        UserError: it is no TOML.
    """
    try:
        return loads(text_of(path), where)
    except (OSError, UnicodeDecodeError) as error:
        reason = printable(getattr(error, "strerror", None) or error)
        raise UserError(f"{where} is no TOML: {reason}; fix the file") from None


def loads(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text. Raises UserError if it is none."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # too many digits, and brackets, among them
        raise UserError(f"{where} is no TOML: {printable(error)}; fix the file") from None


def convert(table: Mapping[str, Any], kind: type[Record], where: str, **given: Any) -> Record:
    """A record of some kind from a table, as TOML and JSON have them.

    Args:
        table: its keys are names of fields.
        kind: class of the record.
        where: what the table is called in messages.
        given: fields that the program fills in, which the table may not hold.

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
    """A frozen dataclass with some of its fields from their texts.

    Args:
        record: what is changed.
        settings: fields' names and values.
        where: what to call it in messages.

    Raises:
        UserError: a field that it has not, or a value that is not allowed.
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
    """Names of the fields that are one number, switch or text."""
    values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    return [name for name, value in values.items() if isinstance(value, str | bool | int | float)]


def value_of(usual: object, text: str) -> object:
    """A value of the kind that is usual; what is none stays text, which no setting of that kind allows."""
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
    value: Any, kind: Any, path: tuple[str, ...], but: Collection[str] = ()
) -> Iterator[tuple[tuple[str, ...], str, list[str]]]:
    """Path of a table, key that is none of its record's fields, and the fields' names."""
    if isinstance(value, Mapping) and (fields := _fields(kind)):
        for key, inner in value.items():
            if key in but or key not in fields:
                yield path, key, [name for name in fields if name not in but]
            else:
                yield from _unknown_keys(inner, fields[key], (*path, key))
    elif isinstance(value, Mapping | list) and (item := _item(kind)):
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _unknown_keys(inner, item, (*path, str(key)))


def _mistake(message: str, table: Mapping[str, Any], kind: Any, where: str) -> UserError:
    """What msgspec says, such as "Expected `int`, got `str` - at `$.latency.n`", as a line for people."""
    said, _, at = message.partition(" - at `$")
    path = _STEPS.findall(at)
    if missing := _MISSING.fullmatch(said):
        return UserError(f"{_place(where, path)} has no {missing[1]}; add it")
    # From a __post_init__, of the whole, or inside a member that msgspec does not name.
    if not said.startswith(("Expected", "Invalid enum")) or not path or "[...]" in at[:-6]:
        return UserError(f"{_place(where, path)}: {printable(said)}")
    value: Any = table
    for step in path:
        value = value[int(step) if isinstance(value, list) else step]
        kind = (_fields(kind) or {}).get(step) or _item(kind)
    *tables, key = path
    if said.startswith("Invalid enum"):
        return unknown(f"{key} in {_place(where, tables)}", str(value), map(str, _plain(kind).values))
    expected, _, got = said.removeprefix("Expected ").replace("`", "").partition(", got ")
    kinds = " or ".join(_IN_WORDS.get(name, name) for name in expected.split(" | ") if name != "null")
    allowed = kinds if got else _description(kind) or kinds
    return UserError(f"{_place(where, tables)}: {key} = {printable(repr(value))}; allowed: {allowed}")


def _fields(kind: Any) -> dict[str, Any]:
    """Types of a record's fields; empty for any other type."""
    return {field.encode_name: field.type for field in getattr(_plain(kind), "fields", ())}


def _item(kind: Any) -> Any:
    """Type of what a list or a table of any keys holds; None for any other type."""
    plain = _plain(kind)
    return getattr(plain, "item_type", None) or getattr(plain, "value_type", None)


def _plain(kind: Any) -> Any:
    """A type without null and without what describes it."""
    if hasattr(kind, "extra_json_schema"):
        return _plain(kind.type)
    others = [one for one in getattr(kind, "types", ()) if type(one).__name__ != "NoneType"]
    return _plain(others[0]) if len(others) == 1 else kind


def _description(kind: Any) -> str | None:
    """The words of a type's `Meta(description=...)`."""
    words: str | None = (getattr(kind, "extra_json_schema", None) or {}).get("description")
    return words or next(filter(None, map(_description, getattr(kind, "types", ()))), None)
