"""Every benchmark runs at its smallest, so that none dies unseen: benchmarks/table.py says how."""

import json
import re
import runpy
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.core.arrays import Floats
from harness.dataset.load import Dataset
from harness.runs.success import Success

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(BENCHMARKS))
import open_loop  # noqa: E402
import pages  # noqa: E402
import rows  # noqa: E402
import table  # noqa: E402

SCRIPTS = table.scripts()
# What the documents have somebody type is theirs; each line of what a benchmark prints last is one
# of JSON.
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
        assert all(table.line(rows.Row(**row), 0.0, {}).count("|") == 10 for row in found)


def test_the_page_names_every_benchmark() -> None:
    page = (BENCHMARKS / "README.md").read_text("utf-8")
    assert set(re.findall(r"python benchmarks/(\w+)\.py", page)) == {
        script.stem for script in SCRIPTS
    }


@pytest.mark.parametrize(
    ("unit", "measured", "mark"),
    [
        ("s", 1.2, ", **worse**"),
        ("s", 1.05, ""),
        ("s", 0.5, ""),
        ("/s", 0.9, ", **worse**"),
        ("/s", 2.0, ""),
        ("ms", 9.0, ""),  # the page has another unit
    ],
)
def test_what_is_a_tenth_worse_than_the_page_is_marked(
    unit: str, measured: float, mark: str
) -> None:
    """The page is one that a table itself was written to."""
    former = "/s" if unit == "/s" else "s"
    page = "\n".join([table.heads(table.HEADS), table.line(rows.Row("it", 1, former, 1), 0, {})])
    line = table.line(rows.Row("it", measured, unit, 1), 0, table.figures(page))
    assert line.split(" | ")[2] == f"1 {former}{mark}"


@pytest.mark.slow
def test_no_sequence_clears_more_than_the_one_that_is_found(small: Dataset) -> None:
    """All sequences of three actions over all decisions, one by one."""
    forest, weights = small.forest, open_loop.weights(small.dangerous.astype(float))
    found = forest.sequence_success(open_loop.best(forest, weights)) @ weights
    every = product(forest.actions, repeat=int(forest.step.max()) + 1)
    assert found == pytest.approx(max(forest.sequence_success(each) @ weights for each in every))


@pytest.mark.slow
def test_pairs_of_policies_that_turn_round_are_told_from_those_that_are_equal() -> None:
    """Worked by hand: of six pairs three stay, one turns, and two are equal on a side."""
    import traffic_ranks  # which needs an extension

    every, half, none = np.ones(40), np.tile([0.0, 1.0], 20), np.zeros(40)
    ours = {"a": every, "b": half, "c": none, "d": none, "full-view": every}
    theirs = {"a": every, "b": none, "c": half, "d": none, "full-view": none}

    def side(name: str, success: dict[str, Floats]) -> Any:
        scenes = traffic_ranks.Scenes(name, Success(none > 0), success)
        return traffic_ranks.Side(name, (scenes,))

    found = traffic_ranks.compared(side("ours", ours), side("traffic", theirs), lambda name: True)
    assert found.policies == 4  # who sees everything has no rank
    assert (found.told, found.same, found.turned) == (4, 3, [("b", "c")])
    assert (found.first_only, found.second_only, found.neither, found.tied) == (1, 1, 0, 2)
    assert found.share == pytest.approx((0.75, 0.75, 0.75))
    assert found.tau == pytest.approx((0.4, 0.4, 0.4))
