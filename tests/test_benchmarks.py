"""Every benchmark runs at its smallest, so that none dies unseen: benchmarks/table.py says how."""

import json
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(BENCHMARKS))
import pages  # noqa: E402
import rows  # noqa: E402
import table  # noqa: E402

SCRIPTS = table.scripts()
# What the documents have somebody type is theirs; each line of what a benchmark prints last is one of JSON.
pytestmark = pytest.mark.filterwarnings("default")


@pytest.mark.exhaustive
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_benchmark_runs_at_its_smallest(
    script: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    harness: Callable[..., tuple[int, str, str]],
) -> None:
    """In this process, and with it each command that it types, unless it measures that."""

    stated = SCRIPTS[script]
    if "UNTESTED" in stated:
        pytest.skip(stated["UNTESTED"])
    for package in stated.get("NEEDS", "").split():
        pytest.importorskip(package)

    def typed(*words: str) -> str:
        code, printed, said = harness(*words)
        assert code == 0, said
        return printed

    monkeypatch.setattr(pages, "harness", typed)
    monkeypatch.setattr(sys, "argv", [str(script), *stated["SMALLEST"].split()])
    runpy.run_path(str(script), run_name="__main__")
    if "TABLE" in stated:
        found = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
        assert found
        assert all(table.line(rows.Row(**row), 0.0).count("|") == 9 for row in found)


def test_the_page_names_every_benchmark() -> None:
    page = (BENCHMARKS / "README.md").read_text("utf-8")
    assert set(re.findall(r"python benchmarks/(\w+)\.py", page)) == {script.stem for script in SCRIPTS}
