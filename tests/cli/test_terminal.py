"""Numbers as people read them."""

import math

import numpy as np
import pytest

from harness.cli.terminal import table
from harness.core.figures import PERCENT
from harness.runs.estimates import over_episodes


def test_an_interval_that_nobody_knows_is_a_dash():
    assert PERCENT.interval(0.5, 0.4, 0.6) == "50.0 [40.0, 60.0]"
    assert PERCENT.interval(0.5, math.nan, None) == "50.0 [–, –]"
    assert PERCENT.interval(math.nan, math.nan, math.nan) == PERCENT.text(None) == "–"
    assert (PERCENT.text(-1e-9), PERCENT.number(0.5, "+")) == ("0.0 %", "+50.0")


def test_a_name_that_leaves_no_room_for_its_row_stands_above_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Figures of 62 columns and a space before each leave 15."""
    cells = ("100.0 [43.9, 100.0]", "-33.3 [-79.2, 29.1]", "x" * 24)
    names = ("6g:loss=0.12345", "6g:messages=shuffled", "a" * 85)
    table(("condition", "success", "gain", "more"), [(name, *cells) for name in names])
    figures = "100.0 [43.9, 100.0] -33.3 [-79.2, 29.1] xxxxxxxxxxxxxxxxxxxxxxxx"
    assert capsys.readouterr().out.splitlines() == [
        "condition       " + "            success                gain                     more",
        "6g:loss=0.12345 " + figures,
        "6g:messages=shuffled", " " * 16 + figures,
        "a" * 80, "a" * 5, " " * 16 + figures,
    ]  # fmt: skip


def test_columns_are_two_spaces_apart_where_names_have_room(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = [("blind-merge", "1.0", "12"), ("日本", "-", "3")]
    table(("family", "6g:messages=shuffled,loss=0.25", "n"), rows)
    assert capsys.readouterr().out.splitlines() == [
        "             6g:messages=shuffled,",
        "family                   loss=0.25   n",
        "blind-merge                    1.0  12",
        "日本                             -   3",
    ]


def test_no_interval_reaches_where_its_metric_cannot_be():
    rare = np.zeros((1, 40))
    rare[0, 0] = 1.0
    assert over_episodes("other_crashes_per_episode", rare).low == 0.0
    losses = np.where(np.arange(40) < 39, 0.0, 0.5)[None]
    assert over_episodes("effective_loss", losses).low == 0.0
