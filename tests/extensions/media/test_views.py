"""What part of the world each still of a video shows, on spots put by hand."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from harness.extensions.media.views import EASE, views
from harness.report.drawing.geometry import MARGIN_M

places = st.lists(st.tuples(*[st.floats(-150, 150)] * 2), min_size=1, max_size=6)


def drive(stills, speed):
    """An ego that drives so many metres a still to the east,
    and who is asked in every other part.
    """
    asked = [np.array([[40.0, 50.0]]) if n // 20 % 2 else np.empty((0, 2)) for n in range(stills)]
    return [np.vstack([[-60.0 + speed * n, 0.0], more]) for n, more in enumerate(asked)]


def test_a_video_holds_its_view_and_turns_to_the_next_before_the_decision():
    parts = [n // 20 for n in range(60)]
    shown = views(drive(60, 1.0), parts)
    assert len(shown) == 60
    for part in range(3):
        until = 20 * (part + 1) - (EASE if part < 2 else 0)
        assert len(set(shown[20 * part : until])) == 1
    turning = [view.width_m for view in shown[12:21]]
    assert turning == sorted(turning)
    assert turning[0] > shown[11].width_m, "the first still of a turn moves"
    assert turning[-1] == shown[39 - EASE].width_m


def test_a_video_does_not_jump():
    shown = views(drive(100, 1.0), [n // 20 for n in range(100)])
    most = max(abs(b.width_m - a.width_m) for a, b in pairwise(shown))
    assert most < 0.2 * (max(v.width_m for v in shown) - min(v.width_m for v in shown))


@given(
    st.lists(places.map(np.array), min_size=1, max_size=40),
    st.integers(1, 12),
    st.integers(0, 11),
)
def test_every_still_shows_all_of_what_it_holds_on_the_way_from_view_to_view_too(at, every, begun):
    parts = [(n + begun) // every for n in range(len(at))]
    shown = views(at, parts)
    assert len(shown) == len(at)
    assert all(view.holds(spots, MARGIN_M - 1e-6) for view, spots in zip(shown, at, strict=True))
