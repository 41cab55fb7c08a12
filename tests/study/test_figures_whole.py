"""Figures of studies: nothing sticks out of pictures, however long names are, dark pages turn them
dark, and charts say the same.
"""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from whole_figures import LONG, NAMES, check

from harness.core.statistics import Estimate
from harness.report.charts import TAKEN
from harness.report.drawing import colours
from harness.report.drawing.colours import COLOURS, CONDITIONS, INK, PAGE
from harness.report.drawing.pictures import save
from harness.report.library import on_dark_too
from harness.studies.figures import charts, pictures
from harness.studies.figures.described import Draws, Rows, Steps

METRICS = (
    "success_rate", "latency_proxy_ms", "messages_per_episode", "trigger_rate", "effective_loss",
)  # fmt: skip
ESTIMATE = {"mean": 0.8253, "ci_low": 0.2, "ci_high": 0.9}
SEEN = Estimate(0.5, 0.2, 0.8, 9, 0)
PALETTE = set(re.findall("#[0-9a-f]{6}", Path(colours.__file__).read_text().lower()))
SHARES = np.linspace(0, 100, 4).reshape(2, 2)


def summary(variable: str, values: list[Any], sources: list[str]) -> pd.DataFrame:
    return pd.DataFrame([
        {"source": source, "panel": variable, "condition": name, "variable": variable, "value": value,
         "metric": metric, "interval": "episodes", **ESTIMATE}
        for source in sources for name in NAMES for value in values for metric in METRICS
    ])  # fmt: skip


def over(draws: Draws[Any], *variables: str) -> Any:
    return draws.along([summary(variable, [0.1, 0.9], ["run"]) for variable in variables])


def of_costs(draws: Draws[Any]) -> Any:
    lines = [Steps(name, [0, 9], [62.5, 82.5], INK, name=LONG) for name in NAMES]
    return draws.fronts([(LONG, "messages", lines)], "balanced success")


def of_rows(draws: Draws[Any]) -> Any:
    rows = Rows("share, %", ["one", "two"], {name: [SEEN, SEEN] for name in NAMES})
    return draws.intervals([rows], dict(zip(NAMES, COLOURS, strict=False)))


SOME = ("operating points", "a sweep", "intervals", "fronts")  # of each kind of figure one
FIGURES: Mapping[str, Callable[[Draws[Any]], Any]] = {
    "operating points": lambda draws: draws.operating_points(summary("", [0], ["run"])),
    "a sweep": lambda draws: over(draws, "loss"),
    "a sweep of three panels": lambda draws: over(draws, "loss", "size", "tau"),
    "a sweep over words": lambda draws: draws.along(
        [summary("consensus", ["geometric-median", "linear"], ["run"])]
    ),
    "two runs swept": lambda draws: draws.along(
        [summary("loss", [0.0, 0.5], ["proxy · v2 · json", LONG])]
    ),
    "crossed axes": lambda draws: draws.heat_map(
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
    check(FIGURES[name](pictures))


@pytest.mark.parametrize("name", FIGURES)
def test_a_chart_has_a_panel_for_each_of_the_pictures_and_every_name(name: str) -> None:
    drawn, picture = FIGURES[name](charts), FIGURES[name](pictures)
    beside = 1 if name == "operating points" else 0  # diamonds over bars: a chart of their own
    assert (
        len(drawn) == sum(axes.get_subplotspec() is not None for axes in picture.axes[:3]) + beside
    )
    specs = json.dumps([chart.spec for chart in drawn], allow_nan=False)
    named = (LONG,) if "crossed" in name else NAMES
    assert [each for each in named if each not in specs + drawn[0].title] == []
    assert set(re.findall("#[0-9a-f]{6}", specs.lower())) <= PALETTE


def test_a_name_of_a_javascript_object_is_told_apart_and_ink_is_light_on_dark_paper() -> None:
    name = sorted(TAKEN)[0]
    [chart] = charts.fronts([("", "messages", [Steps(name, [0, 9], [1, 2], INK)])], "success")
    specs = json.dumps(chart.spec)
    assert f'"{name}"' not in specs
    assert f'"{name} "' in specs
    assert INK not in specs


def test_a_condition_has_the_colour_that_reports_have_and_of_several_runs_each_curve_its_own() -> (
    None
):
    [axes, *_] = over(pictures, "loss").axes
    of_lines = {line.get_label(): line.get_color() for line in axes.lines}
    assert of_lines["success, 6g"] == CONDITIONS["6g"]
    assert of_lines["success, v2x"] == CONDITIONS["v2x"]
    assert len(set(of_lines.values())) == len(NAMES)
    [axes, *_] = pictures.along([summary("loss", [0.0, 0.5], ["one", "other"])]).axes
    assert [line.get_color() for line in axes.lines[:3]] == list(COLOURS[:3])


def test_a_page_turns_a_figure_dark_and_its_file_stays_light(tmp_path: Path) -> None:
    file = tmp_path / "map.svg"
    save(FIGURES["crossed axes"](pictures), file, "svg")
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
