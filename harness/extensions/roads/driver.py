"""The recorded driver as a reference: what follows the recording best from where the ego is."""

import numpy as np

from harness.extensions.roads.family import recording_of
from harness.extensions.roads.traffic import Setting, nth, setting
from harness.world.planner import LOOK_AHEAD_S, STEP_S, levels, travelled_m
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

NAME = "recorded"
CALM = ("IDLE", "SLOWER", "FASTER")  # the first of equally good ones is taken
LANES = {"left": "LANE_LEFT", "right": "LANE_RIGHT"}
LEAST_OFFSET_M = 1.0  # a recorded driver who is nearer to the middle of the lane stays in it
LOOK_PERIODS = 2  # periods ahead in which places are compared


def action(scenario: Scenario, graph: SceneGraph) -> str:
    """Return the action that brings the ego nearest to where its recorded driver is later.

    `scenario` is that of a layout, and `graph` the ego's scene graph.
    """
    return follow(scenario, graph, setting_of(scenario))


def follow(scenario: Scenario, graph: SceneGraph, recorded: Setting) -> str:
    """Return the action that brings the ego nearest to where the track of its place is later.

    `scenario` is that of a layout, `graph` the ego's scene graph, and `recorded` has the track. It
    changes to the lane in which the track is one period later; else that counts which is nearest in
    two periods, if the target speed is kept, and at the last decision whether the goal is reached.
    It does not look at others.
    """
    p, road = scenario.parameters, scenario.road()
    route = graph.ego.route or road.ego[1]
    way, now_s = (road.ego[0], route), graph.step * p.decision_period_s
    at_m = road.zone_arc_m - graph.ego.zone_m

    soon = recorded.pose(now_s + p.decision_period_s)[:2] - road.origin_m
    beside = {
        side: road.paths[key].project(*soon.tolist())[1]
        for side, key in road.beside(way, at_m).items()
    }
    side = min(beside, key=lambda each: beside[each])
    if side in LANES and LANES[side] in scenario.actions and beside["own"] > LEAST_OFFSET_M:
        return LANES[side]

    later = recorded.pose(now_s + LOOK_PERIODS * p.decision_period_s)[:2] - road.origin_m
    wanted_m = road.paths[way].project(*later.tolist())[0] - at_m
    moves = levels([(name,) for name in CALM])
    speed, target = np.array([graph.ego.speed_mps]), np.array([graph.ego.target_speed_mps])
    travelled = travelled_m(moves, speed, target, 1, p)[0]
    off_m = np.abs(travelled[:, _steps(LOOK_PERIODS * p.decision_period_s)] - wanted_m)
    if graph.step == p.decisions - 1 and road.goal_m:  # it goes on so until the end
        left_s = p.time_limit_s - now_s - p.decision_lag_s
        arrives = travelled[:, _steps(left_s)] > road.goal_m(p) - at_m
        off_m = np.where(arrives | ~arrives.any(), off_m, np.inf)
    return CALM[int(off_m.argmin())]


def _steps(time_s: float) -> int:
    """Return the planner's step that ends at a time, as far as it looks."""
    return min(round(time_s / STEP_S), round(LOOK_AHEAD_S / STEP_S)) - 1


def setting_of(scenario: Scenario) -> Setting:
    """Return what there is at the moment of a layout's scenario."""
    recording, seed, p = recording_of(scenario.name), scenario.layout_seed, scenario.parameters
    assert seed is not None
    return setting(recording, nth(recording, seed), p.simulation_hz, p.time_limit_s)
