"""Points with intervals along rows: what is drawn is what was estimated."""

import math
from typing import Any

import pytest

from harness.core.statistics import Estimate
from harness.studies.figures import charts
from harness.studies.figures.described import Rows
from harness.studies.figures.points import intervals

HALF, LOW = Estimate(0.5, 0.25, 0.875, 8, 0), Estimate(0.125, math.nan, math.nan, 1, 0)
NONE = Estimate(math.nan, math.nan, math.nan, 0, 8)
COLOURS = {"a": "#112233", "b": "#445566"}


def test_each_point_and_interval_is_where_its_estimate_says() -> None:
    rows = Rows(
        "share, %", ["one", "two", "three"], {"a": [HALF, None, NONE], "b": [None, LOW, HALF]}
    )
    figure = intervals([rows], COLOURS)
    axes: Any = figure.axes[0]
    a, b = axes.containers
    assert a.lines[0].get_xdata() == pytest.approx([50])
    assert b.lines[0].get_xdata() == pytest.approx([12.5, 50])
    assert [round(y) for y in a.lines[0].get_ydata()] == [0]
    assert [round(y) for y in b.lines[0].get_ydata()] == [1, 2]
    assert a.lines[0].get_ydata()[0] != b.lines[0].get_ydata()[1] - 2, (
        "series do not lie over each other"
    )
    for drawn, ends in ((a, [[25, 87.5]]), (b, [[12.5, 12.5], [25, 87.5]])):
        [bars] = drawn.lines[2]
        assert [segment[:, 0].tolist() for segment in bars.get_segments()] == ends
    assert [label.get_text() for label in axes.get_yticklabels()] == ["one", "two", "three"]
    bottom, top = axes.get_ylim()
    assert bottom > top, "the first row is at the top"
    low, high = axes.get_xlim()
    assert low <= 0
    assert high >= 100
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b"]


def test_a_chart_has_the_same_points_and_ends() -> None:
    rows = Rows("share, %", ["one", "two"], {"a": [HALF, None], "b": [LOW, NONE]})
    [chart] = charts.intervals([rows], COLOURS)
    assert chart.spec["data"]["values"] == [
        {"name": "one", "series": "a", "value": 50, "low": 25, "high": 87.5},
        {"name": "one", "series": "b", "value": 12.5, "low": None, "high": None},
    ]


def test_a_series_of_which_nothing_is_known_is_in_the_legend_and_draws_nothing() -> None:
    figure = intervals([Rows("TV", ["one"], {"a": [NONE], "b": [HALF]}, 1.0)], COLOURS)
    drawn: Any = figure.axes[0].containers
    assert [len(each.lines[0].get_xdata()) for each in drawn] == [0, 1]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b"]
