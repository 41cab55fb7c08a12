"""`python readable.py`: how a page of code reads."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import readable

BROKEN = {
    "x = [a for b in c for a in [d for d in b]]": ["nested"],
    "x = [a for a in b for c in a for d in c]": ["nested"],
    "x = [a for b in c for a in b]": [],
    "f(*map(str, x))": ["spread"],
    "f(*x, **y)": [],
    "f(**(x if y else z))": ["spread"],
    "x = {**(a if b else c)}": ["spread"],
    "x = [a for b in c if (a := b)]": ["walrus"],
    "if (a := f()):\n    pass\nwhile b := g():\n    pass": [],
    "x = 1  # fmt: skip": ["unformatted"],
    "def found(self, own):\n    for its in own:\n        pass": ["word", "word", "word"],
    "class A:\n    own: int\n    own_s: float": [],
}


@pytest.mark.parametrize("source", BROKEN)
def test_what_a_line_breaks(source: str) -> None:
    assert [rule for rule, _ in readable.broken(source)] == BROKEN[source]


def test_a_ceiling_falls_and_never_rises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(readable, "ROOT", tmp_path)
    monkeypatch.setattr(readable, "CEILINGS", tmp_path / "readable.toml")
    page = tmp_path / "harness/extensions/view/page.py"
    page.parent.mkdir(parents=True)
    spread = "f(*map(str, x))\n"

    def ran(code: str, *typed: str) -> int:
        page.write_text(code)
        monkeypatch.setattr(sys, "argv", ["readable.py", *typed])
        return readable.main()

    assert ran(2 * spread, "--lower") == 0
    assert (ran(2 * spread), ran(3 * spread), ran(spread)) == (0, 1, 1)
    said = capsys.readouterr().out
    assert (
        "harness/extensions/view: `*map(…)`, or `**(… if … else …)`: 3 places, and at most 2"
        in said
    )
    assert "harness/extensions/view: spread: 1 of 2; type `python readable.py --lower`" in said
    ran(spread, "--lower")
    ran(3 * spread, "--lower")
    assert '[spread]\n"extensions/view" = 1\n' in readable.CEILINGS.read_text()
