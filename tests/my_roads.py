"""A car has broken down in the ego's lane, behind a truck that hides it."""

import gymnasium
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle


class Truck(IDMVehicle):
    LENGTH, WIDTH = 10.0, 2.6


class Breakdown(AbstractEnv):
    @classmethod
    def default_config(cls):
        return {
            **super().default_config(),
            "action": {"type": "DiscreteMetaAction", "target_speeds": [0, 7, 14]},
            "stands_m": 95.0,
        }

    def _reset(self):
        network = RoadNetwork()
        edge, dashed, none = LineType.CONTINUOUS_LINE, LineType.STRIPED, LineType.NONE
        for y, lines in ((0, (edge, none)), (4, (dashed, edge))):
            network.add_lane("a", "b", StraightLane([0, y], [400, y], line_types=lines))
        self.road = Road(network, np_random=self.np_random)

        def place(kind, lane, at_m, speed):
            vehicle = kind(
                self.road, network.get_lane(("a", "b", lane)).position(at_m, 0), speed=speed
            )
            self.road.vehicles.append(vehicle)
            return vehicle

        self.vehicle = place(self.action_type.vehicle_class, 1, 20, 14)
        place(Truck, 1, 45 + self.np_random.uniform(0, 5), 13)
        place(Vehicle, 1, self.config["stands_m"], 0)
        place(IDMVehicle, 0, self.np_random.uniform(0, 15), 14)
        place(IDMVehicle, 0, 60, 12)

    def _reward(self, action):
        return self.vehicle.speed / 14

    def _is_terminated(self):
        return self.vehicle.crashed

    def _is_truncated(self):
        return self.time >= 20


gymnasium.register("breakdown-v0", entry_point="my_roads:Breakdown")
