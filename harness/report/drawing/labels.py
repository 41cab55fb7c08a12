"""Labels beside what they name, moved aside until they cover nothing."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from harness.core.arrays import Floats
from harness.report.drawing.colours import INK
from harness.report.drawing.geometry import View

DIRECTIONS = np.array(
    [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]], dtype=float
)
DISTANCES_M = (1.0, 4.0, 8.0, 13.0, 19.0, 26.0, 34.0, 44.0)  # in a picture of the whole world
NOWHERE = np.zeros(2)


def covered(spots: Floats, half: Floats, boxes: Sequence[Floats]) -> Floats:
    """Return for a label at each of n centres how many boxes it would overlap, (n,).

    `spots` are the centres (n, 2), m east and north; `half` is half the label's width and height
    (2,), m; a box is its two opposite corners (2, 2).
    """
    if not boxes:
        return np.zeros(len(spots))
    low, high = np.swapaxes(np.array(boxes), 0, 1)
    over = (spots[:, None] - half < high) & (spots[:, None] + half > low)
    many: Floats = over.all(axis=-1).sum(axis=1).astype(float)
    return many


def cut(spots: Floats, half: Floats, view: View) -> Floats:
    """Return how far a label at each of n centres would stick out of the view, (n,), m.

    `spots` are the centres (n, 2), m east and north, and `half` is half the label's width and
    height, (2,), m.
    """
    low, high = view.edges
    out: Floats = np.maximum(low - (spots - half), spots + half - high).max(axis=1).clip(0.0)
    return out


def crossed(at: Floats, ends: Floats, lines: Sequence[Floats]) -> Floats:
    """Return how many of some lines a straight line from a point to each of n ends crosses, (n,).

    `at`, (2,), is the point, and `ends`, (n, 2), are the ends; a line of `lines` is its two ends
    (2, 2), all m east and north.
    """
    if not lines:
        return np.zeros(len(ends))
    a, b = np.swapaxes(np.array(lines), 0, 1)

    def side(p: Floats, q: Floats, r: Floats) -> Floats:
        (x, y), (u, v) = np.moveaxis(q - p, -1, 0), np.moveaxis(r - p, -1, 0)
        sign: Floats = np.sign(x * v - y * u)
        return sign

    end = ends[:, None]
    apart = (side(at, end, a) == side(at, end, b)) | (side(a, b, at) == side(a, b, end))
    many: Floats = (~apart).sum(axis=1).astype(float)
    return many


class Labels:
    """Collect the labels of one picture and place them together, so that they cover nothing.

    Attributes:
        axes: the Matplotlib axes to draw on; data coordinates are metres.
        pt_per_m: points on paper for a metre.
        size_pt: font size, points.
        view: the rectangle that labels stay within.
    """

    def __init__(self, axes: Axes, pt_per_m: float, size_pt: float, view: View) -> None:
        self.axes, self.pt_per_m, self.size_pt, self.view = axes, pt_per_m, size_pt, view
        self._taken: list[Floats] = []
        self._unloved: list[Floats] = []
        self._leaders: list[Floats] = []
        self._waiting: list[tuple[Floats, float, str, bool, str, Floats]] = []

    def block(self, points: Floats) -> None:
        """Forbid labels to cover the bounding box of some points, (n, 2), m."""
        self._taken.append(np.array([points.min(axis=0), points.max(axis=0)]))

    def discourage(self, points: Floats) -> None:
        """Have labels cover the bounding box of some points only if all else is full.

        The points are (n, 2), m.
        """
        self._unloved.append(np.array([points.min(axis=0), points.max(axis=0)]))

    def free(self, boxes: Sequence[Floats]) -> Floats:
        """Choose the place for a box, such as a legend, that covers the least of what is drawn.

        `boxes` are the candidates, each two opposite corners (2, 2), m, all of one size; the first
        of equals is taken. Labels that are placed later keep off it.
        """
        half = (boxes[0][1] - boxes[0][0]) / 2
        taken = covered(np.array([box.mean(axis=0) for box in boxes]), half, self._taken)
        self.block(boxes[int(taken.argmin())])
        return boxes[int(taken.argmin())]

    def add(
        self,
        at: Floats,
        radius_m: float,
        text: str,
        bold: bool = False,
        colour: str = INK,
        toward: Floats = NOWHERE,
    ) -> None:
        """Add a label, `text`, for an object of a radius around a place; `place` draws it later.

        `at` is the place, (2,), and `radius_m` the radius, both m. `toward` (2,) is the preferred
        direction from the object to the label; zero for none. `colour` and `bold` are of the text.
        """
        self._waiting.append((at, radius_m, text, bold, colour, toward))

    def place(self) -> None:
        """Draw every label at the nearest free place; a distant one has a line to its object."""
        for at, radius_m, text, bold, colour, toward in self._waiting:
            half = self._half_size(text, bold)
            gaps = radius_m + self.view.scale * (np.array(DISTANCES_M) - 1)
            spots = np.array([at + d * (half + gap) for gap in gaps for d in DIRECTIONS])
            spot = spots[int(self._cost(spots, half, at, toward).argmin())]
            self._taken.append(np.array([spot - half, spot + half]))
            edge = at.clip(spot - half, spot + half)
            if np.hypot(*(edge - at)) > radius_m + 3.0 * self.view.scale:
                self.axes.plot(*np.array([at, edge]).T, color=colour, linewidth=0.6, zorder=4)
                self._leaders.append(np.array([at, edge]))
            self.axes.text(
                spot[0],
                spot[1],
                text,
                size=self.size_pt,
                weight="bold" if bold else "normal",
                color=colour,
                ha="center",
                va="center",
                linespacing=1.1,
                zorder=5,
                bbox={"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 0.8},
            )

    def _half_size(self, text: str, bold: bool) -> Floats:
        lines = text.split("\n")
        size_em = np.array([max(map(len, lines)) * (0.66 if bold else 0.58), 1.2 * len(lines)])
        return size_em * self.size_pt / self.pt_per_m / 2 + 0.6 * self.view.scale

    def _cost(self, spots: Floats, half: Floats, at: Floats, toward: Floats) -> Floats:
        """Return how far away each is, and far more than any distance for what would be covered or
        cut.
        """
        edges = at.clip(spots - half, spots + half)
        away: Floats = np.hypot(*(edges - at).T) / self.view.scale
        away += np.where((spots - at) @ toward < 0, 10.0, 0.0) + 20.0 * crossed(
            at, edges, self._leaders
        )
        beyond = cut(spots, half, self.view) / self.view.scale
        return (
            away
            + 12.0 * covered(spots, half, self._unloved)
            + 1000.0 * (covered(spots, half, self._taken) + beyond)
        )
