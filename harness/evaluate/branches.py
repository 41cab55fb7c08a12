"""Share one world among the closed-loop episodes that have acted alike so far,
and branch it when they part.

Episodes of one layout differ only in condition and seed. They are in one world, which is simulated
and observed once, until one of them takes another action than the rest, or takes it in another
frame. Then the world branches. A branch continues exactly as the undivided world would, to the last
bit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import itemgetter

from harness.coordination.operating_point import OperatingPoint
from harness.dataset.load import Scene
from harness.world import lockstep
from harness.world.world import Target, World


@dataclass
class Decision:
    """Hold one agent's chosen action and the simulation frame in which it takes effect.

    An agent is a vehicle that decides for itself. `acted` says whether it has taken effect, and
    `ttc_s` and `pet_s` how near others came in time, s, until the agent's next decision: least time
    to collision and least post-encroachment time, inf if nothing is near.
    """

    action: str  # name of the meta-action
    frame: int  # number of the simulation frame in which it takes effect
    acted: bool = False  # whether it has taken effect
    # least time to collision, s, until the agent's next decision begins; inf if nothing is near
    ttc_s: float = math.inf
    # least post-encroachment time, s, until then: from when one vehicle leaves a place to when
    # another arrives; inf if nothing is near
    pet_s: float = math.inf


@dataclass
class Course:
    """Hold one episode under one condition and channel seed, while it is driven.

    `point` is the condition: its settings of the radio, of asking helpers and of fusing their
    messages. Agents, vehicles that decide for themselves, are numbered by their index among the
    vehicles of the world; 0 is the ego. `open` has by agent the decision that has not taken effect
    yet, `last` the latest one, and `skipped` counts those that did not begin, since one was still
    open.
    """

    # the condition: its settings of the radio, of asking helpers and of fusing their messages
    point: OperatingPoint
    seed: int  # seed of the channel's draws
    # by agent its decision that has not taken effect yet; until then the agent keeps to its last
    # action
    open: dict[int, Decision] = field(default_factory=dict)
    last: dict[int, Decision] = field(default_factory=dict)  # by agent its latest decision
    # number of decisions that did not begin, since one was still open when they were due
    skipped: int = 0


@dataclass
class Trajectory:
    """Hold a simulated world and the episodes that still share it, having acted alike so far.

    `number` is that of the layout's episode in the run, and `courses` are the episode under each
    condition and channel seed that shares the world. A condition is a named set of settings of the
    radio, of asking helpers and of fusing their messages. A layout is one start situation of a
    scenario.
    """

    number: int  # number of the layout's episode in the run
    world: World  # the simulated world
    courses: list[Course]  # the episode under each condition and seed that shares the world
    # by agent its latest decision point; an agent is a vehicle that decides for itself
    scenes: dict[int, Scene] = field(default_factory=dict)

    @property
    def under_way(self) -> list[int]:
        """Return the numbers of the agents whose episode has not ended.

        An agent is a vehicle that decides for itself; its number is the index of the vehicle in the
        world, 0 the ego.
        """
        return [
            agent for agent, journey in self.world.journeys.items() if not journey.outcome.ended
        ]

    def measure(self) -> None:
        """Add how near others came to each agent to its latest decision, and count anew.

        That is the least time to collision and the least post-encroachment time, in s, since the
        last call. An agent is a vehicle that decides for itself.
        """
        for agent, journey in self.world.journeys.items():
            for decision in (course.last[agent] for course in self.courses if agent in course.last):
                decision.ttc_s = min(decision.ttc_s, journey.conflicts.ttc_s)
                decision.pet_s = min(decision.pet_s, journey.conflicts.pet_s)
            journey.conflicts = journey.conflicts.anew()

    def act(self) -> list["Trajectory"]:
        """Apply decisions whose frame has come, and return a trajectory for each way to go on.

        A trajectory is a simulated world that several episodes share, since they acted alike. Those
        that now aim at different speeds or lanes part: the world is copied for each.
        """
        world, agents = self.world, tuple(self.world.journeys)
        now = tuple(world.target(agent) for agent in agents)
        courses: dict[tuple[Target, ...], list[Course]] = {now: []}
        # the actions by agent that set the targets
        taken: dict[tuple[Target, ...], dict[int, str]] = {}
        target_after: dict[tuple[int, str], Target] = {}
        for course in self.courses:
            ready = {
                agent: course.open.pop(agent)
                for agent, decision in list(course.open.items())
                if decision.frame <= world.frame
            }
            aims = dict(zip(agents, now, strict=True))
            for agent, decision in ready.items():
                if world.journeys[agent].outcome.ended:
                    continue
                key = agent, decision.action
                if key not in target_after:
                    target_after[key] = world.target_after(decision.action, agent)
                aims[agent], decision.acted = target_after[key], True
            following = tuple(aims.values())
            courses.setdefault(following, []).append(course)
            taken.setdefault(
                following, {agent: decision.action for agent, decision in ready.items()}
            )
        parts = []
        waiting = [targets for targets, of in courses.items() if targets != now and of]
        for n, targets in enumerate(waiting, 1):
            nobody_stays = n == len(waiting) and not courses[now]
            branched = world if nobody_stays else world.branch()
            for agent, before, after in zip(agents, now, targets, strict=True):
                if after != before:
                    branched.take(taken[targets][agent], agent)
            parts.append(self._part(branched, courses[targets]))
        return [self._part(world, courses[now]), *parts] if courses[now] else parts

    def _part(self, world: World, courses: list[Course]) -> "Trajectory":
        return Trajectory(self.number, world, courses, dict(self.scenes))


def advance(trajectories: Sequence[Trajectory], until_frame: int) -> list[Trajectory]:
    """Simulate worlds that episodes share until a frame, and part those that act differently.

    Each of `trajectories` is such a world with its episodes. Decisions are applied in their frames;
    a world in which episodes take different actions is copied for each. `until_frame` is the number
    of the simulation frame, from 0; an ended world stops before. Returns all trajectories that
    there are then, in the order of those given.
    """
    running: list[tuple[tuple[int, ...], Trajectory]] = [
        ((n,), t) for n, t in enumerate(trajectories)
    ]
    arrived = []
    while running:
        frames = [_next_frame(trajectory, until_frame + 1) for _, trajectory in running]
        worlds = [trajectory.world for _, trajectory in running]
        lockstep.advance(worlds, [min(frame, until_frame) for frame in frames])
        branched = []
        for (order, trajectory), frame in zip(running, frames, strict=True):
            if trajectory.world.ended or frame > until_frame:
                arrived.append((order, trajectory))
            else:
                branched += [((*order, -n), part) for n, part in enumerate(trajectory.act())]
        running = branched
    return [trajectory for _, trajectory in sorted(arrived, key=itemgetter(0))]


def _next_frame(trajectory: Trajectory, never: int) -> int:
    """Return the frame at which an open decision acts next; `never` if none is open."""
    frames = [decision.frame for course in trajectory.courses for decision in course.open.values()]
    return min(frames, default=never)
