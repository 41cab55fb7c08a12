"""Labels beside what they name, moved aside until they cover nothing."""

import numpy as np
from matplotlib.axes import Axes

from harness.core.arrays import Floats

DIRECTIONS = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]], dtype=float)
DISTANCES_M = (1.0, 4.0, 8.0, 13.0, 19.0, 26.0, 34.0, 44.0)
NOWHERE = np.zeros(2)


class Labels:
    """Labels of one picture, collected first and placed together.

    Attributes:
        axes: where they go; its data are metres.
        pt_per_m: scale of the picture.
        size_pt: font size.
        view_m: labels stay within ±view_m.
    """

    def __init__(self, axes: Axes, pt_per_m: float, size_pt: float, view_m: float) -> None:
        self.axes, self.pt_per_m, self.size_pt, self.view_m = axes, pt_per_m, size_pt, view_m
        self._taken: list[Floats] = []
        self._unloved: list[Floats] = []
        self._waiting: list[tuple[Floats, float, str, bool, str, Floats]] = []

    def block(self, points: Floats) -> None:
        """Keep labels off the box around points (n, 2) m."""
        self._taken.append(np.array([points.min(axis=0), points.max(axis=0)]))

    def discourage(self, points: Floats) -> None:
        """Keep labels off the box around points (n, 2) m unless they would have to go far."""
        self._unloved.append(np.array([points.min(axis=0), points.max(axis=0)]))

    def add(
        self,
        at: Floats,
        radius_m: float,
        text: str,
        bold: bool = False,
        colour: str = "#222222",
        toward: Floats = NOWHERE,
    ) -> None:
        """A label for what lies at (2,) m and reaches radius_m, best on the side `toward` (2,) points to."""
        self._waiting.append((at, radius_m, text, bold, colour, toward))

    def place(self) -> None:
        """Put every label at the nearest free place, with a line to what it names if that is far."""
        for at, radius_m, text, bold, colour, toward in self._waiting:
            half = self._half_size(text, bold)
            spots = np.array(
                [at + d * (half + gap) for gap in radius_m + np.array(DISTANCES_M) - 1 for d in DIRECTIONS]
            )
            cost = np.array([self._cost(spot, half, at, toward) for spot in spots])
            spot = spots[int(cost.argmin())]
            self._taken.append(np.array([spot - half, spot + half]))
            edge = at.clip(spot - half, spot + half)
            if np.hypot(*(edge - at)) > radius_m + 3.0:
                self.axes.plot(*np.array([at, edge]).T, color=colour, linewidth=0.6, zorder=4)
            self.axes.text(
                spot[0], spot[1], text, size=self.size_pt, weight="bold" if bold else "normal", color=colour,
                ha="center", va="center", linespacing=1.1, zorder=5,
                bbox={"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 0.8},
            )  # fmt: skip

    def _half_size(self, text: str, bold: bool) -> Floats:
        lines = text.split("\n")
        width_em = max(map(len, lines)) * (0.66 if bold else 0.58)
        return np.array([width_em, 1.2 * len(lines)]) * self.size_pt / self.pt_per_m / 2 + 0.6

    def _cost(self, spot: Floats, half: Floats, at: Floats, toward: Floats) -> float:
        """Metres away, and far more than any distance for what would be covered or cut."""

        def covered(boxes: list[Floats]) -> int:
            return sum(bool(np.all((spot - half < box[1]) & (spot + half > box[0]))) for box in boxes)

        cut = np.maximum(np.abs(spot) + half - self.view_m, 0.0).max()
        away_m = np.hypot(*(at.clip(spot - half, spot + half) - at))
        wrong_side_m = 10.0 if (spot - at) @ toward < 0 else 0.0
        return float(
            away_m + wrong_side_m + 12.0 * covered(self._unloved) + 1000.0 * (covered(self._taken) + cut)
        )
