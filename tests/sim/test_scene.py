"""The state of the world as a value."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core.files import canonical_json
from harness.world.crossroads import APPROACHES, ROUTES
from harness.world.state import Building, VehicleState, WorldState, rectangle

numbers = st.floats(-1e4, 1e4)
vehicles = st.builds(
    VehicleState, st.from_regex(r"v[1-9]", fullmatch=True), st.sampled_from(["car", "truck"]),
    st.sampled_from(["ego", "helper", "other"]), numbers, numbers, numbers, numbers,
    st.sampled_from(APPROACHES), st.sampled_from(ROUTES), st.booleans(),
)  # fmt: skip
buildings = st.builds(
    Building, st.from_regex(r"b[1-9]", fullmatch=True), numbers, numbers, numbers, numbers
)
states = st.builds(
    WorldState, st.text(), st.integers(0, 2**31), st.integers(0, 6), numbers, numbers,
    st.lists(vehicles, min_size=1, max_size=5).map(tuple), st.lists(buildings, max_size=4).map(tuple),
)  # fmt: skip


@pytest.mark.slow
@given(states)
def test_a_state_survives_json_exactly(state):
    assert msgspec.json.decode(canonical_json(msgspec.to_builtins(state)), type=WorldState) == state


@given(states)
def test_the_ego_is_the_first_vehicle_and_helpers_keep_their_order(state):
    assert state.ego is state.vehicles[0]
    assert [v for v in state.vehicles if v in state.helpers] == [
        v for v in state.vehicles if v.part == "helper"
    ]


def test_corners_start_at_the_front_left_and_go_round_clockwise():
    # Heading north (−y), 5 m long, 2 m wide: the front is at y −2.5, its left at x −1.
    corners = rectangle(0.0, 0.0, -math.pi / 2, 5.0, 2.0)
    assert np.allclose(corners, [[-1, -2.5], [1, -2.5], [1, 2.5], [-1, 2.5]])


def test_a_truck_is_longer_and_wider_than_a_car():
    car, truck = (
        VehicleState("v5", kind, "other", 0, 0, 0, 0, "left", "straight", False)
        for kind in ("car", "truck")
    )
    assert (car.length_m, car.width_m, truck.length_m, truck.width_m) == (5.0, 2.0, 10.0, 2.6)
