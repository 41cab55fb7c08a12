"""Simulate an episode at a moment of a recording; make a scenario of a recording."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, ClassVar, cast

import numpy as np

from harness.core.errors import UserError
from harness.core.files import bytes_of
from harness.extensions.environments import place as environments
from harness.extensions.environments.place import LIMIT
from harness.extensions.environments.world import EnvironmentScenario, EnvironmentWorld
from harness.extensions.environments.world import scenario as scenario_of_environment
from harness.extensions.roads import driver
from harness.extensions.roads.family import REPLAYED, recording_of
from harness.extensions.roads.held import sessions_of
from harness.extensions.roads.tables import FACTS, SCHEMAS
from harness.extensions.roads.traffic import LIMITS_MPS2, Recorded, nth, setting
from harness.world.outcome import SAME_WAY
from harness.world.parameters import DIALS
from harness.world.parameters import Parameters as Common
from harness.world.road import PathKey
from harness.world.scenario import Names, Scenario
from harness.world.scene_graph import SceneGraph
from harness.world.simulator import LAMPS_MPS2
from harness.world.state import Part

# Of a digest, in the name of what a layout is cut from, and how many scenes the name has at most.
LETTERS, PARTS = 12, 40


@dataclass(frozen=True)
class Parameters(environments.Parameters):
    """Hold the parameters of a recording as a scenario.

    Times are those of the recording; an ego that reaches its goal within the time limit is never
    late, for the goal is where its recorded driver was.
    """

    braking_mps2: float = -LIMITS_MPS2[0]
    acceleration_mps2: float = LIMITS_MPS2[1]
    # whether the others react to who is off the recording; else they replay, whatever happens
    react: bool = True


@dataclass
class RecordedWorld(EnvironmentWorld):
    """Simulate one episode at a moment of a recording, frame by frame."""

    env: Any = None  # a `Recorded`

    @classmethod
    def environment(cls, name: str, parameters: environments.Parameters | None = None) -> Recorded:
        recording = recording_of(name)
        if parameters is None:
            return Recorded(recording)
        p = cast("Parameters", parameters)
        return Recorded(recording, p.react, p.time_limit_s)

    @classmethod
    def configuration(cls, scenario: Scenario) -> dict[str, Any]:
        """Return how the recording's moments were chosen, for a dataset's manifest."""
        recording = recording_of(scenario.name)
        return {
            "recording": recording.name,
            "sha256": recording.digest,
            "window_m": recording.window_m,
            "choice": dict(recording.choice),
        }

    @classmethod
    def files(cls, scenario: Scenario) -> Mapping[str, bytes]:
        folder = recording_of(scenario.name).folder
        return {name: bytes_of(folder / name, "rows") for name in (FACTS, *SCHEMAS)}

    @classmethod
    def problems(cls, scenario: Scenario) -> Iterator[str]:
        from harness.extensions.roads.fitness import other_choice

        problem = other_choice(recording_of(scenario.name))
        if problem is not None:
            yield problem

    @classmethod
    def examine(cls, scenario: Scenario, seed: int) -> None:
        for problem in cls.problems(scenario):
            raise UserError(f"{problem}; make the recording again: `harness dataset import`")
        super().examine(scenario, seed)

    @classmethod
    def drivers(cls) -> Mapping[str, Callable[[Scenario, SceneGraph], str]]:
        return {driver.NAME: driver.action}

    def _danger(self) -> tuple[str | None, str | None]:
        """Return the sector and the id of the hidden road user of the moment; None for none."""
        hidden = self.env.setting.moment.hidden
        v = next((v for v in self.everybody[1:] if v.track.id == hidden), None)
        if v is None:
            return None, None
        sectors = self.here.road.sectors
        # who comes on no path that meets the ego's is on that, or beside
        sector = v.spawn.approach if v.spawn.approach in sectors else next(iter(sectors))
        return sector, v.spawn.id

    def _collision(self, ego: Any, wrecks: Sequence[Any]) -> dict[str, str]:
        """Return whom the ego hit, and how; without a fault where nobody drove into a back.

        Recordings do not say who has the right of way.
        """
        how = super()._collision(ego, wrecks)
        partner = next((v for v in wrecks if v.spawn.id == how.get("partner")), None)
        if partner is not None and np.cos(ego.heading - partner.heading) <= SAME_WAY:
            del how["fault"]
        return how

    def _enter(self, v: Any, part: Part) -> None:
        number = getattr(v, "number", 0)
        if number:
            helpers = self.env.helpers(self.scenario.parameters.helpers)  # type: ignore[attr-defined]
            part = "helper" if number in helpers and not self.frame else "other"
        super()._enter(v, part)
        v.spawn = replace(v.spawn, id=f"v{number + 1}")

    def _place(self, v: Any) -> None:
        number = getattr(v, "number", 0)
        if not number:
            super()._place(v)
            return
        play = self.env.road.play
        approach, route = self._key(number, int(play.place[number]))
        if (approach, route) != (v.spawn.approach, v.spawn.route):
            v.spawn = replace(v.spawn, approach=approach, route=route)

    def _key(self, number: int, frame: int) -> PathKey:
        """Return the path on which a road user is recorded in a frame."""
        setting = self.env.setting
        frame = setting.looked_at(number, frame)
        if (number, frame) not in setting.keys:
            lane, road = setting.lanes(number)[frame], self.here.road
            keys: list[PathKey] = [road.ego]
            if lane is not None:
                keys = self.here.routes.keys(lane, setting.plan(number, frame)) or keys
            setting.keys[number, frame] = keys[0]
        return cast("PathKey", setting.keys[number, frame])

    def _poses(self) -> Any:
        return self.env.road.play.poses[[0, *[v.number for v in self.everybody[1:]]]]

    def branch(self) -> "RecordedWorld":
        env = self.env.branch()
        journeys = {agent: replace(journey) for agent, journey in self.journeys.items()}
        everybody = [env.vehicle, *[env.road.puppets[v.number] for v in self.everybody[1:]]]
        return replace(self, env=env, road=env.road, everybody=everybody, journeys=journeys)

    def _solid(self) -> list[Any]:
        """Return who is on the road; who enters does so when periods end."""
        if self.frame % self.period == 0:
            return list(self.road.vehicles)
        known_ids = {id(v) for v in self.everybody}
        return [v for v in self.road.vehicles if id(v) in known_ids]

    def _move(self) -> None:
        self.constants.restore()
        road, ego = self.env.road, self.everybody[0]
        before = ego.position.copy()
        road.act()
        ego.braking = ego.action["acceleration"] < -LAMPS_MPS2
        road.step(1 / self.scenario.parameters.simulation_hz)
        ego.to_go_m -= float(np.hypot(*(ego.position - before)))


@dataclass(frozen=True)
class Moments:
    """Return, when called with a layout seed, the scenario whose place becomes that moment's.

    It has the names that the recording has for vehicles.
    """

    name: str  # the scenario's name
    parameters: Common

    def __call__(self, seed: int) -> Scenario:
        recording, p = recording_of(self.name), self.parameters
        moment = nth(recording, seed)
        cast = setting(recording, moment, p.simulation_hz, p.time_limit_s).cast
        by_id = {
            f"v{number}": f"{moment.scene}/{track.id}"
            for number, track in enumerate(cast.tracks, 1)
        }
        several = len(recording.scenes_stated) > 1
        return replace(scenario(self.name), names=Names(moment.time_s, by_id, several))


class RecordedScenario(EnvironmentScenario):
    """Describe a recording as a scenario; each layout is a moment of it, with its road."""

    by_seed: ClassVar[type[Any]] = Moments  # returns the scenario of a layout, by its seed

    def __post_init__(self, start: Any) -> None:
        super().__post_init__(start)
        if self.layouts is not None:
            layouts = self.by_seed(self.name, self.parameters)
            object.__setattr__(self, "layouts", layouts)

    @property
    def caveat(self) -> str:
        return "" if getattr(self.parameters, "react", True) else REPLAYED


@dataclass(frozen=True)
class Scenes:
    """Return, when called with a layout seed, the traffic from which its layout is cut.

    Scenes that share traffic have one name. It has what moves in each of them, so that another
    recording with any of the same shares a part of it.
    """

    name: str  # the scenario's name

    def __call__(self, seed: int) -> str:
        recording = recording_of(self.name)
        sessions = sessions_of(recording)
        scene = nth(recording, seed).scene
        contents = sessions.contents_of(scene)
        if len(contents) > PARTS:  # then any two have the first, and each its own
            contents = [*contents[: PARTS - 1], sessions.traffic[scene].content]
        return " + ".join(f"traffic {content[:LETTERS]}" for content in contents)


@lru_cache(maxsize=16)
def scenario(name: str) -> Scenario:
    """Return a recording as a scenario, by its name, such as `recording:crossing@0123456789ab`.

    Raises UserError if no folder that is known has the recording, or it has no moments.
    """
    recording = recording_of(name)
    facts = recording.facts
    return described(
        RecordedScenario,
        scenario_of_environment(name, RecordedWorld),
        Parameters,
        facts.decisions,
        facts.period_s,
        dial="react",
        description=f"Scenario {name}: moments of recorded traffic.\n",
        source=recording.source,
        licence=recording.licence,
        cluster=Scenes(name),
    )


def described(
    kind: type[RecordedScenario],
    base: Scenario,
    parameters: type[environments.Parameters],
    decisions: int,
    period_s: float,
    dial: str,
    **parts: Any,
) -> Scenario:
    """Return a scenario of an environment as one of traffic, whose goal may take to the end.

    Args:
        kind: the class of the scenario.
        base: the scenario of the environment.
        parameters: the class of its parameters, which has the ego's limits.
        decisions: number of decisions of an episode, `period_s` apart.
        period_s: seconds between two decisions.
        dial: name of the parameter that users may set besides those of every environment.
        parts: further fields of the scenario that are other than the environment's.
    """
    values = {field.name: getattr(base.parameters, field.name) for field in fields(base.parameters)}
    limit_s = (decisions + LIMIT) * period_s
    values |= {
        "decisions": decisions,
        "time_limit_s": limit_s,
        "delay_allowance_s": limit_s,
        "braking_mps2": parameters.braking_mps2,
        "acceleration_mps2": parameters.acceleration_mps2,
    }
    of_base = {field.name: getattr(base, field.name) for field in fields(Scenario)}
    of_base |= {
        "parameters": parameters(**values),
        "dials": (*DIALS, dial, "decisions", "helpers", "time_limit_s", "delay_allowance_s"),
    }
    return kind(**(of_base | parts))
