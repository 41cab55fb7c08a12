"""Figures of studies as matplotlib draws them, for files."""

from collections.abc import Callable, Sequence

from matplotlib.figure import Figure

from harness.report.document import Chart
from harness.studies.figures.bars import operating_points
from harness.studies.figures.heat_map import heat_map
from harness.studies.figures.lines import along
from harness.studies.figures.points import fronts, intervals

__all__ = ["along", "either", "fronts", "heat_map", "intervals", "operating_points"]


def either(picture: Callable[[], Figure], panels: Callable[[], Sequence[Chart]]) -> Figure:
    """Draw what one study alone has, by its function `picture`."""
    return picture()
