"""What part of the world each still of a video shows."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from harness.core.arrays import Floats
from harness.report.drawing.geometry import View, view_of

EASE = 8  # stills before a decision in which a video turns to its view


def views(held: Sequence[Floats], parts: Sequence[int], shape: float = 1.0) -> list[View]:
    """Return the part of the world that each still (picture) of a video shows from above.

    The view is fixed through each part of the video, such as a decision, and moves to the next
    one's in the part's last stills.

    Args:
        held: for each still, the points that must be in view: coordinates in metres, (n, 2).
        parts: for each still, the number of the part that it is in, ascending.
        shape: height of the view by its width.
    """
    starts = [0, *(n for n, (a, b) in enumerate(pairwise(parts), 1) if a != b), len(parts)]
    turns = [
        begin if begin == 0 else max(begin - EASE, last)
        for last, begin in pairwise([0, *starts[:-1]])
    ]
    # What is on its way from one part into the next is in the views of both, and so in all between
    # them.
    targets = [
        view_of(np.concatenate(held[turn:end]), shape)
        for turn, end in zip(turns, starts[1:], strict=True)
    ]
    stills = []
    for n, target in enumerate(targets):
        turn, end = turns[n + 1] if n + 1 < len(targets) else starts[n + 1], starts[n + 1]
        stills += [target] * (turn - starts[n])
        for still in range(turn, end):
            share = (still - turn + 1) / (end - turn + 1)
            stills.append(_toward(target, targets[n + 1], share * share * (3 - 2 * share)))
    return stills


def _toward(view: View, target: View, share: float) -> View:
    """Return a view on the way to another."""
    return View(
        view.west_m + share * (target.west_m - view.west_m),
        view.south_m + share * (target.south_m - view.south_m),
        view.width_m + share * (target.width_m - view.width_m),
        view.height_m + share * (target.height_m - view.height_m),
    )
