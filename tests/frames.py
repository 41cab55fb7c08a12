"""Frames as highway-env itself simulates them, with the rules of the harness's vehicles."""

from harness.world.simulator import LAMPS_MPS2


def highway_envs_frame(world):
    """Let highway-env simulate a world's next frame, and judge it."""
    standing = {v.spawn.id for v in world.vehicles if v.crashed}
    world.road.time_s = world.time_s
    world.road.act()
    for v in world.vehicles:
        v.braking = v.action["acceleration"] < -LAMPS_MPS2
    world.road.step(1 / world.scenario.parameters.simulation_hz)
    world.frame += 1
    world.judge(standing)


def poses(world):
    """All of a world's vehicles that the next frame depends on."""
    return [
        (
            *v.position.tolist(), v.heading, v.speed, v.target_speed, v.crashed, v.braking, v.lane_index,
            v.target_lane_index, v.route, v.spawn, None if v.impact is None else v.impact.tolist(),
        )
        for v in world.vehicles
    ]  # fmt: skip
