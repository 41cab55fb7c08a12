"""What each token of a picture shows: how far the nearest vehicle in its square is.

A letter and a line of words are one answer a picture, too little for a vision encoder that begins with random
weights. This is an answer a token.
"""

import numpy as np

from harness.core.arrays import Ints
from harness.training.model import VISION
from harness.world.perception.camera import Sight

CLASSES = 10  # a digit each; 0 is nobody
STEP_M = 7.0  # from one to the next; the last has no end


def cells(sight: Sight) -> Ints:
    """Return the class of every token of a picture, (tokens,), row by row."""
    frame, viewer = sight.frame, sight.state.vehicle(sight.viewer_id)
    classes = np.zeros(len(frame.ids) + 1, dtype=np.int64)  # the last is of pixels that nobody owns
    places = {v.id: (v.x_m, v.y_m) for v in sight.state.vehicles}
    for n, name in enumerate(frame.ids):
        if name in places:
            x_m, y_m = places[name]
            away_m = float(np.hypot(x_m - viewer.x_m, y_m - viewer.y_m))
            classes[n] = 1 + min(CLASSES - 2, int(away_m / STEP_M))
    side = VISION.patch_px * VISION.merge
    height, width = frame.owners.shape
    squares = classes[frame.owners].reshape(height // side, side, width // side, side)
    nearest = np.where(squares == 0, CLASSES, squares).min(axis=(1, 3)).ravel()
    return np.where(nearest == CLASSES, 0, nearest)
