"""A page of sentences, figures and tables: of a study, a suite, or runs by date.

It runs no script but, where it has charts, those that draw them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from markupsafe import Markup

from harness.core.figures import Bounded, number_or_none
from harness.report import library
from harness.report.templating import environment, visible

# characters of a cell at the right of its column, such as a number with its interval
LONGEST_NUMBER = 40
WIDTH, HEIGHT = 240, 22  # of a line of a forest plot


@dataclass(frozen=True)
class Table:
    """Hold a table of text to show on a page and in a terminal.

    `title` stands above it and `note` below. `heads` are the columns' titles, `rows` the cells;
    `terminal` are the indices of the columns that a terminal shows, and `most` is how many rows it
    shows, None for all. `left` aligns all columns left and wraps none, `folded` shows the table
    after a click, and `total` says that the last row is about all others.
    """

    title: str  # what stands above it
    heads: Sequence[str]  # of the columns; the first column names the rows
    # the cells of each; `Markup` is shown as it is on the page, and as text in a terminal
    rows: Sequence[Sequence[str]]
    note: str = ""  # what stands below it on the page
    # the columns that a terminal has room for; none where only the page shows the table
    terminal: Sequence[int] = ()
    most: int | None = None  # how many rows a terminal shows; None for all
    # whether all columns begin at the left and none wraps: text, or several lines a cell
    left: bool = False
    folded: bool = False  # whether the page shows it after a click
    total: bool = False  # whether the last row is about all others

    @property
    def words(self) -> list[bool]:
        """Return which columns hold sentences: for each, whether a cell is longer than a number.

        Such a cell is longer than `LONGEST_NUMBER`; the column is left-aligned and wraps.
        """
        columns = range(len(self.heads))
        longest = [0 for _ in columns]
        for row in self.rows:
            for n in columns:
                longest[n] = max(longest[n], len(Markup(row[n]).striptags()))
        return [length > LONGEST_NUMBER for length in longest]

    @property
    def in_terminal(self) -> tuple[list[str], list[list[str]]]:
        """Return heads and rows of the columns `terminal` without HTML, up to `most` rows."""
        heads = [self.heads[n] for n in self.terminal]
        rows = []
        for row in self.rows[: self.most]:
            rows.append([_plain(row[n]) for n in self.terminal])
        return heads, rows


@dataclass(frozen=True)
class Chart:
    """Hold a chart that a page draws: a Vega-Lite specification between its title and caption."""

    title: str  # what is drawn over what
    spec: Mapping[str, Any]  # a Vega-Lite specification
    caption: str = ""  # how to read it


@dataclass(frozen=True)
class Section:
    """Hold the text, tables and charts of one part of a page: about a study, a suite or a run.

    `headline` is the outcome, `about` how it was made, and `numbers` the key figures, each with
    `what`, `value`, `interval` and `n`. `warnings` say why there is no outcome, `caveats` what a
    reader must know first. `charts` are by their names in the page; `more` is shown below the
    tables.
    """

    title: str  # what was run
    headline: Sequence[str] = ()  # the outcome in sentences
    # how it was made: n, what the intervals are over, and what the outcome is conditional on
    about: Sequence[str] = ()
    tables: Sequence[Table] = ()  # in the order of the page
    warnings: Sequence[str] = ()  # why the outcome is none; they stand above it
    caveats: Sequence[str] = ()  # what a reader must know first
    # what is read first: dicts with `what`, `value`, `interval` and `n` as text
    numbers: Sequence[Mapping[str, str]] = ()
    charts: Mapping[str, Chart] = field(default_factory=dict)  # by their names in the page
    more: Markup = field(default_factory=Markup)  # below the tables


def document(sections: Sequence[Section]) -> str:
    """Return an HTML page of these sections, one below the other.

    Its title is that of the first.
    """
    charts = {name: chart.spec for section in sections for name, chart in section.charts.items()}
    template = environment().get_template("sections.html.j2")
    return template.render(sections=sections, charts=charts, library=library)


def strong(text: str, when: bool = True) -> str:
    """Return the text in bold for a page if `when`; otherwise unchanged."""
    return Markup("<strong>{}</strong>").format(text) if when else text


def linked(text: str, href: str | None) -> Markup:
    """Return the text as HTML with a link to `href`; just the text if that is None or empty."""
    return Markup('<a href="{}">{}</a>' if href else "{1}").format(href, visible(text))


def _plain(cell: str) -> str:
    return cell.striptags() if isinstance(cell, Markup) else cell


def reach(bounded: Iterable[Bounded]) -> tuple[float, float]:
    """Return the least and greatest of all values and interval ends; (0, 1) if there are none.

    `bounded` has what has a `value`, and the ends `low` and `high` of its interval; what is unknown
    is left out.
    """
    numbers = list[float]()
    for each in bounded:
        ends = (number_or_none(each.value), number_or_none(each.low), number_or_none(each.high))
        numbers += [number for number in ends if number is not None]
    return min(numbers, default=0.0), max(numbers, default=1.0)


def forest(bounded: Bounded, least: float, most: float, verdict: str = "") -> Markup:
    """Draw one row of a forest plot as SVG: a square at the value and a line for its interval.

    A forest plot shows estimates one below the other on one scale. A vertical line marks 0 where
    the scale contains it.

    Args:
        bounded: the value, with its interval.
        least: the left end of the scale.
        most: its right end.
        verdict: `better` or `worse`, each drawn in a colour of its own; empty for neither.
    """
    y = HEIGHT / 2

    def x(value: float) -> float:
        return round(8 + (value - least) / ((most - least) or 1.0) * (WIDTH - 16), 1)

    low, high = number_or_none(bounded.low), number_or_none(bounded.high)
    zero = interval = ""
    if least < 0 < most:
        zero = f'<path class="zero" d="M{x(0.0)} 0V{HEIGHT}"/>'
    if low is not None and high is not None:
        interval = f'<path d="M{x(low)} {y}H{x(high)}M{x(low)} {y - 3}v6M{x(high)} {y - 3}v6"/>'
    left = x(number_or_none(bounded.value) or 0.0) - 3.5
    square = f'<rect x="{left}" y="{y - 3.5}" width="7" height="7"/>'
    name = f"forest {verdict}".strip()
    return Markup(
        f'<svg class="{name}" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        f'aria-hidden="true">{zero}{interval}{square}</svg>'
    )
