"""Changes to typer: commands are listed in groups, and plain values are read without pydantic."""

import os
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_origin

from typer import Context, echo
from typer.core import TyperGroup

UNREAD = object()
DIGITS = 18  # most of a number that is read here


class Stopped(Exception):
    """A command was interrupted, of which typer would say nothing; the cause is the KeyboardInterrupt."""


class Map(TyperGroup):
    """A group whose help lists its commands by panel, in one column."""

    def invoke(self, ctx: Any) -> Any:
        """Invoke the command. Raises Stopped if it is interrupted."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stopped:
            raise Stopped from stopped

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each panel's commands, each with the first sentence of its help."""
        commands: dict[str, Any] = dict(self.commands)
        width = max(map(len, commands))
        for panel in dict.fromkeys(command.rich_help_panel for command in commands.values()):
            rows = [
                (f"{name:<{width}}", command.get_short_help_str(formatter.width - width - 6))
                for name, command in commands.items()
                if command.rich_help_panel == panel
            ]
            with formatter.section(panel):
                formatter.write_dl(rows)


def keep_encoding() -> None:
    """Have typer write in the terminal's encoding: where that is ASCII, it would write UTF-8."""
    streams: Any = import_module(echo.__module__.replace("utils", "_compat"))
    streams._stream_is_misconfigured = _never


def _never(stream: object) -> bool:
    return False


def hasten(command: Any) -> None:
    """Have a command, and those below it, read plain values without pydantic.

    Typer converts every value with pydantic, a missing one too, and loading that takes a tenth of a second.
    What is not plainly right is left to typer, which words the error.
    """
    for inner in getattr(command, "commands", {}).values():
        hasten(inner)
    for parameter in command.get_params(Context(command)):  # `--help` is one
        if hasattr(parameter, "type_descriptor"):
            parameter.process_value = partial(_value, parameter, parameter.process_value)


def _value(parameter: Any, by_typer: Callable[[Any, Any], Any], context: Any, value: Any) -> Any:
    several = parameter.multiple or parameter.nargs == -1
    if value is None and not parameter.required:
        read: Any = () if several else None
    else:
        read = plain(parameter.type_descriptor.annotation, value)
    if read is UNREAD or (parameter.required and read in ((), [])):
        return by_typer(context, value)
    return read if parameter.callback is None else parameter.callback(context, parameter, read)


def plain(annotation: Any, value: Any) -> Any:
    """A value as its type has it, the same as typer reads it; `UNREAD` where that takes typer to say."""
    if get_origin(annotation) is list and isinstance(value, list | tuple):
        items = [plain(get_args(annotation)[0], item) for item in value]
        return UNREAD if UNREAD in items else items
    if annotation is Path and isinstance(value, str | Path):
        # Typer refuses what is there and cannot be read.
        return Path(value) if os.access(value, os.R_OK) or not os.path.exists(value) else UNREAD
    if annotation is int and isinstance(value, str) and value.isascii() and value.isdigit():
        return int(value) if len(value) <= DIGITS else UNREAD
    return value if type(value) is annotation else UNREAD
