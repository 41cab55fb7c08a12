"""Simulate an episode of an environment of highway-env, frame by frame;
make a scenario of an environment.

`env.step` simulates a whole decision period and hides the frame in which something happened. So the
frames are simulated here, as `env._simulate` does, and at the end of each period `env.step` is
called without simulating frames: whatever an environment adds to it (new traffic, rewards, endings)
happens as usual.
"""

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import Any, cast, get_args

import numpy as np

from harness.core.errors import UserError
from harness.extensions.environments import environment
from harness.extensions.environments.environment import (
    Constants,
    config,
    guarded,
    hittable,
    label,
    lane_of,
    meta_actions,
    numbered,
    reset,
)
from harness.extensions.environments.goal import OWN
from harness.extensions.environments.place import (
    Parameters,
    Place,
    RoadOf,
    first_target_mps,
    start,
    usual,
)
from harness.extensions.environments.window import is_within, quicken
from harness.world import beacons, scenarios
from harness.world.conflict_measures import observe
from harness.world.gaps import least_gaps_m
from harness.world.own_world import OwnWorld
from harness.world.parameters import DIALS
from harness.world.road import PathKey
from harness.world.scenario import Layout, Scenario, Spawn
from harness.world.simulator import DECIMALS, LAMPS_MPS2
from harness.world.state import BROAD, SIZES_M, ActionsTaken, Building, Kind, Part
from harness.world.world import Target

MOST_BUILDINGS, MOST_VEHICLES = 9, 99  # limits of the ids in a record


@dataclass
class EnvironmentWorld(OwnWorld):
    """Simulate one episode in an environment of highway-env (`env`), frame by frame.

    `here` is the `Place` where it happens, and `constants` highway-env's, as this environment wants
    them. `everybody` has highway-env's vehicles that can be hit, the ego first, of which `born`
    have entered so far. `action` was taken last; `taken` has each action with the number of its
    frame, counted from the episode's start. `failed` says whether the environment has ended the
    episode without success, and `succeeded` whether with it.
    """

    env: Any = None  # highway-env's environment, an `AbstractEnv`
    # highway-env's class constants as this environment wants them
    constants: Constants = field(default_factory=lambda: Constants({}))
    here: Any = None  # what is the same for every seed, a `Place`
    # highway-env's vehicles that can be hit, in the order of their ids, the ego first
    everybody: list[Any] = field(default_factory=list)
    born: int = 0  # number of vehicles that have entered so far
    action: str = "IDLE"  # the action that was taken last
    # the number of the frame in which each action was taken, from the episode's start, and its name
    taken: tuple[tuple[int, str], ...] = ()
    failed: bool = False  # whether the environment has ended the episode without success
    succeeded: bool = False  # whether the environment has ended it with success

    @classmethod
    def begun(cls, scenario: Scenario, seed: int) -> "EnvironmentWorld":
        """Start the episode of a seed, in the environment that `scenario` is made of.

        Raises UserError if its road, the path on which the ego starts, or the goal that it declares
        differs from seed 0's, and the environment does not say so.
        """
        scenario = scenario.at(seed)
        name, env, here = scenario.name, cls.started(scenario, seed), RoadOf.of(scenario).place
        ego, p = env.vehicle, cast("Parameters", scenario.parameters)
        if scenario.layout_seed is None and (part := here.differs(env)):
            raise UserError(
                f"{label(name)}: its {part} is another in seed {seed} than in seed 0; fix it in "
                "its config, or set several_roads = True in its class"
            )
        if here.goal.seconds > p.time_limit_s:
            raise UserError(
                f"{label(name)}: its goal is at {here.goal.seconds:g} s, after the time limit of "
                f"{p.time_limit_s:g} s; set time_limit_s"
            )
        layout = Layout((), _buildings(env, here), None, None)
        world = cls(scenario, seed, layout, env.road, env=env, here=here, constants=Constants.now())
        ego.to_go_m = {
            "speed": p.goal_s * first_target_mps(ego),
            "place": here.goal.metres,
            "stay": here.goal.metres,
        }.get(here.goal.kind, np.inf)
        world._enter(ego, "ego")
        traffic = (v for v in world._solid() if v is not ego)
        nearest = sorted(
            traffic, key=lambda v: (v not in env.controlled_vehicles, _apart_m(v, ego))
        )
        helpers = [v for v in nearest if _kind(v) in BROAD][: p.helpers]
        for v in nearest:
            world._enter(v, "helper" if v in helpers else "other")
        danger, danger_id = world._danger()
        world.layout = replace(layout, danger=danger, danger_id=danger_id)
        poses = beacons.lead_in(p, world._in_road_frame(world._poses()))
        world._drove(poses, 1 - len(poses))
        return world

    def _danger(self) -> tuple[str | None, str | None]:
        """Return the sector and the id of the dangerous vehicle; None where no danger is known."""
        return None, None

    @classmethod
    def environment(cls, name: str, parameters: Parameters | None = None) -> Any:
        """Return a new environment of highway-env by its scenario's name, without a seed.

        A subclass makes those of its own names. `parameters` are the scenario's; None where only
        its road, its goal and its defaults matter.
        """
        return environment.created(name)

    @classmethod
    def started(cls, scenario: Scenario, seed: int) -> Any:
        """Return an environment at the start of the episode of a layout seed."""
        p = cast("Parameters", scenario.parameters)
        env = reset(scenario.name, seed, cls.environment(scenario.name, p))
        if p.window_m:
            quicken(env.road.network)
        return env

    @classmethod
    def examine(cls, scenario: Scenario, seed: int) -> None:
        from harness.extensions.environments.examination import examine

        examine(scenario, seed)

    @classmethod
    def configuration(cls, scenario: Scenario) -> dict[str, Any]:
        """Return the environment's whole configuration, by key, for a dataset's manifest.

        Keys are highway-env's. The scenario's name and the version of the environment's package
        decide what the values are.
        """
        return config(scenario.name)

    @property
    def vehicles(self) -> Sequence[Any]:
        return self.everybody

    @property
    def period(self) -> int:
        """Return the number of simulated frames between two decisions of the environment."""
        p = self.scenario.parameters
        return round(p.decision_period_s * p.simulation_hz)

    def _enter(self, v: Any, part: Part) -> None:
        self.born += 1
        if self.born > MOST_VEHICLES:
            raise UserError(
                f"{label(self.scenario.name)}: more than {MOST_VEHICLES} vehicles; set fewer in "
                "its config"
            )
        v.spawn, v.braking = Spawn(f"v{self.born}", _kind(v), part, "", "", 0.0, 0.0), False
        self._place(v)
        self.everybody.append(v)

    def _place(self, v: Any) -> None:
        """Update a vehicle's path; it stays on its present one if that is possible."""
        road, now = self.here.road, (v.spawn.approach, v.spawn.route)
        keys: list[PathKey] = self.here.routes.keys(lane_of(v), getattr(v, "route", None))
        if v.spawn.part == "ego":
            keys = [key for key in road.ways if key in keys] or [now]
        if now not in keys:
            approach, route = (keys or [road.ego])[0]
            v.spawn = replace(v.spawn, approach=approach, route=route)

    def branch(self) -> "EnvironmentWorld":
        network = self.road.network
        fixed = (self.scenario, self.layout, self.here, self.beacons, self.constants, self.taken)
        shared = (*fixed, network, *network.lanes_list())
        return copy.deepcopy(self, {id(thing): thing for thing in shared})

    def snapshot(self) -> ActionsTaken:
        """Return the actions so far, with their frames; replayed, they give the same world."""
        return ActionsTaken(self.frame, tuple(self.taken))

    def take(self, action: str, agent: int = 0) -> None:
        kind = meta_actions(self.scenario.name, self.env)
        kind.act(kind.actions_indexes[action])
        self.action, self.taken = action, (*self.taken, (self.frame, action))
        self._place(self.everybody[0])

    def target(self, agent: int = 0) -> Target:
        """Return what the ego aims for: its lane and speed as one text, and that speed's index.

        The text has the lane's two nodes, its number from the left and the target speed in m/s; the
        index is that of the speed among those that the ego can choose. `agent` is the number of the
        vehicle that decides: 0, the ego.
        """
        ego = self.everybody[0]
        aim = *lane_of(ego), round(float(ego.target_speed), DECIMALS)
        return " ".join(map(str, aim)), int(ego.speed_index)

    def target_after(self, action: str, agent: int = 0) -> Target:
        ego, kept = self.everybody[0], (self.action, self.taken)
        fields = {
            name: list(value) if isinstance(value, list) else value
            for name, value in vars(ego).items()
        }
        self.take(action)
        target = self.target()
        vars(ego).update(fields)
        self.action, self.taken = kept
        return target

    def advance(self, until_frame: int) -> None:
        with guarded(self.scenario.name, self.env):
            while self.frame < until_frame and not self.outcome.ended:
                self._drive(min(until_frame, (self.frame // self.period + 1) * self.period))
                self._recast()

    def _drive(self, until_frame: int) -> None:
        """Simulate until a frame within this period."""
        frames, speed_mps = [], float(self.vehicles[0].speed)
        while self.frame < until_frame and not self.outcome.ended:
            self._step()
            frames.append(self._poses())
        if frames:
            poses = self._in_road_frame(frames)
            sizes_m = np.array([[(v.LENGTH, v.WIDTH) for v in self.vehicles]])
            before_m = np.array([self.outcome.least_gap_m])
            [gap_m] = least_gaps_m(poses[None], sizes_m, before_m).tolist()
            first = np.array([self.frame + 1 - len(frames)])
            hz = self.scenario.parameters.simulation_hz
            [conflicts] = observe([self.journey.conflicts], poses[None], sizes_m, first, hz)
            self.passed(poses)
            speeds_mps = np.concatenate([[speed_mps], poses[:, 0, 3]])
            self.journey.passed(speeds_mps, gap_m, conflicts, hz)

    def _solid(self) -> list[Any]:
        """Return the vehicles that can be hit, and are within the window.

        One that collides with nothing hides nothing, and helps nobody. The window is looked at when
        periods end, so that it does not matter when else the simulation stops.
        """
        solid = list(filter(hittable, self.road.vehicles))
        if not self.here.window_m:
            return solid
        known_ids = {id(v) for v in self.everybody}
        if self.frame % self.period:
            return [v for v in solid if id(v) in known_ids]
        return [v for v in solid if v is self.env.vehicle or self.here.has(v)]

    def _recast(self) -> None:
        """Remove vehicles that have left, and add new ones.
        Raises UserError if the ego has left.
        """
        solid = self._solid()
        present, places = {id(v) for v in solid}, {id(v): n for n, v in enumerate(self.everybody)}
        if id(self.everybody[0]) not in present:
            raise UserError(
                f"{label(self.scenario.name)}: its ego leaves the road in seed {self.seed}; keep "
                "it in self.road.vehicles, collidable and solid"
            )
        self.everybody = [v for v in self.everybody if id(v) in present]
        known_ids = {id(v) for v in self.everybody}
        for v in self.everybody:
            self._place(v)
        for v in solid:
            if id(v) not in known_ids:
                self._enter(v, "other")
        now = [places.get(id(v), -1) for v in self.everybody]
        if now != list(range(len(places))):
            self.journey.conflicts = self.journey.conflicts.recast(now)

    def _move(self) -> None:
        self.constants.restore()
        env, ego = self.env, self.everybody[0]
        before = ego.position.copy()
        env.road.act()
        for v in self.everybody:
            v.braking = v.action["acceleration"] < -LAMPS_MPS2
        env.road.step(1 / self.scenario.parameters.simulation_hz)
        env.steps += 1
        ego.to_go_m -= float(np.hypot(*(ego.position - before)))
        if (self.frame + 1) % self.period == 0:
            self._end_period()

    def _end_period(self) -> None:
        env, ego = self.env, self.everybody[0]
        env._simulate = lambda action=None: None  # the frames have been simulated already
        if not _reads_observations(env):

            def nothing() -> None:
                del env.observation_type.observe  # only `step` itself goes without

            env.observation_type.observe = nothing
        try:
            kind = meta_actions(self.scenario.name, env)
            *_, terminated, _, info = env.step(numbered(env, kind, self.action))
        finally:
            del env._simulate
        is_own = self.here.goal.kind == OWN and bool(info.get("is_success", False))
        if (terminated or is_own) and not ego.crashed and ego.on_road:
            if info.get("is_success", True):
                self.succeeded = True
            else:
                self.failed = True

    def _cleared(self, agent: int) -> bool:
        goal, to_go_m = self.here.goal, self.everybody[0].to_go_m
        if self.succeeded or not goal.is_time:
            return bool(self.succeeded or to_go_m <= 0)
        if self.frame < round(goal.seconds * self.scenario.parameters.simulation_hz):
            return False
        self.failed = to_go_m < 0  # it is decided now
        return not self.failed

    def _step(self) -> None:
        standing = {v.spawn.id for v in self.vehicles if v.crashed}
        self._move()
        self.frame += 1
        self.judge(standing)
        if self.failed and not self.outcome.ended:
            self.journey.outcome = self.outcome.ending("time_out", self.time_s)


def _reads_observations(env: Any) -> bool:
    """Return whether observations, each as slow as many frames, affect the episode."""
    is_own = any(
        not f.__module__.startswith("highway_env.") for f in (type(env).step, type(env)._info)
    )
    return is_own or type(env.observation_type).__name__ == "KinematicsGoalObservation"


def _kind(v: Any) -> Kind:
    """Return the kind that a vehicle says it is, by its `kind`, else the one of nearest size."""
    kinds: tuple[Kind, ...] = get_args(Kind)
    word = getattr(v, "kind", None)
    if isinstance(word, str) and word in kinds:
        return word
    return min(
        kinds, key=lambda kind: abs(SIZES_M[kind][0] - v.LENGTH) + abs(SIZES_M[kind][1] - v.WIDTH)
    )


def _buildings(env: Any, here: Place) -> tuple[Building, ...]:
    """Return the solid objects nearest to the ego as buildings,
    by their axis-parallel bounding boxes.
    """
    origin_m = here.road.origin_m
    objects = [
        thing for thing in env.road.objects if is_within(thing.position, origin_m, here.window_m)
    ]
    solid = sorted(filter(hittable, objects), key=partial(_apart_m, env.vehicle))
    boxes = [thing.polygon()[:4] - origin_m for thing in solid[:MOST_BUILDINGS]]
    return tuple(
        Building(f"b{n}", *box.min(axis=0).round(3).tolist(), *box.max(axis=0).round(3).tolist())
        for n, box in enumerate(boxes, 1)
    )


def _apart_m(first: Any, second: Any) -> float:
    return float(np.hypot(*(first.position - second.position)))


class EnvironmentScenario(Scenario):
    """Describe an environment as a scenario, whose road and words follow from its parameters."""

    def __post_init__(self, start: Any) -> None:
        super().__post_init__(start)
        road = RoadOf.of(self)
        is_one = self.layout_seed is not None or not road.differs
        layouts = None if is_one else Layouts(self.name, self.world)
        for name, value in (("road", road), ("words", Words(road)), ("layouts", layouts)):
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        return scenarios.restore, (self.name, self.parameters, self.layout_seed)


@dataclass(frozen=True)
class Words(Mapping[str, str]):
    """Hold the texts for prompts, which are known when the place is: no map is read before."""

    road: RoadOf  # where it is

    @cached_property
    def texts(self) -> dict[str, str]:
        here = self.road.place
        where = here.road.ego[1].partition(" lane ")[0]
        return {"task": here.goal.task(where, here.kind), "hiding": "other vehicles"}

    def __getitem__(self, name: str) -> str:
        return self.texts[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.texts)

    def __len__(self) -> int:
        return len(self.texts)


@dataclass(frozen=True)
class Layouts:
    """Return, when called with a layout seed, the scenario whose place becomes that layout's."""

    name: str  # the scenario's name
    world: Any  # the class of its worlds, an `EnvironmentWorld`

    def __call__(self, seed: int) -> Scenario:
        return scenario(self.name, self.world)


@lru_cache(maxsize=16)
def scenario(name: str, world: type[EnvironmentWorld] = EnvironmentWorld) -> Scenario:
    """Return an environment of highway-env as a scenario, by its name, such as `env:merge-v0`.

    `world` is the class of its worlds. The environment itself decides where vehicles start, so the
    scenario knows no start situations and no danger. Raises UserError if there is no such
    environment, or it lacks something needed.
    """
    parameters, actions = usual(world.environment, name)
    kind = type(start(world.environment, name, 0)).__name__
    return EnvironmentScenario(
        name=name,
        description=f"Scenario {name}: {kind} of highway-env, with its own vehicles and traffic.\n",
        actions=actions,
        parameters=parameters,
        road=RoadOf(world.environment, name, 0, parameters.goal, parameters.window_m, None),
        layout=lambda seed, parameters: Layout((), (), None, None),
        cleared=lambda xy_m, approaches, parameters: np.zeros(xy_m.shape[:-2], dtype=bool),
        words={},  # they follow from the goal
        brake_lamps=True,
        dials=(
            *DIALS,
            "decisions",
            "helpers",
            "time_limit_s",
            "delay_allowance_s",
            "goal",
            "window_m",
        ),
        world=world,
    )
