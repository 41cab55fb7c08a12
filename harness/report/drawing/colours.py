"""One palette for charts, pictures and videos: a colour has one meaning, and a sign or a name says it again.

Blues are conditions, green to red is how something ended, purples are vehicles and their roles, browns are
actions. Conditions, outcomes and roles stand out from white and from dark paper (3 to 1 at least); actions,
from light to dark as they get faster, have an outline instead.
"""

from collections.abc import Iterable

INK, GREY, PALE = "#222222", "#777777", "#DDDDDD"
GOOD, LATE, BAD = "#009E73", "#BA7F00", "#C8321F"
OUTCOMES = {"good": GOOD, "late": LATE, "bad": BAD}
ROLES = {"ego": "#9645B0", "helper": "#B07CC6", "danger": "#D6246E", "merge": "#85709F", "other": "#FFFFFF"}
CONDITIONS = {"single-local": "#6B7480", "v2x": "#0072B2", "6g": "#2F97DB"}
_MORE = ("#5B5BD0", "#8094AC")
_SLOW_TO_FAST = ("#E6D7AE", "#CBB176", "#AE8A42", "#866828", "#5F430F")
# Of sources that a study draws along one axis; no page of a run has them.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", INK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


def conditions(names: Iterable[str]) -> dict[str, str]:
    """A colour for each operating point: the paper's have their own, a change of one has another."""
    found: dict[str, str] = {}
    for name in dict.fromkeys(names):
        free = [
            c for c in (CONDITIONS.get(name), *_MORE, *CONDITIONS.values()) if c and c not in found.values()
        ]
        found[name] = free[0] if free else GREY
    return found


def actions(names: Iterable[str]) -> dict[str, str]:
    """A colour for each action, in the scenario's order, from slow to fast."""
    every = list(names)
    last = max(len(every) - 1, 1)
    return {name: _SLOW_TO_FAST[round(4 * n / last)] for n, name in enumerate(every)}


def variables() -> str:
    """The palette as properties of CSS: `--ego`, `--good` and so on."""
    return " ".join(f"--{name}-fill: {colour};" for name, colour in (OUTCOMES | ROLES).items())
