"""The command line: parses, calls one function, prints where it wrote.

Heavy packages load inside the commands, so that `harness --help` answers at once.
"""

import atexit
import errno
import gc
import os
import shlex
import sys
from functools import cache
from typing import Any

import typer
from typer.main import get_command

from harness import __version__
from harness.cli import shell
from harness.core import extras
from harness.core.errors import EXIT_CODES, UserError, printable
from harness.core.extensions import extensions, owner, owner_of_plugin, part_of
from harness.core.process import Stop

app = typer.Typer(
    name="harness",
    cls=shell.Group,
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog=f"Exit codes: {'; '.join(f'{code} {meaning}' for code, meaning in EXIT_CODES.items())}.",
    pretty_exceptions_enable=False,
)


def _version(is_asked: bool) -> bool:
    if is_asked:
        typer.echo(f"harness {__version__}")
        raise typer.Exit
    return is_asked


@app.callback()
def common(
    version: bool = typer.Option(False, "--version", callback=_version, help="Print the version."),
) -> None:
    """Evaluate prompts and parsing in cooperative driving."""


# What is wrong with the machine and not with the program: disks that are full, read-only, broken or
# not ours.
MACHINE = frozenset(
    {
        errno.ENOSPC,
        errno.EDQUOT,
        errno.EFBIG,
        errno.EROFS,
        errno.EACCES,
        errno.EPERM,
        errno.EIO,
        errno.ENOTDIR,
        errno.EISDIR,
        errno.ENAMETOOLONG,
        errno.EMFILE,
        errno.ENFILE,
        errno.ENOMEM,
        errno.ELOOP,
    }
)


# What the other way to make a run calls it, by command and option.
MEANT = {
    ("drive", "--limit"): "--episodes",
    ("drive", "--dataset"): "--scenario",
    ("eval", "--episodes"): "--limit",
    ("eval", "--scenario"): "--dataset",
}


# new objects; at 700, as usual, imports and tables are walked again and again
COLLECT_AFTER = 50_000


# typer carries a click of its own and exports of its errors only this one's children.
_UsageError: Any = typer.BadParameter.__mro__[1]


def main() -> None:
    """Run the command line that was typed.

    A UserError, which says what the user did wrong, is printed as one line on stderr, and the
    process exits with the error's `code`, one of `EXIT_CODES`.
    """
    gc.set_threshold(COLLECT_AFTER, 10, 10)
    # all memory goes as the process ends; its last collections would walk it all
    atexit.register(gc.freeze)
    out = sys.stdout
    try:
        try:
            _typed()
        finally:
            out.flush()
            if sys.stdout is not out:  # what typer does where a write finds nobody who reads
                raise BrokenPipeError
    except BrokenPipeError:  # as SIGPIPE ends a program: `| head` has left
        sys.exit(141)
    except OSError as error:
        from harness.core.files import Refused

        if error.errno not in MACHINE and not isinstance(error, Refused):
            raise
        where = printable(error.filename) if error.filename else "the output, or a temporary file"
        _fail(f"{where}: {error.strerror}; fix that, and type the same command again")


@cache
def _program() -> Any:
    """Return the commands as one program, made once a process: tests type a thousand in one."""
    program = get_command(app)
    shell.hasten(program)
    shell.keep_encoding()
    return program


def _typed() -> None:
    if strange := [word for word in sys.argv if not _is_text(word)]:
        _fail(
            f"`{printable(strange[0])}` is no UTF-8, as all that is kept is; rename what it names"
        )
    # Arrow's own takes 20 MB more, and time
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    try:
        sys.exit(_program()(standalone_mode=False))
    except UserError as error:
        _fail(_with_notes(str(error), error), error.code)
    except ModuleNotFoundError as error:
        if (lack := extras.OPTIONAL.get((error.name or "").partition(".")[0])) is None:
            raise
        _fail(str(extras.without("this command", *lack)))
    except shell.Stopped as stopped:
        stop = stopped.__cause__
        words, code = (stop.word, stop.code) if isinstance(stop, Stop) else ("interrupted", 130)
        _fail(_with_notes(words, stop), code)
    except _UsageError as error:
        message, context = error.format_message(), error.ctx
        if message.startswith("Usage:"):  # a group without a command shows its help
            print(message)
            sys.exit(2)
        command = context.info_name if context else ""
        option = getattr(error, "option_name", "")
        if gone := _part_of_gone(command, option):
            message = f"{option} is {gone}"
        elif meant := MEANT.get((command, option)):
            message = f"{option} is none of `harness {command}`; give {meant}"
        path = context.command_path if context else "harness"
        typed = printable(" ".join(["harness", *sys.argv[1:]]))
        _fail(f"{printable(message.removesuffix('.'), 300)} in `{typed}`; see `{path} --help`")


def _part_of_gone(command: str, option: str) -> str:
    """Say what an option of a command is part of that is not installed; empty for any other."""
    name = option.lstrip("-").replace("-", "_")
    kinds = ("settings", "options")
    owners = [owner(f"{command} {option}"), *(owner_of_plugin(kind, name) for kind in kinds)]
    gone = next(filter(None, owners), None)
    return part_of(gone) if gone and gone not in extensions() else ""


def _is_text(word: str) -> bool:
    try:
        word.encode()
    except UnicodeEncodeError:  # bytes of a name that are no UTF-8
        return False
    return True


def _with_notes(words: str, error: BaseException | None) -> str:
    """Return the words of an error, with its notes of what is kept, and how to go on from there."""
    notes = getattr(error, "__notes__", ())
    if not notes:
        return words
    typed = printable(shlex.join(["harness", *sys.argv[1:]]), 2000)
    return "; ".join((words, *notes, f"type the same command to continue: {typed}"))


def _fail(message: str, code: int = 2) -> None:
    print(f"harness: {message}", file=sys.stderr)
    sys.exit(code)
