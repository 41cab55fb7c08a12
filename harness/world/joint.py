"""A planner that sees everything and plans for all agents of a layout together, in least summed time.

Agents keep to their paths, so that they affect each other by where they are, and by the traffic behind them
that brakes. So each agent's sequences of actions (`HORIZON`) are simulated alone, with the other traffic. Two
of them go together if the agents stay `MARGIN_M` apart and touch no traffic as the other one makes it drive.
Branch and bound finds who does what. A plan counts only if the simulator, with everybody in it, ends as it
promises; else the next best is driven.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.world import lockstep
from harness.world.reference import take_turn
from harness.world.scenario import Scenario
from harness.world.seats import agents_of
from harness.world.simulator import populated
from harness.world.state import SIZES_M, separation_m
from harness.world.swarm import on_seat
from harness.world.world import Journey, World

HORIZON = 5  # decisions of an agent that are planned; after them it takes FASTER
MARGIN_M = 0.1  # least gap between two agents of a plan
NEVER_S = 1000.0  # cost of an agent that never arrives: more than all times of a layout
MOST_NODES = 20_000  # of a search; one that needs more ends with the best plan so far, and a bound
MOST_PLANS = 8  # that are driven for a layout until one keeps its promise


@dataclass
class Rehearsal(World):
    """A world of one agent that keeps a record of where everybody was."""

    record: tuple[Floats, ...] = ()  # poses after each frame, (frames, V, 4) each
    taken: tuple[str, ...] = ()  # the agent's actions

    def passed(self, poses: Floats) -> None:
        self.record = (*self.record, poses.copy())


@dataclass(frozen=True, eq=False)
class Options:
    """What an agent can do without touching other traffic, the soonest to arrive first."""

    actions: Sequence[tuple[str, ...]]
    arrives_s: Floats  # when it reaches its goal, (n,); inf for never
    poses: Floats  # x, y and heading after each frame, of it and then of other traffic, (n, F, V, 3)
    sizes_m: Floats  # length and width of these, (V, 2)
    hz: int  # frames a second

    @cached_property
    def cost_s(self) -> Floats:
        return np.where(np.isinf(self.arrives_s), NEVER_S, self.arrives_s)


@dataclass(frozen=True)
class Plan:
    """What all agents of a layout do."""

    actions: Mapping[int, tuple[str, ...]]  # of each agent, by its place
    arrives_s: Mapping[int, float]  # when each reaches its goal; inf for never
    bound_s: float  # no plan has a smaller sum of times, `NEVER_S` for who never arrives
    nodes: int  # how many nodes the search looked at

    @property
    def sum_s(self) -> float:
        return sum(min(time_s, NEVER_S) for time_s in self.arrives_s.values())

    @property
    def exact(self) -> bool:
        """Whether no plan is better."""
        return self.bound_s >= self.sum_s - 1e-9


def options(scenario: Scenario, seed: int) -> dict[int, Options]:
    """Return what each agent of a layout can do, by its place."""
    layout, agents = agents_of(scenario, scenario.layout(seed, scenario.parameters), seed)
    traffic = [n for n, spawn in enumerate(layout.spawns) if spawn.part == "other"]
    hz, ended = scenario.parameters.simulation_hz, dict[int, list[Rehearsal]]()
    for agent in agents:
        its, start = on_seat(scenario, layout, agent, traffic)
        worlds = _courses(Rehearsal(its, seed, start, populated(its, start)))
        ended[agent] = [w for w in worlds if w.outcome.result in ("cleared", "time_out")]
    frames = max((w.frame for worlds in ended.values() for w in worlds), default=0)
    able = {}
    for agent, worlds in ended.items():
        arrives_s = np.array([w.outcome.time_s if w.outcome.success else np.inf for w in worlds], dtype=float)
        _drive_on([w for w in worlds if w.outcome.success], frames)
        poses = np.empty((len(worlds), frames, 1 + len(traffic), 3))
        for n, k in enumerate(order := np.argsort(arrives_s, kind="stable")):
            known = np.concatenate(worlds[k].record)[:frames, :, :3]
            poses[n, : len(known)], poses[n, len(known) :] = known, known[-1:]
        sizes_m = np.array([SIZES_M[layout.spawns[n].kind] for n in (agent, *traffic)])
        able[agent] = Options([worlds[k].taken for k in order], arrives_s[order], poses, sizes_m, hz)
    return able


def _courses(world: Rehearsal) -> list[Rehearsal]:
    """Return a world for each course that the actions of its agent can lead to, until each is decided."""
    p, going, ended = world.scenario.parameters, [world], list[Rehearsal]()
    calm_last = sorted(world.actions, key=lambda action: action == "IDLE")
    for step in range(p.decisions):
        lockstep.advance(going, [p.due_frame(step) + p.lag_frames] * len(going))
        ended += [each for each in going if each.ended]
        parts = []
        for each in (each for each in going if not each.ended):
            free = calm_last if step < HORIZON else ("FASTER",)
            for action in {each.target_after(action): action for action in free}.values():
                branch = cast(Rehearsal, each.branch())
                branch.taken = (*each.taken, action)
                branch.take(action)
                parts.append(branch)
        lockstep.advance(parts, [p.due_frame(step + 1)] * len(parts))
        ended += [each for each in parts if each.ended]
        going = [each for each in parts if not each.ended]
    return ended + going


def _drive_on(worlds: Sequence[Rehearsal], until_frame: int) -> None:
    """Let agents that have reached their goals drive on."""
    for world in worlds:
        world.scenario = replace(world.scenario, cleared=_never)
        world.journeys = {0: Journey()}
    lockstep.advance(worlds, [until_frame] * len(worlds))


def _never(xy_m: Floats, approaches: object, parameters: object) -> Bools:
    return np.zeros(np.shape(xy_m)[:-2], dtype=bool)


@dataclass
class Search:
    """A search for the options of all agents that go together and have the least cost."""

    able: Sequence[Options]  # of each agent
    unfit: set[tuple[int, ...]] = field(default_factory=set)  # choices that do not keep their promise
    rows: dict[tuple[int, int, int], Bools] = field(default_factory=dict)
    nodes: int = 0
    best: tuple[int, ...] | None = None
    cost_s: float = np.inf
    open_s: float = np.inf  # the least cost that a part which was not searched may have

    def run(self) -> None:
        """Find the best choice; `bound_s` says how good any may be."""
        self.nodes, self.best, self.cost_s, self.open_s = 0, None, np.inf, np.inf
        if all(len(each.actions) for each in self.able):
            self._choose((), 0.0, [np.ones(len(each.actions), dtype=bool) for each in self.able])

    @property
    def bound_s(self) -> float:
        return min(self.cost_s, self.open_s)

    def _choose(self, chosen: tuple[int, ...], cost_s: float, left: Sequence[Bools]) -> None:
        """Choose for the next agent; `left` are the options of those that follow."""
        agent = len(chosen)
        if not left:
            if cost_s < self.cost_s and chosen not in self.unfit:
                self.best, self.cost_s = chosen, cost_s
            return
        least_s = [self._least_s(agent + n, mask) for n, mask in enumerate(left)]
        for n in np.flatnonzero(left[0]).tolist():
            its_s = cost_s + float(self.able[agent].cost_s[n])
            if its_s + sum(least_s[1:]) >= self.cost_s:
                return
            if self.nodes >= MOST_NODES:
                self.open_s = min(self.open_s, its_s + sum(least_s[1:]))
                return
            self.nodes += 1
            after = [mask & self._row(agent, n, agent + 1 + k) for k, mask in enumerate(left[1:])]
            if all(mask.any() for mask in after):
                bound_s = its_s + sum(self._least_s(agent + 1 + k, mask) for k, mask in enumerate(after))
                if bound_s < self.cost_s:
                    self._choose((*chosen, n), its_s, after)

    def _least_s(self, agent: int, mask: Bools) -> float:
        return float(self.able[agent].cost_s[mask.argmax()])  # the first is the soonest

    def _row(self, agent: int, n: int, other: int) -> Bools:
        """Return which options of another agent go together with an agent's option."""
        key = agent, n, other
        if key not in self.rows:
            self.rows[key] = together(self.able[agent], n, self.able[other])
        return self.rows[key]


def together(own: Options, n: int, other: Options) -> Bools:
    """Return which options of another agent go together with the nth of an agent, (n,).

    What happens when both have arrived does not count.
    """
    mine, its, frames = own.poses[n : n + 1], other.poses, own.poses.shape[1]
    ends = np.minimum(np.maximum(own.arrives_s[n], other.arrives_s) * own.hz, frames)
    under_way = np.arange(1, frames + 1) <= ends[:, None] + 0.5
    own_m, other_m = own.sizes_m, other.sizes_m
    near = _near(mine[:, :, :1], own_m[:1], its[:, :, :1], other_m[:1], MARGIN_M, under_way)
    near |= _near(mine[:, :, :1], own_m[:1], its[:, :, 1:], other_m[1:], 0.0, under_way)
    near |= _near(mine[:, :, 1:], own_m[1:], its[:, :, :1], other_m[:1], 0.0, under_way)
    return ~near


def _near(
    some: Floats, sizes_m: Floats, others: Floats, their_sizes_m: Floats, margin_m: float, counts: Bools
) -> Bools:
    """Return whether any of some vehicles (1, F, A, 3) comes as near to any of the others (n, F, B, 3), (n,).

    Only frames that count, (n, F), do.
    """
    reach_m = (np.hypot(*sizes_m.T)[:, None] + np.hypot(*their_sizes_m.T)) / 2 + margin_m
    dx, dy = np.moveaxis(some[:, :, :, None, :2] - others[:, :, None, :, :2], -1, 0)
    close = (dx * dx + dy * dy <= reach_m * reach_m) & counts[:, :, None, None]
    n, frame, a, b = np.nonzero(close)
    gap_m = separation_m(some[0, frame, a], sizes_m[a], others[n, frame, b], their_sizes_m[b])
    near = np.zeros(len(others), dtype=bool)
    near[n[gap_m <= margin_m]] = True
    return near


def plan(scenario: Scenario, seed: int) -> Plan | None:
    """Return the best plan for all agents of a layout that keeps its promise; None if there is none."""
    able = options(scenario, seed)
    search = Search(list(able.values()))
    for _ in range(MOST_PLANS):
        search.run()
        if search.best is None:
            return None
        chosen = dict(zip(able, search.best, strict=True))
        best = Plan(
            {agent: able[agent].actions[n] for agent, n in chosen.items()},
            {agent: float(able[agent].arrives_s[n]) for agent, n in chosen.items()},
            search.bound_s,
            search.nodes,
        )
        if kept(best, played(scenario, seed, best)):
            return best
        search.unfit.add(search.best)
    return None


def played(scenario: Scenario, seed: int, it: Plan) -> World:
    """Return the world of a layout after all agents have acted as planned."""
    world = World.start(scenario, seed)
    while not world.ended:
        step = world.step
        taken = {agent: actions[step] for agent, actions in it.actions.items() if step < len(actions)}
        take_turn([world], [taken])
    return world


def kept(it: Plan, world: World) -> bool:
    """Return whether all agents of a world have arrived when the plan says, and no others."""
    return all(
        journey.outcome.time_s == it.arrives_s[agent] if journey.outcome.success
        else journey.outcome.result == "time_out" and np.isinf(it.arrives_s[agent])
        for agent, journey in world.journeys.items()
    )  # fmt: skip
