"""What tests of several agents share."""

from collections.abc import Sequence
from dataclasses import replace

from harness.world.perception.graph import scene_graphs
from harness.world.scenario import Scenario
from harness.world.world import World


def driven(scenario: Scenario, seed: int, plans: Sequence[Sequence[str]]) -> list[str]:
    """Return how an episode ends for each agent, if each takes the actions of its plan."""
    p = replace(scenario.parameters, agent_share=1.0)  # type: ignore[call-arg]
    world = World.start(replace(scenario, parameters=p), seed)
    for actions in zip(*plans, strict=True):
        world.advance(p.due_frame(world.step) + p.lag_frames)
        for (agent, journey), action in zip(world.journeys.items(), actions, strict=True):
            if not journey.outcome.ended:
                world.take(action, agent)
        world.step += 1
        world.advance(p.due_frame(world.step))
    return [journey.outcome.result for journey in world.journeys.values()]


def who_list_the_danger(world: World) -> set[str]:
    """Return the approaches of the agents whose scene graphs list the danger."""
    state = world.state()
    viewers = [v for v in state.vehicles if v.part != "other"]
    graphs = scene_graphs(world.scenario, [(state, v.id) for v in viewers])
    return {
        v.approach for v, g in zip(viewers, graphs, strict=True) if world.layout.danger_id in g.seen
    }
