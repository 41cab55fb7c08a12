"""Changes to typer: commands load when they are named,
and plain values are read without pydantic.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial, wraps
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_origin

from typer import Context, Typer, echo
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from harness.cli.commands import COMMANDS, GROUPS, OLD, commands, groups, panels, short, spellings
from harness.core.errors import UserError, one_line, printable
from harness.core.extensions import owner, part_of, taken
from harness.core.strangers import ended, ends_the_program, worded

UNREAD = object()
DIGITS = 18  # most of a number that is read here


class Stopped(Exception):
    """Report that a command was interrupted; the cause is the KeyboardInterrupt.

    Typer would end such a command without a word.
    """


class Branch(Mapping[str, Any]):
    """Map names to the commands and groups below a group; each is imported when looked up.

    It is made from what is typed up to the group, such as `run`; empty for all commands. Extensions
    are searched only if the core has no such name, or all names are listed.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.core = _below(path, COMMANDS)
        self.loaded: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self.loaded:
            path = self.core[name] if name in self.core else _below(self.path, commands())[name]
            if path in GROUPS or path in groups():
                self.loaded[name] = Group(path, name=name)
            else:
                place = f"harness.cli.{COMMANDS[path]}" if path in COMMANDS else commands()[path]
                self.loaded[name] = _command(path, place)
            hasten(self.loaded[name])
        return self.loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_below(self.path, commands()))

    def __len__(self) -> int:
        return len(_below(self.path, commands()))


def _below(path: str, table: Mapping[str, str]) -> dict[str, str]:
    """Return the names that may follow a path in a table of commands,
    each with what is typed up to it.
    """
    depth = len(path.split())
    paths = [words for words in map(str.split, table) if words[:depth] == path.split()]
    return {words[depth]: " ".join(words[: depth + 1]) for words in paths}


def _command(path: str, place: str) -> Any:
    module, _, function = place.partition(":")
    app = Typer(add_completion=False, rich_markup_mode=None)
    what, built_in = f"command {path} ({printable(place)})", place.startswith("harness.")
    with worded(what, built_in):
        called = getattr(import_module(module), function or "command")
        app.command(path.split()[-1], cls=Command)(
            called if built_in else _of_package(called, what)
        )
        return get_command(app)


def _of_package(called: Callable[..., Any], what: str) -> Callable[..., Any]:
    """Return a package's command, whose errors are one line;
    it may end with an exit code as commands do.
    """

    @wraps(called)
    def calling(*args: Any, **kwargs: Any) -> Any:
        try:
            return called(*args, **kwargs)
        except (UserError, OSError):
            raise
        except Exception as error:
            if type(error).__module__.partition(".")[0] in ("click", "typer"):
                raise
            raise UserError(
                f"{what} fails ({one_line(error)}); repair or uninstall its package"
            ) from error

    return calling


class Command(TyperCommand):
    """Extend typer's command by help that lists options under headings, those without one first."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, then the options under each heading, to the help.

        `ctx` and `formatter` are click's: the command's context, and what collects the help's text.
        """
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            if record := parameter.get_help_record(ctx):
                usual = "Options" if parameter.param_type_name == "option" else "Arguments"
                panels.setdefault(getattr(parameter, "rich_help_panel", None) or usual, []).append(
                    record
                )
        for panel, rows in panels.items():
            if rows:
                with formatter.section(panel):
                    formatter.write_dl(rows)


class Group(TyperGroup):
    """Extend typer's group of commands: these load on use, and help has one column."""

    def __init__(self, path: str = "", **attributes: Any) -> None:
        below: Any = Branch(path)
        attributes |= {"commands": below, "no_args_is_help": True, "rich_markup_mode": None}
        super().__init__(
            **{"help": GROUPS.get(path) or (groups().get(path) if path else None), **attributes}
        )
        self.path = path

    def invoke(self, ctx: Any) -> Any:
        """Invoke the command that was typed, and return what it returns; `ctx` is click's context.

        Raises Stopped if it is interrupted, and UserError if a package tries to end the program.
        """
        try:
            return super().invoke(ctx)
        except BaseException as error:
            if ends_the_program(error):
                raise ended("a package", error) from error
            if isinstance(error, KeyboardInterrupt):
                raise Stopped from error
            raise

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name, the command that was typed, and the arguments behind it.

        For an old spelling of a command, the new one is printed on stderr. An unknown command ends
        with suggestions of similar ones. `ctx` is click's context, and `args` are the words that
        were typed.
        """
        old, new = ("", "") if self.path else respelt(args)
        rest = args[len(old.split()) :]
        if not (old or self.path):
            old, new = self._now_a_command(ctx, args)
            rest = args[1:] if old else args
        if new and old not in short() and not ctx.resilient_parsing:
            echo(
                f"harness: `harness {old}` is now `harness {new}`; the old spelling works until "
                "0.5.0",
                err=True,
            )
        args = [*new.split(), *rest]
        if (
            args[0] not in self.commands
            and not args[0].startswith("-")
            and not ctx.resilient_parsing
        ):
            from difflib import get_close_matches

            typed = f"{self.path} {args[0]}".strip()
            if extension := owner(typed):
                ctx.fail(f"`harness {typed}` is {part_of(extension)}")
            last = {
                **spellings(),
                **{words.split()[-1]: words for words in (*commands(), *spellings().values())},
            }
            near = get_close_matches(args[0], [*self.commands, *last])
            meant = dict.fromkeys(
                f"{self.path} {name}".strip() if name in self.commands else last[name]
                for name in near
            )
            line = f"No such command {args[0]!r}"
            if meant:
                line += f" (did you mean {', '.join(f'`harness {words}`' for words in meant)}?)"
            if self.path and not self.commands.keys() & {*near}:
                line += f"; known: {', '.join(self.commands)}"
            ctx.fail(line)
        return super().resolve_command(ctx, args)

    def _now_a_command(self, ctx: Any, args: list[str]) -> tuple[str, str]:
        """Return a command of the core with an option that was typed and has become a command of
        an extension, and that command. Both are empty if there is none.
        """
        flags = [word.partition("=")[0] for word in args[1:] if word.startswith("--")]
        if not flags or args[0] not in COMMANDS:
            return "", ""
        options = self.commands[args[0]].get_params(ctx)
        there = {name for each in options for name in (*each.opts, *each.secondary_opts)}
        for flag in flags:
            old = f"{args[0]} {flag}"
            if flag not in there and old in spellings():
                return old, spellings()[old]
        return "", ""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each heading's commands to the help, each with the first sentence of its own.

        `ctx` and `formatter` are click's: the group's context, and what collects the help's text.
        """
        here = [*self.commands]
        width = max(map(len, here))
        for panel, names in {"Commands": here}.items() if self.path else panels().items():
            if names_here := [name for name in names if name in here]:  # a package can name others
                with formatter.section(panel):
                    formatter.write_dl(
                        [
                            (
                                f"{name:<{width}}",
                                self._short_help(name, formatter.width - width - 6),
                            )
                            for name in names_here
                        ]
                    )

    def _short_help(self, name: str, width: int) -> str:
        try:
            return str(self.commands[name].get_short_help_str(width))
        except UserError:  # a package's
            return "(its package does not work; type it to see why)"


def respelt(args: list[str]) -> tuple[str, str]:
    """Return the old or short spelling of a command at the beginning of some words, and its own.

    `args` are the words that were typed, the first result the spelling there, and the second the
    command that it stands for. Both are empty if there is none.
    """
    spelt = [" ".join(args[:n]) for n in (2, 1)]
    for typed in spelt:
        if typed in OLD:
            return typed, OLD[typed]
    if args[0] in COMMANDS or spelt[0] in _below(args[0], COMMANDS).values():
        return "", ""  # of the core: nobody looks for extensions
    others = {**spellings(), **short()}
    typed = next((typed for typed in spelt if typed in others and not taken(typed, commands())), "")
    return typed, others.get(typed, "")


def keep_encoding() -> None:
    """Have typer write in the terminal's encoding; it would write UTF-8 where that is ASCII."""
    streams: Any = import_module(echo.__module__.replace("utils", "_compat"))
    streams._stream_is_misconfigured = _never


def _never(stream: object) -> bool:
    return False


def hasten(command: Any) -> None:
    """Change a typer command so that it converts plain arguments without pydantic, to start faster.

    Typer converts every value with pydantic, a missing one too, and loading that takes a tenth of a
    second. What is not plainly right is left to typer, which words the error.
    """
    for parameter in command.get_params(Context(command)):  # `--help` is one
        if hasattr(parameter, "type_descriptor"):
            parameter.process_value = partial(_value, parameter, parameter.process_value)


def _value(parameter: Any, by_typer: Callable[[Any, Any], Any], context: Any, value: Any) -> Any:
    several = parameter.multiple or parameter.nargs == -1
    annotation = parameter.type_descriptor.annotation
    # Python takes an empty path for the working folder.
    values = value if isinstance(value, list | tuple) else (value,)
    if "" in values and annotation in (Path, list[Path]):
        name = parameter.opts[0] if parameter.param_type_name == "option" else parameter.metavar
        raise UserError(
            f"{name or parameter.name} '': a path is not empty; give one, or . for here"
        )
    if value is None and not parameter.required:
        read: Any = () if several else None
    else:
        read = plain(annotation, value)
    if read is UNREAD or (parameter.required and read in ((), [])):
        return by_typer(context, value)
    return read if parameter.callback is None else parameter.callback(context, parameter, read)


def plain(annotation: Any, value: Any) -> Any:
    """Return a typed value converted to its type without pydantic, as typer would convert it.

    `annotation` is that of the command's parameter. The result is `UNREAD` if typer itself must
    convert or refuse the value.
    """
    if get_origin(annotation) is list and isinstance(value, list | tuple):
        items = [plain(get_args(annotation)[0], item) for item in value]
        return UNREAD if UNREAD in items else items
    if annotation is Path and isinstance(value, str | Path):
        # Typer refuses what is there and cannot be read.
        return Path(value) if os.access(value, os.R_OK) or not os.path.exists(value) else UNREAD
    if annotation is int and isinstance(value, str) and value.isascii() and value.isdigit():
        return int(value) if len(value) <= DIGITS else UNREAD
    return value if type(value) is annotation else UNREAD
