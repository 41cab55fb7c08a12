"""What typer does otherwise: commands in groups, and plain values read without pydantic."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.main import get_command

from harness.cli import app
from harness.cli.commands import commands, groups, panels, short, spellings
from harness.cli.shell import UNREAD, plain

Said = tuple[int, str, str]
VALUES = ("", "x", "7", "007", "-7", "7.5", "٣", "9" * 30, "/", "/nowhere", None)


def parameters(command: Any) -> Iterator[tuple[Any, Any]]:
    """Every command's parameters, each with its command."""
    for inner in getattr(command, "commands", {}).values():
        yield from parameters(inner)
    yield from ((command, parameter) for parameter in command.get_params(typer.Context(command)))


@pytest.mark.parametrize("value", VALUES)
def test_what_is_read_here_is_what_typer_reads(value: str | None) -> None:
    quick = 0
    for command, parameter in parameters(get_command(app)):
        several = parameter.multiple or parameter.nargs == -1
        given: Any = [value, "y"] if several and value is not None else value
        read = plain(annotation := parameter.type_descriptor.annotation, given)
        if value == "" and annotation in (Path, list[Path]):
            continue  # which is refused
        if read is not UNREAD:
            quick += 1
            assert parameter.process_value(typer.Context(command), given) == read
    assert bool(quick) == (value is not None)


def test_a_default_is_read_as_typer_reads_it() -> None:
    for command, parameter in parameters(get_command(app)):
        default = parameter.default
        if default is not None and not parameter.is_eager:
            read = plain(parameter.type_descriptor.annotation, default)
            assert read == parameter.process_value(typer.Context(command), default)


def test_a_path_that_cannot_be_read_is_left_to_typer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert plain(Path, str(tmp_path)) is UNREAD
    assert plain(list[Path], [str(tmp_path)]) is UNREAD
    assert plain(Path, str(tmp_path / "absent")) == tmp_path / "absent"


@pytest.mark.parametrize(
    ("typed", "name"),
    [
        (("eval", "--model", "proxy", "--limit", "1", "--out", ""), "--out"),
        (("run", "check", "."), "RUN..."),
        (("run", "check", "a"), "RUN..."),
        (("eval",), "RUN.TOML"),
    ],
)
def test_an_empty_path_is_not_the_working_folder(
    typed: tuple[str, ...], name: str, harness: Callable[..., Said]
) -> None:
    """As an unset variable gives it."""
    words = typed if "" in typed else (*typed, "")
    code, out, error = harness(*words)
    assert (code, out) == (2, "")
    assert error == f"harness: {name} '': a path is not empty; give one, or . for here\n"
    assert not list(Path().iterdir())


@pytest.mark.parametrize("args", [["run", "ls"], ["eval", "--help"], ["prompt", "list", "--help"]])
def test_neither_pydantic_nor_an_array_is_loaded_for(args: list[str], tmp_path: Path) -> None:
    (tmp_path / "reports").mkdir()
    code = (
        f"import sys, harness.cli as c\nsys.argv = ['harness', *{args!r}]\n"
        "try:\n    c.main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "print([name for name in ('pydantic', 'numpy', 'rich') if name in sys.modules], "
        "file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path
    )
    assert (done.returncode, done.stderr) == (0, "[]\n")


@pytest.mark.parametrize("group", ["", *groups()])
def test_help_says_each_command_whole_in_eighty_columns(
    harness: Callable[..., Said], group: str
) -> None:
    code, out, err = harness(*group.split(), "--help")
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    assert "..." not in out.replace("[ARGS]...", "")


def test_the_map_has_every_command_under_its_panel(harness: Callable[..., Said]) -> None:
    blocks = [block.splitlines() for block in harness("--help")[1].split("\n\n")]
    shown = {head: {line.split()[0] for line in lines} for head, *lines in blocks if lines}
    for panel, words in panels().items():
        assert shown[f"{panel}:"] == set(words)
    assert {name for names in panels().values() for name in names} == {
        path.split()[0] for path in commands()
    }
    assert sum(map(len, panels().values())) <= 15


@pytest.mark.parametrize(("old", "new"), spellings().items())
def test_an_old_spelling_works_and_says_the_new_one(
    harness: Callable[..., Said], old: str, new: str
) -> None:
    value = ["2"] if "--" in old else []  # an option that became a command
    code, out, err = harness(*old.split(), *value, "--help")
    assert (code, out) == (0, harness(*new.split(), "--help")[1])
    assert (
        err
        == f"harness: `harness {old}` is now `harness {new}`; the old spelling works until 0.5.0\n"
    )


def test_a_short_spelling_is_for_good(harness: Callable[..., Said]) -> None:
    for typed, path in short().items():
        assert harness(typed, "--help") == harness(*path.split(), "--help")


def test_what_machines_read_stays_json_under_an_old_spelling(harness: Callable[..., Said]) -> None:
    code, out, err = harness("scenario", "list", "--json")
    assert (code, err.count("\n")) == (0, 1)
    assert json.loads(out) == json.loads(harness("dataset", "scenario", "list", "--json")[1])


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("evl", "`harness eval`"), ("pull", "`harness model pull`"), ("sweeps", 
            "`harness study sweep`"),
        ("study swep", "`harness study sweep`"), ("models", "`harness model`"),
        ("scenaro", "`harness dataset scenario`"),
    ],
)  # fmt: skip
def test_a_slip_is_answered_with_what_was_meant(
    harness: Callable[..., Said], typed: str, meant: str
) -> None:
    code, out, err = harness(*typed.split())
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert f"No such command {typed.split()[-1]!r} (did you mean {meant}" in err
    assert f"?) in `harness {typed}`; see" in err
