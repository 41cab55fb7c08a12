"""The palette of pages, charts, figures, pictures and videos: a colour has one meaning.

A sign or a name says it again. Blues are conditions, green to red is how something ended, purples
are roles of vehicles, browns are actions. Conditions, outcomes and roles stand out from white and
from dark paper (3 to 1 at least); actions, from light to dark as they get faster, have an outline
instead.
"""

from collections.abc import Iterable

INK, GREY, PALE, FAINT, WHITE, BLACK = (
    "#222222",
    "#777777",
    "#DDDDDD",
    "#ECECEC",
    "#FFFFFF",
    "#000000",
)
GOOD, LATE, BAD = "#009E73", "#BA7F00", "#C8321F"
OUTCOMES = {"good": GOOD, "late": LATE, "bad": BAD}
ROLES = {
    "ego": "#9645B0",
    "helper": "#B07CC6",
    "danger": "#D6246E",
    "fusion": "#85709F",
    "other": "#FFFFFF",
}
CONDITIONS = {"single-local": "#6B7480", "v2x": "#0072B2", "6g": "#2F97DB"}
FAILURES = (BAD, "#E2685A", "#9C2416", "#F0988D", "#6E160B", "#F7C4BD")  # a shade a kind
HATCHED = ("#E3CCEB", "#6A3D80")  # a helper on paper: between its lines, and the lines
# On light paper, and on dark.
PAGE = {
    "paper": (WHITE, "#16181B"), "ink": ("#1C1F23", "#E7E9EC"), "quiet": ("#5A626C", "#A3ABB5"),
    "line": ("#D5D9DE", "#3A4047"), "card": ("#F5F6F8", "#1F2327"), "bar": ("#2A4D8F", "#A8C0F0"),
    "good": ("#00634A", "#4FD1A5"), "bad": ("#A33C00", "#FF9D66"), "slow": ("#7A5200", "#E8B84A"),
    "code": ("#EEF0F3", "#282D33"), "mark": ("#FFE28A", "#6B5200"),
}  # fmt: skip
SCENE = {
    "ground": ("#F7F7F4", "#1F2327"), "road": ("#C9CCD1", "#3C4147"),
    "kerb": ("#8A8F98", "#8A8F98"), "building": ("#EAE4D6", "#34312A"),
    "wall": ("#A79F8A", "#6E6755"), "shade": ("#3A4047", "#000000"),
    "other": (WHITE, "#D5D9DE"), "outline": (INK, INK), "white": (WHITE, WHITE),
}  # fmt: skip
LIGHT = {name: light for name, (light, _) in SCENE.items()}
BUILDING_NAME = "#877E68"
ON_DATA = PAGE["ink"][0]  # of a number on a coloured cell, which stays light on dark paper
_MORE = ("#5B5BD0", "#8094AC")
_SLOW_TO_FAST = ("#E6D7AE", "#CBB176", "#AE8A42", "#866828", "#5F430F")
# Of sources that a study draws along one axis; no page of a run has them.
COLOURS = ("#0979AA", "#E67300", "#38948B", "#7033FF", "#A6683F", "#3D87F5", INK)
# Of numbers in a table, from the least to the most.
SHADES = (FAINT, CONDITIONS["v2x"])
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


def conditions(names: Iterable[str]) -> dict[str, str]:
    """Return a colour, a hex code, for each condition by its name.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages. Those of the paper keep their own colour.
    """
    chosen: dict[str, str] = {}
    for name in dict.fromkeys(names):
        free = [
            c
            for c in (CONDITIONS.get(name), *_MORE, *CONDITIONS.values())
            if c and c not in chosen.values()
        ]
        chosen[name] = free[0] if free else GREY
    return chosen


def actions(names: Iterable[str]) -> dict[str, str]:
    """Return a colour, a hex code, for each action by name; they are in order from slow to fast."""
    every = list(names)
    last = max(len(every) - 1, 1)
    return {name: _SLOW_TO_FAST[round(4 * n / last)] for n, name in enumerate(every)}


def variables() -> str:
    """Return the palette as CSS custom properties, such as `--paper` and `--ego-fill`."""
    fills = [f"--{name}-fill: {colour};" for name, colour in (OUTCOMES | ROLES).items()]
    pairs = [
        f"--{name}: light-dark({light}, {dark});" for name, (light, dark) in (PAGE | SCENE).items()
    ]
    return " ".join([*pairs, *fills])
