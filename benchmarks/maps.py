"""What a layout costs on a map of n x n crossings, with and without a window.

The ego and six cars drive at the crossing in the middle, whatever lies around it.

    python benchmarks/maps.py [--crossings 1 2 4 8] [--layouts 4] [--decisions 2] [--windows 80 0]
"""

import argparse
import math
from time import process_time
from typing import Any

import gymnasium
import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.lane import CircularLane, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from rows import Row, finish

from harness.core.errors import UserError
from harness.dataset.freeze import freeze
from harness.extensions.environments.environment import joined, named
from harness.world import scenarios

SMALLEST = "--crossings 1 2 --layouts 1 --decisions 1"
NEEDS = "highway_env"
APART_M, HALF_M, BESIDE_M = 100.0, 12.0, 2.0  # of crossings; of one; of a lane from the middle
AHEAD = [(1, 0), (0, 1), (-1, 0), (0, -1)]  # east, south, west and north, y to the south


class Grid(AbstractEnv):  # type: ignore[misc] # highway-env is untyped
    """Drive across the middle one of n x n crossings, each with a lane in each direction."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        action = {"type": "DiscreteMetaAction", "lateral": False, "target_speeds": [0, 7, 14]}
        return {**super().default_config(), "action": action, "crossings": 1}

    def _reset(self) -> None:
        crossings = int(self.config["crossings"])
        self.road = Road(grid(crossings), np_random=self.np_random)
        middle = crossings // 2
        for heading, gap_m in ((0, 30.0), (1, 20.0), (2, 15.0), (3, 25.0), (1, 40.0), (2, 45.0)):
            self._place(IDMVehicle, middle, heading, gap_m + self.np_random.uniform(0, 5))
        self.vehicle = self._place(self.action_type.vehicle_class, middle, 0, 50.0)

    def _place(self, kind: Any, middle: int, heading: int, gap_m: float) -> Any:
        """Return a new vehicle that goes straight on, `gap_m` m before the middle crossing."""
        at = f"{middle} {middle}"
        column, row = middle - AHEAD[heading][0], middle - AHEAD[heading][1]
        before = f"{column} {row} out {heading}"
        street = before, f"{at} in {heading}", 0
        lane = self.road.network.get_lane(street)
        vehicle = kind(self.road, lane.position(lane.length - gap_m, 0), lane.heading_at(0), 14)
        vehicle.route = [street, (street[1], f"{at} out {heading}", 0)]
        self.road.vehicles.append(vehicle)
        return vehicle

    def _reward(self, action: Any) -> float:
        return float(self.vehicle.speed)

    def _is_terminated(self) -> bool:
        return bool(self.vehicle.crashed)

    def _is_truncated(self) -> bool:
        return bool(self.time >= 20)


def grid(crossings: int) -> Any:
    """Return the `RoadNetwork` of highway-env of so many crossings in a row, and so many rows."""
    network = RoadNetwork()
    places = [(column, row) for column in range(crossings) for row in range(crossings)]
    for column, row in places:
        middle = np.array([column, row]) * APART_M
        for heading, ahead in enumerate(AHEAD):
            along = np.array(ahead)
            right = np.array([-ahead[1], ahead[0]])
            entry = f"{column} {row} in {heading}"
            begins = middle - HALF_M * along + BESIDE_M * right
            _cross(network, (column, row), heading, middle, (along, right))
            before = f"{column - ahead[0]} {row - ahead[1]} out {heading}"
            length_m = APART_M - 2 * HALF_M
            network.add_lane(before, entry, StraightLane(begins - length_m * along, begins))
            if (column + ahead[0], row + ahead[1]) not in places:
                ends = middle + HALF_M * along + BESIDE_M * right
                beyond = StraightLane(ends, ends + length_m * along)
                network.add_lane(f"{column} {row} out {heading}", f"{entry} end", beyond)
    return network


def _cross(
    network: Any, crossing: tuple[int, int], heading: int, middle: Any, axes: tuple[Any, Any]
) -> None:
    """Add the three ways across a crossing of who comes with one of four headings."""
    (along, right), turn = axes, heading * math.pi / 2
    column, row = crossing
    entry = f"{column} {row} in {heading}"
    outs = [f"{column} {row} out {(heading + quarter) % 4}" for quarter in (0, 1, 3)]
    begins = middle - HALF_M * along + BESIDE_M * right
    network.add_lane(entry, outs[0], StraightLane(begins, begins + 2 * HALF_M * along))
    corner, quarter = middle - HALF_M * along, math.pi / 2
    to_the_right = CircularLane(
        corner + HALF_M * right, HALF_M - BESIDE_M, turn - quarter, turn, clockwise=True
    )
    to_the_left = CircularLane(
        corner - HALF_M * right, HALF_M + BESIDE_M, turn + quarter, turn, clockwise=False
    )
    network.add_lane(entry, outs[1], to_the_right)
    network.add_lane(entry, outs[2], to_the_left)


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--crossings", type=int, nargs="+", default=[1, 2, 4, 8])
    arguments.add_argument("--layouts", type=int, default=4)
    arguments.add_argument("--decisions", type=int, default=2)
    arguments.add_argument("--windows", type=float, nargs="+", default=[80.0, 0.0])
    given = arguments.parse_args()
    gymnasium.register("grid-v0", entry_point=Grid)
    print("| crossings | lanes | window | paths | CPU s a layout |\n|--:|--:|--:|--:|--:|")
    rows = []
    for crossings in given.crossings:
        lanes = len(grid(crossings).lanes_list())
        for window_m in given.windows:
            settings = f"decisions={given.decisions}", f"window_m={window_m:g}"
            name = joined(named("grid-v0", {"crossings": crossings}), settings)
            began_s = process_time()
            try:
                scenario = scenarios.get(name)
                freeze(scenario, {layout: layout for layout in range(given.layouts)})
            except UserError as error:
                print(f"| {crossings}² | {lanes} | {window_m:g} | | {error} |")
                continue
            cpu_s = (process_time() - began_s) / given.layouts
            paths = len(scenario.road().paths)
            print(f"| {crossings}² | {lanes} | {window_m:g} | {paths} | {cpu_s:.2f} |")
            rows.append(Row(f"{crossings}², window {window_m:g} m", cpu_s, "s", given.layouts))
    finish(rows)


if __name__ == "__main__":
    main()
