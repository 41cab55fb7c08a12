"""What extensions say of decision points, and that one that fails takes nothing with it."""

import sys
from collections.abc import Iterator, Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest
from markupsafe import Markup
from run_on_disk import made_up

from harness.core.errors import UserError
from harness.report import remarks
from harness.report.runs import Runs
from harness.runs.folder import Run, read


class Says:
    """Says one thing."""

    def sentences(self, runs: Runs) -> Iterator[Markup]:
        yield Markup("<b>said</b> of {}").format(len(runs.runs))

    def left_out(self, run: Run) -> Mapping[str, list[dict[str, Any]]]:
        return {"00000-0": [{"item": "v1"}]}


class Fails:
    """Raises whatever it is asked."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def sentences(self, runs: Runs) -> Iterator[Markup]:
        raise self.error

    def left_out(self, run: Run) -> Mapping[str, list[dict[str, Any]]]:
        raise self.error


@pytest.fixture
def runs(tmp_path: Path) -> Runs:
    made_up(tmp_path / "run")
    return Runs((read(tmp_path / "run"),), ("run",), None)


def asked(monkeypatch: pytest.MonkeyPatch, **added: Any) -> None:
    monkeypatch.setattr(remarks.REMARKS, "built_in", added)
    monkeypatch.setattr(remarks.REMARKS, "_loaded", dict(added))


def test_what_one_says_stands_though_another_fails(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked(monkeypatch, broken=Fails(ValueError("<i>no</i>")), mine=Says(), again=Says())
    said = [text for text in remarks.sentences(runs) if "said" in text or "broken" in text]
    assert said == [
        "broken: its package failed: &lt;i&gt;no&lt;/i&gt;",
        "<b>said</b> of 1",
        "<b>said</b> of 1",
    ]
    assert remarks.left_out(runs.runs[0])["00000-0"] == [{"item": "v1"}] * 2


class Odd:
    """Raises as it is shown, and has things beside answers that no page can hold."""

    def __init__(self, beside: Any) -> None:
        self.beside = beside

    def __str__(self) -> str:
        raise ValueError("no text")

    def sentences(self, runs: Runs) -> list[Any]:
        return [self]

    def left_out(self, run: Run) -> Any:
        return self.beside


@pytest.mark.parametrize(
    "beside", [None, {"00000-0": 5}, {"00000-0": [{"shift": float("nan")}]}, {"a": [{"b": {1}}]}]
)
def test_what_no_page_can_hold_is_left_out(
    beside: Any, runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked(monkeypatch, odd=Odd(beside), mine=Says())
    said = [text for text in remarks.sentences(runs) if "said" in text or "odd" in text]
    assert said == ["odd: its package failed: its answer holds what is no text", "<b>said</b> of 1"]
    assert remarks.left_out(runs.runs[0]) == {"00000-0": [{"item": "v1"}]}


class Talks:
    """Says the same for ever, or ends the program."""

    def __init__(self, *words: str) -> None:
        self.words = words

    def sentences(self, runs: Runs) -> Iterator[str]:
        return cycle(self.words) if self.words else sys.exit(0)

    def left_out(self, run: Run) -> Any:
        sys.exit(0)


class Half(Says):
    """Says what no file can hold."""

    def sentences(self, runs: Runs) -> Iterator[Markup]:
        yield Markup("\ud83d")


@pytest.mark.parametrize(
    ("odd", "reason"),
    [
        (Talks("again"), "its answer holds more than 10000 texts"),
        (Half(), "its answer holds half a character, '\\ud83d'"),
        (Talks(), "remarks odd ends the program (SystemExit: 0 at "),
    ],
)
def test_who_does_not_stop_or_ends_the_program_takes_nothing_with_it(
    odd: Any, reason: str, runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked(monkeypatch, odd=odd, mine=Says())
    said = [text for text in remarks.sentences(runs) if "said" in text or "odd" in text]
    assert len(said) == 2
    assert reason in Markup(said[0]).unescape()
    assert said[1] == "<b>said</b> of 1"
    assert {"item": "v1"} in remarks.left_out(runs.runs[0])["00000-0"]


def test_a_broken_file_of_the_run_is_an_error(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    asked(monkeypatch, mine=Fails(UserError("its file is broken")))
    for ask in (lambda: remarks.sentences(runs), lambda: remarks.left_out(runs.runs[0])):
        with pytest.raises(UserError, match="its file is broken"):
            ask()
