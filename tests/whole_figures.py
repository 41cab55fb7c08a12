"""What a figure of a study must be, however long its names are."""

from itertools import pairwise

from matplotlib.figure import Figure

from harness.report.drawing.pictures import lay_out

LONG = "v2x:schedule=always,weight_cap=0.5,max_helpers=2"
NAMES = ["6g", "v2x", LONG, f"{LONG},tau=0.5", "single-local"]
NEARLY = 0.01  # inches


def check(figure: Figure) -> None:
    """Nothing sticks out of it, and no title lies over another."""
    lay_out(figure)
    around, size = figure.get_tightbbox(), figure.get_size_inches()
    assert min(around.x0, around.y0) > -NEARLY
    assert max(around.x1 - size[0], around.y1 - size[1]) < NEARLY
    assert max(size) < 12, "a figure that grows is still one for a page"
    titles = [axes.title.get_window_extent() for axes in figure.axes if axes.get_title()]
    beside = [pair for pair in pairwise(titles) if pair[0].y0 == pair[1].y0]
    assert all(left.x1 < right.x0 for left, right in beside)
