"""Figures of studies: nothing sticks out of them, however long names are,
and dark pages turn them dark.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from whole_figures import LONG, NAMES, check

from harness.core.statistics import Estimate
from harness.report.drawing.colours import COLOURS, CONDITIONS, INK, PAGE
from harness.report.drawing.pictures import save
from harness.report.library import on_dark_too
from harness.studies.figures.bars import operating_points
from harness.studies.figures.heat_map import heat_map
from harness.studies.figures.lines import along
from harness.studies.figures.points import Rows, Steps, fronts, intervals

METRICS = (
    "success_rate", "latency_proxy_ms", "messages_per_episode", "trigger_rate", "effective_loss",
)  # fmt: skip
ESTIMATE = {"mean": 0.8253, "ci_low": 0.2, "ci_high": 0.9}
SEEN = Estimate(0.5, 0.2, 0.8, 9, 0)
SHARES = np.linspace(0, 100, 4).reshape(2, 2)


def summary(variable: str, values: list[Any], sources: list[str]) -> pd.DataFrame:
    return pd.DataFrame([
        {"source": source, "panel": variable, "condition": name, "variable": variable, "value": value,
         "metric": metric, "interval": "episodes", **ESTIMATE}
        for source in sources for name in NAMES for value in values for metric in METRICS
    ])  # fmt: skip


def over(*variables: str) -> Figure:
    return along([summary(variable, [0.1, 0.9], ["run"]) for variable in variables])


def of_costs() -> Figure:
    lines = [Steps(name, [0, 9], [62.5, 82.5], {}, LONG) for name in NAMES]
    return fronts([(LONG, "messages", lines)], "balanced success")


def of_rows() -> Figure:
    rows = Rows("share, %", ["one", "two"], {name: [SEEN, SEEN] for name in NAMES})
    return intervals([rows], dict(zip(NAMES, COLOURS, strict=False)))


SOME = ("operating points", "a sweep", "intervals", "fronts")  # of each kind of figure one
FIGURES: Mapping[str, Callable[[], Figure]] = {
    "operating points": lambda: operating_points(summary("", [0], ["run"])),
    "a sweep": lambda: over("loss"),
    "a sweep of three panels": lambda: over("loss", "size", "tau"),
    "a sweep over words": lambda: along(
        [summary("consensus", ["geometric-median", "linear"], ["run"])]
    ),
    "two runs swept": lambda: along([summary("loss", [0.0, 0.5], ["proxy · v2 · json", LONG])]),
    "crossed axes": lambda: heat_map(
        {f"{LONG}, loss {n}": SHARES for n in "123"}, ["a", LONG], ["1", "2"]
    ),
    "intervals": of_rows,
    "fronts": of_costs,
}


@pytest.mark.parametrize(
    "name",
    [n if n in SOME else pytest.param(n, marks=pytest.mark.exhaustive) for n in FIGURES],
)
def test_nothing_sticks_out_of_a_figure_and_no_title_lies_over_another(name: str) -> None:
    check(FIGURES[name]())


def test_a_condition_has_the_colour_that_reports_have_and_of_several_runs_each_curve_its_own() -> (
    None
):
    [axes, *_] = over("loss").axes
    colours = {line.get_label(): line.get_color() for line in axes.lines}
    assert colours["success, 6g"] == CONDITIONS["6g"]
    assert colours["success, v2x"] == CONDITIONS["v2x"]
    assert len(set(colours.values())) == len(NAMES)
    [axes, *_] = along([summary("loss", [0.0, 0.5], ["one", "other"])]).axes
    assert [line.get_color() for line in axes.lines[:3]] == list(COLOURS[:3])


def test_a_page_turns_a_figure_dark_and_its_file_stays_light(tmp_path: Path) -> None:
    file = tmp_path / "map.svg"
    save(FIGURES["crossed axes"](), file, "svg")
    page = on_dark_too(file.read_bytes()).decode()
    assert "prefers-color-scheme" not in file.read_text()
    [rules] = re.findall(r"<style>@media \(prefers-color-scheme: dark\) {(.*?)}</style>", page)
    for colour in (PAGE["paper"][1], PAGE["ink"][1]):
        assert colour in rules
    assert f'[style*="fill: {INK}"]' in rules
    assert page.count(f"fill: {PAGE['ink'][0].lower()}") > 3, (
        "numbers on light cells, which no rule names"
    )
    assert PAGE["ink"][0].lower() not in rules.lower()


def test_a_picture_that_is_no_figure_of_ours_stays_as_it_is() -> None:
    for svg in (b"", b"<svg/>", b"\xff\xfe"):
        assert on_dark_too(svg) == svg
