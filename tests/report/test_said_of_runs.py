"""What is said of a run: the same sentences, in one order, wherever it is shown."""

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any, cast

import pytest
from run_on_disk import made_up

from harness.core.plugins import Plugins
from harness.report import caveats, notes, remarks, sections
from harness.report.document import Section, Table
from harness.report.runs import Runs
from harness.runs.folder import Run, read
from harness.runs.records import Manifest


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return read(made_up(tmp_path / "run"))


class Broken:
    """Fails, whatever it is asked."""

    def __call__(self, of: Any) -> Any:
        raise ValueError("no\nway")

    sentences = left_out = __call__


def test_a_package_that_fails_is_said_in_the_same_words_wherever_it_would_speak(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, table in ((caveats, "CAVEATS"), (sections, "SECTIONS"), (remarks, "REMARKS")):
        kind = getattr(module, table).kind
        monkeypatch.setattr(module, table, Plugins("swarmdrive.none", kind, {"odd": Broken()}))
    said = "odd: its package failed: no way"
    assert list(caveats.of_extensions(run)) == [said]
    alone = Runs((run,), ("run",), None)
    assert remarks.sentences(alone) == [said]
    [(title, content)] = sections.sections(alone)
    assert (title, said in content) == ("odd", True)


class Spiteful(str):
    """A text that raises where it is shown."""

    def __html__(self) -> str:
        raise ValueError("no way")

    __str__ = __html__

    def __format__(self, spec: str) -> str:
        return self.__html__()


ROW: Any = (("a", "b"), [("1", 2)])


@pytest.mark.parametrize(
    ("section", "said"),
    [
        (Section(cast("Any", 5)), "its title holds what is no text"),
        (Section("A", headline="one sentence"), "its headline holds what is no text"),
        (Section("A", caveats=[cast("Any", None)]), "its caveats holds what is no text"),
        (Section("A", about=[Spiteful("a")]), "its package failed: no way"),
        (Section("A", tables=[Table("T", *ROW)]), "a row of its tables holds what is no text"),
        (Section("A", tables=[Table("T", ("a", "b"), [("1",)])]), "its package failed: "),
        (Section("A", tables=[Table("T", ("a",), [(Spiteful("1"),)])]), "failed: no way"),
        (Section("A", tables=cast("Any", ["T"])), "its package failed: "),
        ("a text", "it returns a str and no Section"),
    ],
)
def test_a_section_that_cannot_be_shown_is_said_in_its_place(
    section: Any, said: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    packaged = Plugins("swarmdrive.none", Callable, {"odd": lambda run: section})
    monkeypatch.setattr(sections, "SECTIONS", packaged)
    [(title, content)] = sections.sections(Runs((run,), ("run",), None))
    assert (title, "odd: its package failed" in content, said in content) == ("odd", True, True)


def test_a_title_and_a_caveat_of_a_package_are_plain_where_they_are_shown(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    spiteful = Section(Spiteful("A"), about=["a sentence"])
    for module, table, said in (
        (sections, "SECTIONS", spiteful), (caveats, "CAVEATS", [Spiteful("B")]),
    ):  # fmt: skip
        packaged = Plugins("swarmdrive.none", Callable, {"odd": lambda of, said=said: said})
        monkeypatch.setattr(module, table, packaged)
    [(title, _)] = sections.sections(Runs((run,), ("run",), None))
    [caveat] = caveats.of_extensions(run)
    assert (type(title), title, type(caveat), caveat) == (str, "A", str, "B")


def test_a_package_changes_no_record_of_a_run(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def vandal(of: Any) -> list[str]:
        manifest = of if isinstance(of, Manifest) else of.manifest
        manifest.model["name"] = "better"
        manifest.conditions[0]["name"] = "EVIL"
        return []

    before = deepcopy(run.manifest)
    registries = ((caveats, "CAVEATS"), (notes, "NOTES"), (sections, "SECTIONS"))
    for module, name in registries:
        packaged = Plugins("swarmdrive.none", Callable, {"odd": vandal})
        monkeypatch.setattr(packaged, "is_ours", lambda name: False)
        monkeypatch.setattr(module, name, packaged)
    assert list(caveats.of_extensions(run)) == []
    assert list(notes.of_extensions(run)) == []
    sections.sections(Runs((run,), ("run",), None))
    assert run.manifest == before
