"""A planner that sees everything and plans for all agents of a layout together,
in least summed time.

Agents keep to their paths, so that they affect each other by where they are, and by the traffic
behind them that brakes. So each agent's sequences of actions (`HORIZON`) are simulated alone, with
the other traffic. Two of them go together if the agents stay `MARGIN_M` apart and touch no traffic
as the other one makes it drive. Branch and bound finds who does what. A plan counts only if the
simulator, with everybody in it, ends as it promises; else the next best is driven.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.world import lockstep
from harness.world.reference import take_turn
from harness.world.scenario import Layout, Scenario
from harness.world.seats import agents_of
from harness.world.simulator import populated
from harness.world.state import SIZES_M, separation_m
from harness.world.swarm import by_scenario, on_seat
from harness.world.world import Journey, World

Scripts = Mapping[int, Sequence[str]]  # actions of each agent, by its index among vehicles

HORIZON = 5  # decisions of an agent that are planned; after them it takes FASTER
MARGIN_M = 0.1  # least gap between two agents of a plan
NEVER_S = 1000.0  # cost of an agent that never arrives: more than all times of a layout
MOST_NODES = 20_000  # of a search; one that needs more ends with the best plan so far, and a bound
MOST_PLANS = 8  # that are driven for a layout until one keeps its promise


@dataclass
class Rehearsal(World):
    """Simulate one agent of a layout with the traffic, without other agents, and record them.

    An agent is a vehicle that decides for itself, and `agent` its index among the layout's
    vehicles, 0 the ego. `script` has the meta-actions that it is to take, None for all possible
    ones in copies, and `taken` those that it took. `record` has arrays of x, y (m), heading (rad)
    and speed (m/s) of V vehicles after each frame, (frames, V, 4). `arrives_s` is when it reached
    its goal; inf before.
    """

    agent: int = 0  # the agent's index among the vehicles of the layout (start situation)
    # the meta-actions that it is to take; None for all that are possible
    script: Sequence[str] | None = None
    # x, y (m), heading (rad) and speed (m/s) of V vehicles after each frame, (frames, V, 4) each
    record: tuple[Floats, ...] = ()
    taken: tuple[str, ...] = ()  # the meta-actions that the agent took
    # when the agent reached its goal, after which it drove on; inf before
    arrives_s: float = np.inf

    def passed(self, poses: Floats) -> None:
        self.record = (*self.record, poses.copy())

    def decide(self, action: str) -> None:
        super().decide(action)
        self.taken = (*self.taken, action)

    def parts(self, step: int) -> list["Rehearsal"]:
        """Return copies of this world, each with one of the actions that the agent can take now.

        An agent is a vehicle that decides for itself. `step` is the number of its decision, from 0;
        after `HORIZON` of them it takes FASTER. Of actions that set the same target speed and route
        only one is tried. This world is the first of the copies.
        """
        calm_last = sorted(self.actions, key=lambda action: action == "IDLE")
        action_to = {self.target_after(action): action for action in calm_last}
        if self.script is not None:
            scripted = self.script[step : step + 1]
            actions = [action_to[self.target_after(action)] for action in scripted]
        elif step < HORIZON:
            actions = list(action_to.values())
        else:
            actions = ["FASTER"]
        parts = [self]
        for _ in actions[1:]:
            parts.append(cast(Rehearsal, self.branch()))
        for part, action in zip(parts, actions, strict=False):
            part.decide(action)
        return parts


@dataclass(frozen=True, eq=False)
class Options:
    """Hold n sequences of actions by which an agent touches no other traffic, the soonest first.

    An agent is a vehicle that decides for itself. `arrives_s`, (n,), is when the agent reaches its
    goal by each, inf for never. Each was simulated for F frames, `hz` a second, with V vehicles,
    the agent and then the other traffic: `poses`, (n, F, V, 3), has their x (m), y (m) and heading
    (rad), and `sizes_m`, (V, 2), their lengths and widths.
    """

    actions: Sequence[tuple[str, ...]]  # the meta-actions of each of the n sequences
    arrives_s: Floats  # when the agent reaches its goal by each, (n,); inf for never
    # x (m), y (m) and heading (rad) of each vehicle after each frame, (n, F, V, 3)
    poses: Floats
    sizes_m: Floats  # length and width of each vehicle, (V, 2)
    hz: int  # frames a second

    @cached_property
    def cost_s(self) -> Floats:
        return np.where(np.isinf(self.arrives_s), NEVER_S, self.arrives_s)


@dataclass(frozen=True)
class Plan:
    """Hold a sequence of actions for every agent of a layout, a drawn start situation.

    An agent is a vehicle that decides for itself, known by its index among the layout's vehicles, 0
    the ego. The plan is meant to have the least sum of arrival times.
    """

    actions: Mapping[int, tuple[str, ...]]  # each agent's meta-actions, by its index
    arrives_s: Mapping[int, float]  # when each reaches its goal, by its index; inf for never
    bound_s: float  # no plan has a smaller sum of times, `NEVER_S` for who never arrives
    nodes: int  # number of partial choices of sequences that the search looked at

    @property
    def sum_s(self) -> float:
        return sum(min(time_s, NEVER_S) for time_s in self.arrives_s.values())

    def turn(self, step: int) -> dict[int, str]:
        """Return each agent's action at a step, the number of a decision from 0, by agent index.

        An agent is a vehicle that decides for itself; those that decide no more are left out.
        """
        return {agent: taken[step] for agent, taken in self.actions.items() if step < len(taken)}

    @property
    def exact(self) -> bool:
        """Return whether it is proven that no plan has a smaller sum of arrival times.

        An agent, a vehicle that decides for itself, that never arrives counts as `NEVER_S`.
        """
        return self.bound_s >= self.sum_s - 1e-9


def options(scenario: Scenario, seeds: Sequence[int]) -> dict[int, dict[int, Options]]:
    """Return what each agent can do without touching traffic, by layout seed, then agent index.

    A layout seed draws a start situation of `scenario`. An agent is a vehicle that decides for
    itself, and its index is that among the layout's vehicles, 0 the ego. It is simulated with the
    traffic, without other agents, through all sequences of `HORIZON` actions.
    """
    starts = [world for seed in seeds for world in rehearsals(scenario, seed)]
    unharmed: list[Rehearsal] = []
    for group in by_scenario(starts):
        ended = _courses(group)
        unharmed += [world for world in ended if world.outcome.result in ("cleared", "time_out")]
    frames = dict.fromkeys(seeds, 0)
    for world in unharmed:
        frames[world.seed] = max(frames[world.seed], world.frame)
    for group in by_scenario([world for world in unharmed if world.outcome.success]):
        _drive_on(group, [frames[world.seed] for world in group])
    worlds_of = dict[tuple[int, int], list[Rehearsal]]()
    for world in starts:
        worlds_of[world.seed, world.agent] = []
    for world in unharmed:
        worlds_of[world.seed, world.agent].append(world)
    able: dict[int, dict[int, Options]] = {seed: {} for seed in seeds}
    for world in starts:
        worlds = worlds_of[world.seed, world.agent]
        able[world.seed][world.agent] = _options(world.layout, worlds, frames[world.seed])
    return able


def courses(
    scenario: Scenario,
    able: Mapping[int, Mapping[int, Options]],
    taken: Sequence[tuple[int, Scripts]],
) -> list[dict[int, Options]]:
    """Return where agents were under given actions, one dict per item of `taken`, by agent index.

    An agent is a vehicle that decides for itself, and its index that among a layout's vehicles, 0
    the ego. An item of `taken` is a layout seed, which draws a start situation, and the actions of
    each agent by its index. A value is an `Options` that holds this one sequence of actions,
    simulated with the traffic, without other agents, even if it touches traffic. `able` has all
    sequences that agents can take, by seed and agent index; frames are as many as there.
    """
    layouts: list[list[Rehearsal]] = []
    for seed, scripts in taken:
        worlds = rehearsals(scenario, seed)
        for world in worlds:
            world.script = scripts.get(world.agent, ())
        layouts.append(worlds)
    every = [world for worlds in layouts for world in worlds]
    for group in by_scenario(every):
        _courses(group)
    frames: dict[int, int] = {}
    for seed, by_agent in able.items():
        frames[seed] = max(options.poses.shape[1] for options in by_agent.values())
    for group in by_scenario([world for world in every if world.outcome.success]):
        _drive_on(group, [frames[world.seed] for world in group])
    driven: list[dict[int, Options]] = []
    for worlds in layouts:
        course = {}
        for world in worlds:
            course[world.agent] = _options(world.layout, [world], frames[world.seed])
        driven.append(course)
    return driven


def rehearsals(scenario: Scenario, seed: int) -> list[Rehearsal]:
    """Return a world at its start for each agent of a layout, with only that agent and the traffic.

    An agent is a vehicle that decides for itself. `seed` draws the layout, a start situation of
    `scenario`.
    """
    layout, agents = agents_of(scenario, scenario.layout(seed, scenario.parameters), seed)
    traffic = [n for n, spawn in enumerate(layout.spawns) if spawn.part == "other"]
    worlds = []
    for agent in agents:
        own_scenario, start = on_seat(scenario, layout, agent, traffic)
        road = populated(own_scenario, start)
        worlds.append(Rehearsal(own_scenario, seed, start, road, agent=agent))
    return worlds


def _options(layout: Layout, worlds: Sequence[Rehearsal], frames: int) -> Options:
    """Return the courses that an agent took in some worlds;
    after the last frame of a world, everybody stays where it is.
    """
    arrives_s = np.array([world.arrives_s for world in worlds], dtype=float)
    order = np.argsort(arrives_s, kind="stable")
    poses = np.empty((len(worlds), frames, len(layout.spawns), 3))
    for n, k in enumerate(order):
        record = np.concatenate(worlds[k].record)[:frames, :, :3]
        poses[n, : len(record)] = record
        poses[n, len(record) :] = record[-1:]
    sizes_m = np.array([SIZES_M[spawn.kind] for spawn in layout.spawns])
    hz = worlds[0].scenario.parameters.simulation_hz if worlds else 1
    return Options([worlds[k].taken for k in order], arrives_s[order], poses, sizes_m, hz)


def _courses(rehearsals: list[Rehearsal]) -> list[Rehearsal]:
    """Return a world for each course that the actions of agents can lead to,
    until each is decided.
    """
    p, ended = rehearsals[0].scenario.parameters, list[Rehearsal]()
    for step in range(p.decisions):
        lockstep.advance(rehearsals, [p.due_frame(step) + p.lag_frames] * len(rehearsals))
        ended += [each for each in rehearsals if each.ended]
        rehearsals = [part for each in rehearsals if not each.ended for part in each.parts(step)]
        lockstep.advance(rehearsals, [p.due_frame(step + 1)] * len(rehearsals))
        ended += [each for each in rehearsals if each.ended]
        rehearsals = [each for each in rehearsals if not each.ended]
    return ended + rehearsals


def _drive_on(worlds: Sequence[Rehearsal], until_frames: Sequence[int]) -> None:
    """Let agents that have reached their goals drive on."""
    for world in worlds:
        world.arrives_s = cast(float, world.outcome.time_s)
        world.scenario = replace(world.scenario, cleared=_never)
        world.journeys = {0: Journey()}
    lockstep.advance(worlds, until_frames)


def _never(xy_m: Floats, approaches: object, parameters: object) -> Bools:
    return np.zeros(np.shape(xy_m)[:-2], dtype=bool)


@dataclass
class Search:
    """Search, by branch and bound, for compatible options of all agents with the least total cost.

    An agent is a vehicle that decides for itself. An option is a sequence of actions, and its cost,
    s, when the agent arrives by it. Two are compatible if the agents and the traffic do not touch
    (`together`). `able` has each agent's options, and `unfit` choices (an option's index for each
    agent) that are left out. `run` finds `best`, the best choice, of cost `cost_s` (inf for none),
    after `nodes` partial choices; what it did not search may cost `open_s` at least. `rows` keeps
    which options are compatible.
    """

    able: Sequence[Options]  # of each agent: the sequences of actions that it can take
    # choices whose plan did not work in the simulator
    unfit: set[tuple[int, ...]] = field(default_factory=set)
    # by agent, its option and another agent: which options of the other are compatible
    rows: dict[tuple[int, int, int], Bools] = field(default_factory=dict)
    nodes: int = 0  # number of partial choices looked at
    best: tuple[int, ...] | None = None  # one option index per agent; None if there is no choice
    cost_s: float = np.inf  # cost of `best`
    open_s: float = np.inf  # the least cost that a part which was not searched may have

    def run(self) -> None:
        """Find the best choice of a sequence of actions for each agent, into `best`.

        An agent is a vehicle that decides for itself, and the best choice has the least sum of
        arrival times; those in `unfit` are left out. Afterwards `bound_s` is a lower bound, s, of
        the cost of any choice.
        """
        self.nodes, self.best, self.cost_s, self.open_s = 0, None, np.inf, np.inf
        if all(len(each.actions) for each in self.able):
            self._choose((), 0.0, [np.ones(len(each.actions), dtype=bool) for each in self.able])

    @property
    def bound_s(self) -> float:
        return min(self.cost_s, self.open_s)

    @property
    def ended(self) -> bool:
        """Return whether the search was complete, so that `best` is the choice of least cost.

        It is false if the search was cut off while something that it did not look at could cost
        less.
        """
        return self.open_s >= self.cost_s

    def _choose(self, chosen: tuple[int, ...], cost_s: float, left: Sequence[Bools]) -> None:
        """Choose for the next agent; `left` are the options of those that follow."""
        agent = len(chosen)
        if not left:
            if cost_s < self.cost_s and chosen not in self.unfit:
                self.best, self.cost_s = chosen, cost_s
            return
        others = left[1:]
        others_s = sum(self._least_s(agent + 1 + k, mask) for k, mask in enumerate(others))
        for n in np.flatnonzero(left[0]).tolist():
            so_far_s = cost_s + float(self.able[agent].cost_s[n])
            if so_far_s + others_s >= self.cost_s:
                return
            if self.nodes >= MOST_NODES:
                self.open_s = min(self.open_s, so_far_s + others_s)
                return
            self.nodes += 1
            after = [mask & self._row(agent, n, agent + 1 + k) for k, mask in enumerate(others)]
            if all(mask.any() for mask in after):
                after_s = sum(self._least_s(agent + 1 + k, mask) for k, mask in enumerate(after))
                if so_far_s + after_s < self.cost_s:
                    self._choose((*chosen, n), so_far_s, after)

    def _least_s(self, agent: int, mask: Bools) -> float:
        return float(self.able[agent].cost_s[mask.argmax()])  # the first is the soonest

    def _row(self, agent: int, n: int, other: int) -> Bools:
        """Return which options of another agent go together with an agent's option."""
        key = agent, n, other
        if key not in self.rows:
            self.rows[key] = together(self.able[agent], n, self.able[other])
        return self.rows[key]


def together(options: Options, n: int, other: Options) -> Bools:
    """Return which of another agent's n options are compatible with one of an agent's, (n,).

    An agent is a vehicle that decides for itself. `options` has the agent's sequences of actions,
    of which `n` is the index of one, and `other` the other agent's. They are compatible if neither
    agent touches the other or traffic, in the frames before both have arrived.
    """
    poses, other_poses, frames = options.poses[n : n + 1], other.poses, options.poses.shape[1]
    ends = np.minimum(np.maximum(options.arrives_s[n], other.arrives_s) * options.hz, frames)
    under_way = np.arange(1, frames + 1) <= ends[:, None] + 0.5
    own_m, other_m = options.sizes_m, other.sizes_m
    meet = near(poses[:, :, :1], own_m[:1], other_poses[:, :, :1], other_m[:1], MARGIN_M, under_way)
    meet |= near(poses[:, :, :1], own_m[:1], other_poses[:, :, 1:], other_m[1:], 0.0, under_way)
    meet |= near(poses[:, :, 1:], own_m[1:], other_poses[:, :, :1], other_m[:1], 0.0, under_way)
    return ~meet


def near(
    some: Floats,
    sizes_m: Floats,
    others: Floats,
    their_sizes_m: Floats,
    margin_m: float,
    counts: Bools,
) -> Bools:
    """Return in which of n cases any of A vehicles comes near any of B others, (n,).

    Near means within `margin_m` metres. `some`, (1, F, A, 3), the same in all cases, and `others`,
    (n, F, B, 3), are x (m), y (m) and heading (rad) in F frames; `sizes_m`, (A, 2), and
    `their_sizes_m`, (B, 2), are lengths and widths. Only frames where `counts`, (n, F), is true are
    compared.
    """
    reach_m = (np.hypot(*sizes_m.T)[:, None] + np.hypot(*their_sizes_m.T)) / 2 + margin_m
    dx, dy = np.moveaxis(some[:, :, :, None, :2] - others[:, :, None, :, :2], -1, 0)
    close = (dx * dx + dy * dy <= reach_m * reach_m) & counts[:, :, None, None]
    n, frame, a, b = np.nonzero(close)
    gap_m = separation_m(some[0, frame, a], sizes_m[a], others[n, frame, b], their_sizes_m[b])
    meet = np.zeros(len(others), dtype=bool)
    meet[n[gap_m <= margin_m]] = True
    return meet


def plans(
    scenario: Scenario, able: Mapping[int, Mapping[int, Options]]
) -> tuple[dict[int, tuple[Plan, World]], set[int]]:
    """Return, by layout seed, the best plan that works in the simulator, and the world it ended in.

    A layout seed draws a start situation, and an agent is a vehicle that decides for itself. `able`
    has each agent's possible sequences of actions, by layout seed and agent index. A plan, one
    sequence for each agent, works if, with all together, each arrives when it would alone with the
    traffic. Seeds without such a plan are left out. Returned second are the seeds whose search was
    cut off, so that a plan may exist.
    """
    solved, unended = dict[int, tuple[Plan, World]](), set[int]()
    searches = {seed: Search(list(by_agent.values())) for seed, by_agent in able.items()}
    for _ in range(MOST_PLANS):
        best: dict[int, Plan] = {}
        for seed, search in searches.items():
            plan = _best(search, able[seed])
            if plan:
                best[seed] = plan
            elif not search.ended:
                unended.add(seed)
        worlds = played(scenario, best)
        for seed, plan in best.items():
            if kept(plan, worlds[seed]):
                solved[seed] = plan, worlds[seed]
        searches = {seed: searches[seed] for seed in best if seed not in solved}
    return solved, unended | searches.keys()


def _best(search: Search, able: Mapping[int, Options]) -> Plan | None:
    """Return the best plan that was not returned before."""
    search.run()
    if search.best is None:
        return None
    search.unfit.add(search.best)
    actions, arrives_s = {}, {}
    for agent, n in zip(able, search.best, strict=True):
        actions[agent] = able[agent].actions[n]
        arrives_s[agent] = float(able[agent].arrives_s[n])
    return Plan(actions, arrives_s, search.bound_s, search.nodes)


def played(scenario: Scenario, plans_by_seed: Mapping[int, Plan]) -> dict[int, World]:
    """Return each layout's finished world, by seed, after all agents took their planned actions.

    A layout is a start situation of `scenario`, and agents are vehicles that decide for themselves.
    `plans_by_seed` has the plan of each layout: a sequence of actions for every agent.
    """
    worlds = {seed: World.start(scenario, seed) for seed in plans_by_seed}
    while live_worlds := [world for world in worlds.values() if not world.ended]:
        turns = [plans_by_seed[world.seed].turn(world.step) for world in live_worlds]
        take_turn(live_worlds, turns)
    return worlds


def kept(plan: Plan, world: World) -> bool:
    """Return whether all agents of a finished world arrived exactly when the plan says.

    `plan` has a sequence of actions for every agent (a vehicle that decides for itself), and
    `world` is the simulation in which they took them. One that never arrives by the plan must have
    run out of time, unharmed.
    """
    for agent, journey in world.journeys.items():
        outcome, arrives_s = journey.outcome, plan.arrives_s[agent]
        as_planned = (
            outcome.time_s == arrives_s
            if outcome.success
            else outcome.result == "time_out" and np.isinf(arrives_s)
        )
        if not as_planned:
            return False
    return True
