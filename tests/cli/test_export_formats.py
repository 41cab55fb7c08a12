"""Formats of `harness run export` that a package adds."""

import inspect
import sys
from collections.abc import Iterator
from importlib import reload
from pathlib import Path
from typing import Any, ClassVar

import pytest
from packaged import register

from harness.cli import export
from harness.core.errors import UserError
from harness.runs.exports import EXPORTS, Option
from harness.runs.folder import Run, read


def refusal(value: Any, option: str) -> str | None:
    return None if option == "--names-of" else f"--most {value:g} goes with --names-of"


class Names:
    """A format of a package: the conditions' names."""

    help, doing, needs = "Write names.", "writing names", ("no_module_of_an_extra",)
    options: ClassVar = {
        "most": Option(float, "How many.", refusal),
        "all": Option(bool, "All.", refusal),
    }

    def write(
        self, run: Run, file: Path, dataset: Path | None, most: float = 1, all: bool = False
    ) -> Path:
        file.write_text(" ".join(run.conditions[: None if all else int(most)]))
        return file


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A format of a package, and two whose names are taken or no option's."""
    added = {"names-of": Names(), "csv": Names(), "no name": Names()}
    monkeypatch.setattr(EXPORTS, "_loaded", dict(added))
    monkeypatch.setattr(EXPORTS, "_entries", lambda: added)
    reload(export)  # which looks for formats as it is imported
    yield
    monkeypatch.undo()
    reload(export)


@pytest.mark.usefixtures("names")
def test_a_package_adds_a_format_as_an_option_with_further_ones() -> None:
    def command(
        junit: Path | None = None, added: Any = None, out: Any = None, values: Any = None
    ) -> Any:
        return junit, added, values

    typed = export._with_formats(command)
    assert list(inspect.signature(typed).parameters) == ["junit", "names_of", "out", "most", "all"]
    file = Path("names")
    given = typed(junit=None, names_of=file, out=None, most=2.0, all=False)
    assert given == (None, {"--names-of": file}, {"--most": 2.0, "--all": False})


@pytest.mark.usefixtures("names")
def test_a_format_that_fails_is_one_line(proxy_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Names, "write", lambda *given, **options: [][0])
    usual: dict[str, Any] = {
        "as_jsonl": False,
        "out": None,
        "junit": None,
        "dataset": None,
        "as_csv": False,
        "schema": None,
    }
    with pytest.raises(
        UserError, match=r"^format --names-of fails \(IndexError: list index out of range at "
    ):
        export.command(run=proxy_run, names_of=Path("names"), most=None, all=False, **usual)


@pytest.mark.usefixtures("names")
def test_a_format_that_writes_nothing_is_one_line(
    proxy_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Names, "write", lambda *given, **options: None)
    usual: dict[str, Any] = {
        "as_jsonl": False,
        "out": None,
        "junit": None,
        "dataset": None,
        "as_csv": False,
        "schema": None,
    }
    with pytest.raises(
        UserError, match=r"^format --names-of fails \(ValueError: it wrote no file at "
    ):
        export.command(run=proxy_run, names_of=Path("names"), most=None, all=False, **usual)


@pytest.mark.parametrize(
    "odd", [{"help": 5}, {"options": None}, {"needs": None}, {"options": {"most": 3}}]
)
def test_a_format_whose_words_are_none_is_one_line(
    odd: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = (
        f"class Odd:\n    help, doing, needs, options = 'a', 'b', (), {{}}\n    {next(iter(odd))} "
        "= "
    )
    source += (
        f"{next(iter(odd.values()))!r}\n    def write(self, run, file, dataset):\n        "
        "pass\nODD = Odd()\n"
    )
    register(tmp_path / "site", f"[{EXPORTS.group}]\nodd = odd_format:ODD\n", odd_format=source)
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.delitem(sys.modules, "odd_format", raising=False)
    monkeypatch.setattr(EXPORTS, "_loaded", {})
    with pytest.raises(UserError, match=f"has {next(iter(odd))} .*; allowed: .*; repair"):
        EXPORTS["odd"]


@pytest.mark.usefixtures("names")
def test_a_format_gets_what_was_typed_of_its_options(proxy_run: Path, tmp_path: Path) -> None:
    file = tmp_path / "names"
    usual: dict[str, Any] = {
        "as_jsonl": False, "out": None, "junit": None, "schema": None, "dataset": None,
    }  # fmt: skip

    def written(most: float | None, all: bool) -> int:
        export.command(run=proxy_run, names_of=file, most=most, all=all, as_csv=False, **usual)
        return len(file.read_text().split())

    conditions = len(read(proxy_run).conditions)
    assert (written(None, False), written(2.0, False), written(None, True)) == (1, 2, conditions)
    as_csv: dict[str, Any] = {
        "run": proxy_run,
        "names_of": None,
        "as_csv": True,
        "all": False,
        **usual,
    }
    with pytest.raises(UserError, match="--most 2 goes with --names-of"):
        export.command(most=2.0, **as_csv)
    with pytest.raises(UserError, match="--dataset only goes with --names-of; leave it out"):
        export.command(most=None, **{**as_csv, "dataset": tmp_path})
