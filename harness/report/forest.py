"""A line of a forest plot: a value and its interval on a scale that all lines of it share."""

from collections.abc import Iterable

from markupsafe import Markup

from harness.core.figures import Bounded, known

WIDTH, HEIGHT = 240, 22


def reach(bounded: Iterable[Bounded]) -> tuple[float, float]:
    """Return the least and the greatest of values and ends; 0 and 1 of none."""
    each = [known(x) for b in bounded for x in (b.value, b.low, b.high)]
    numbers = [x for x in each if x is not None]
    return min(numbers, default=0.0), max(numbers, default=1.0)


def forest(bounded: Bounded, least: float, most: float, verdict: str = "") -> Markup:
    """Draw a value as a square and its interval as a line, with an upright line at 0 where that is between.

    Args:
        bounded: the value, with its interval.
        least: the left end of the scale.
        most: its right end.
        verdict: `better` or `worse`, which have a colour.
    """
    y = HEIGHT / 2

    def x(value: float) -> float:
        return round(8 + (value - least) / ((most - least) or 1.0) * (WIDTH - 16), 1)

    value, low, high = (known(number) for number in (bounded.value, bounded.low, bounded.high))
    zero = f'<path class="zero" d="M{x(0.0)} 0V{HEIGHT}"/>' if least < 0 < most else ""
    spread = ""
    if low is not None and high is not None:
        spread = f'<path d="M{x(low)} {y}H{x(high)}M{x(low)} {y - 3}v6M{x(high)} {y - 3}v6"/>'
    at, name = x(value or 0.0), f"forest {verdict}".strip()
    return Markup(
        f'<svg class="{name}" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        f'aria-hidden="true">{zero}{spread}<rect x="{at - 3.5}" y="{y - 3.5}" width="7" height="7"/></svg>'
    )
