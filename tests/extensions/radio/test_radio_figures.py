"""Figures of radios: nothing sticks out of them, however long names are, and all are drawn."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from whole_figures import LONG, NAMES, check

from harness.core.statistics import Estimate
from harness.extensions.radio.figures import crowds, reception
from harness.extensions.radio.reception import DISTANCES_M, Compared, Curve, Drawn
from harness.radio.profiles import CHANNELS

SEEN = Estimate(0.5, 0.2, 0.8, 9, 0)
LOSSES = {name: np.array([0.1, 0.2, 0.9]) for name in ["paper", *NAMES, "a", "b", "c"]}


def of_radio() -> Figure:
    radio: Any = CHANNELS.usable()["mode4"]
    curve = Curve("", "somebody", np.array([10.0, 200.0]), np.array([1.0, 0.5]))
    messages = [Drawn(distance, 0.5, SEEN, SEEN, 0.1) for distance in DISTANCES_M]
    return reception(LONG, radio, messages, [Compared(curve, np.array([0.9, 0.6]))])


FIGURES: Mapping[str, Callable[[], Figure]] = {
    "reception": of_radio,
    "crowds": lambda: crowds([2, 4, 8], LOSSES, f"{LONG} {LONG}"),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", FIGURES)
def test_nothing_sticks_out_of_a_figure_and_no_title_lies_over_another(name: str) -> None:
    check(FIGURES[name]())


def test_every_radio_is_drawn_however_many_there_are() -> None:
    [axes] = crowds([2, 4, 8], LOSSES, "").axes
    assert {line.get_label() for line in axes.lines} >= LOSSES.keys() - {"paper"}
