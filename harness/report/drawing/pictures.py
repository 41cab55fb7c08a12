"""What pictures share: the look, and the same bytes every time."""

import io
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Literal

import matplotlib
from cycler import cycler
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from harness.core.errors import unknown
from harness.core.files import write_whole
from harness.report.drawing.colours import COLOURS, INK

Format = Literal["svg", "pdf", "png"]
FORMATS: tuple[Format, ...] = ("svg", "pdf", "png")

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.prop_cycle": cycler(color=COLOURS),
    "xtick.color": INK,
    "ytick.color": INK,
    "pdf.fonttype": 42,  # text stays text, as journals ask
    "hatch.linewidth": 0.7,
    "svg.fonttype": "none",
    "svg.hashsalt": "swarmdrive",
    "text.color": INK,
    "text.parse_math": False,  # a dollar sign in a name is a dollar sign
}

styled = matplotlib.rc_context(STYLE)  # decorator: what is drawn inside has the look


@styled
def save(figure: Figure, out: Path | BinaryIO, format: Format, dpi: int = 150) -> None:
    """Write a figure to a file or stream; the same figure gives the same bytes.

    Args:
        figure: a figure drawn in a function decorated by `styled`.
        out: the file to replace, or a binary stream.
        format: `svg`, `pdf` (both keep text as text) or `png`.
        dpi: pixels an inch of a PNG.

    Raises:
        UserError: the format is unknown.
    """
    if format not in FORMATS:
        raise unknown("picture format", format, FORMATS)
    data = io.BytesIO()
    lay_out(figure)
    with warnings.catch_warnings():
        # A name in a script that the measuring font lacks is still text in the SVG.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        # `savefig` would draw everything twice, the first time to find what sticks out, which is
        # not asked.
        if format == "svg":
            nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
            FigureCanvasSVG(figure).print_svg(data, metadata=nothing)  # type: ignore[no-untyped-call]
        elif format == "pdf":
            nothing = dict.fromkeys(("CreationDate", "Producer", "Creator"))
            with _undated():
                FigureCanvasPdf(figure).print_pdf(data, metadata=nothing)  # type: ignore[no-untyped-call]
        else:
            figure.set_dpi(dpi)
            FigureCanvasAgg(figure).print_png(data, metadata={"Software": None})  # type: ignore[no-untyped-call]
    if isinstance(out, Path):
        write_whole(out, data.getvalue())
    else:
        out.write(data.getvalue())


def lay_out(figure: Figure) -> None:
    """Run a figure's layout engine once and switch it off, since it takes half of the drawing time.

    The engine gives axes and labels their places. A figure grows if something, such as a long
    legend entry, sticks out of it.
    """
    layout = figure.get_layout_engine()
    if layout is None:
        return
    layout.execute(figure)
    width, height = figure.get_size_inches()
    around = figure.get_tightbbox()
    beside = max(-around.x0, around.x1 - width, 0.0)
    above = max(-around.y0, around.y1 - height, 0.0)
    if beside or above:
        figure.set_size_inches(width + 2 * beside, height + 2 * above)
        layout.execute(figure)
    figure.set_layout_engine("none")


@contextmanager
def _undated() -> Iterator[None]:
    """Leave out the date of the environment: Matplotlib reads it, and fails at one that is none."""
    date = os.environ.pop("SOURCE_DATE_EPOCH", None)
    try:
        yield
    finally:
        if date is not None:
            os.environ["SOURCE_DATE_EPOCH"] = date
