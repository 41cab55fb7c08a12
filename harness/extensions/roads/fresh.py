"""Let fresh traffic of SUMO be a scenario: everybody, the ego too, drives as SUMO says.

The ego's target speeds and changes of lane are commands to its vehicle in SUMO. Each new command
makes another run from the layout's seed, which is the same up to that time, so branches are exact.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, cast

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.extensions.environments import place as environments
from harness.extensions.environments.place import AFTER, LIMIT
from harness.extensions.environments.world import scenario as scenario_of_environment
from harness.extensions.roads import driver, simulation
from harness.extensions.roads.draws import Drawn, drawn
from harness.extensions.roads.replay import AHEAD_S, Cast, Puppet
from harness.extensions.roads.scene import Track
from harness.extensions.roads.simulation import STEP_S, Command, Inputs, run
from harness.extensions.roads.sumo import inputs_named
from harness.extensions.roads.traffic import (
    MOST_OTHERS,
    Ego,
    Recorded,
    Setting,
    Stage,
    Wall,
    sampled,
)
from harness.extensions.roads.world import RecordedScenario, RecordedWorld, described
from harness.world.scenario import LAYOUTS_KEPT, Names, Scenario
from harness.world.scene_graph import SceneGraph

HZ = round(1 / STEP_S)
LOOKS = 5  # frames between two looks at which lane the ego is on
DECISIONS, PERIOD_S, WINDOW_M = 4, 1.0, 80.0
# Acceleration of SUMO's passenger cars, least and greatest:
# https://sumo.dlr.de/docs/Vehicle_Type_Parameter_Defaults.html
LIMITS_MPS2 = (-4.5, 2.6)


@dataclass(frozen=True)
class Parameters(environments.Parameters):
    """Hold the parameters of fresh traffic as a scenario."""

    braking_mps2: float = -LIMITS_MPS2[0]
    acceleration_mps2: float = LIMITS_MPS2[1]
    # time that SUMO plays before an episode may begin, s; vehicles must have come to the middle
    warm_up_s: float = 20.0


@dataclass(frozen=True, eq=False)
class FreshSetting(Setting):
    """Say what an environment shows of a layout: a run of SUMO from a moment on."""

    drawn: Drawn = field(kw_only=True)

    @cached_property
    def cast(self) -> Cast:
        """Return the road users if nobody decides, the ego first, then by distance at the start."""
        ego, frames = self.track, self._frames
        begin_s = self.moment.time_s
        others = [track for track in self.scene.tracks.values() if track is not ego]
        others = [t for t in others if t.end_s > begin_s and t.begin_s < begin_s + frames / HZ]
        start = sampled(ego, np.array([begin_s]))[0]
        apart = [_least_m(sampled(t, self._times)[:, :2] - start[:2]) for t in others]
        near = np.argsort(apart, kind="stable")[:MOST_OTHERS].tolist()
        tracks = [ego, *[others[n] for n in near]]
        return self._cast_of(tracks, {track.id: track for track in tracks})

    def cast_told(self, commands: tuple[Command, ...]) -> Cast:
        """Return the same road users in the run in which the ego is told these commands."""
        begin_s, end_s = self.moment.time_s, self.moment.time_s + self.limit_s
        drawn, ego = self.drawn, self.moment.vehicle
        tracks = run(drawn.inputs, drawn.seed, begin_s, end_s, ego, commands)
        return self._cast_of(self.cast.tracks, tracks)

    def _cast_of(self, known_tracks: Sequence[Track], run_tracks: Mapping[str, Track]) -> Cast:
        """Return the poses of road users in a run, those of one that is not in it NaN."""
        poses = []
        for track in known_tracks:
            in_run = run_tracks.get(track.id)
            nowhere = np.full((len(self._times), 4), np.nan)
            poses.append(nowhere if in_run is None else sampled(in_run, self._times))
        away_m = np.hypot(*np.moveaxis(np.stack(poses)[..., :2] - self.middle_m, -1, 0))
        inside = away_m <= self.window_m
        enters = np.where(inside.any(axis=1), inside.argmax(axis=1), len(self._times))
        leaves = len(self._times) - 1 - inside[:, ::-1].argmax(axis=1)
        return Cast(HZ, tuple(known_tracks), np.stack(poses), enters, leaves)

    @property
    def _frames(self) -> int:
        return round((self.limit_s + AHEAD_S) * HZ) + 1

    @cached_property
    def _times(self) -> Floats:
        return self.moment.time_s + np.arange(self._frames) / HZ


def _least_m(apart: Floats) -> float:
    """Return the length of the shortest of vectors (n, 2), of which some are NaN."""
    lengths = np.hypot(*apart.T)
    return float(np.nanmin(lengths)) if not np.isnan(lengths).all() else np.inf


@dataclass(eq=False)
class Drive:
    """Say where everybody is, frame by frame, in the run of the ego's commands so far."""

    setting: FreshSetting
    commands: tuple[Command, ...]
    frame: int
    poses: Floats  # x, y, heading and speed of each, (N, 4)
    there: Bools  # who is there, (N,)
    braking: Bools  # whose brake lamps are on, (N,)
    crashed: Bools  # who has met the ego, (N,)
    places: Any = None  # `place` in the frame `looked_at`
    looked_at: int = -1

    @classmethod
    def start(cls, setting: FreshSetting) -> "Drive":
        """Begin at the first frame."""
        cast = setting.cast
        nobody = np.zeros(len(cast.tracks), dtype=bool)
        return cls(setting, (), 0, cast.poses[:, 0].copy(), cast.enters == 0, nobody, nobody.copy())

    @property
    def cast(self) -> Cast:
        return self.setting.cast

    def branch(self) -> "Drive":
        """Return a copy that goes on by itself."""
        return replace(self, there=self.there.copy(), crashed=self.crashed.copy())

    def move(self, commands: tuple[Command, ...]) -> None:
        """Move everybody to the next frame of the run in which the ego is told these commands."""
        here = _cast(self.setting, commands)
        self.commands, self.frame = commands, self.frame + 1
        at = min(self.frame, here.poses.shape[1] - 1)
        before, self.poses = self.poses, here.poses[:, at].copy()
        if np.isnan(self.poses[0, 0]):  # it has left the net: it goes straight on
            way = np.array([np.cos(before[0, 2]), np.sin(before[0, 2])])
            self.poses[0] = before[0]
            self.poses[0, :2] += before[0, 3] / HZ * way
        self.braking = here.braking[:, at]
        self.there = (here.enters <= at) & (at <= here.leaves) & ~np.isnan(self.poses[:, 0])
        self.there[0] = True
        gone = ~self.there
        self.poses[gone] = before[gone]  # who has left stays where it was, for who still looks

    def off(self) -> Bools:
        """Return who counts where two touch, (N,): the ego; what else they do is SUMO's."""
        return np.asarray(np.arange(len(self.there)) == 0)

    @property
    def place(self) -> Ints:
        """Return the frame in which each is nearest to its place if nobody decides, (N,)."""
        if self.looked_at != self.frame:
            apart_m = self.cast.poses[..., :2] - self.poses[:, None, :2]
            apart_m2 = (apart_m**2).sum(axis=-1)
            self.places = np.nan_to_num(apart_m2, nan=np.inf).argmin(axis=1)
            self.looked_at = self.frame
        return np.asarray(self.places)


@lru_cache(maxsize=simulation.RUNS_KEPT)
def _cast(setting: FreshSetting, commands: tuple[Command, ...]) -> Cast:
    return setting.cast_told(commands)


class ToldEgo(Ego):
    """Turn actions into commands for the ego's vehicle in SUMO, and be where that is."""

    commands: tuple[Command, ...] = ()

    def speed_control(self, target_speed: float) -> float:
        least, most = LIMITS_MPS2
        return float(np.clip(super().speed_control(target_speed), least, most))

    def act(self, action: Any = None) -> None:
        if action is None:
            if self.road.play.frame % LOOKS == 0:
                self.follow_road()
            self.action = {"steering": 0.0, "acceleration": self.speed_control(self.target_speed)}
            return
        lane, speed_mps = self.target_lane_index, self.target_speed
        super().act(action)
        same_street = self.target_lane_index[:2] == lane[:2]
        to_left = int(lane[2] - self.target_lane_index[2]) if same_street else 0
        if to_left or self.target_speed != speed_mps:
            self.tell(to_left)

    def tell(self, to_left: int) -> None:
        """Tell the vehicle to aim for the target speed, and to change lane, from now on."""
        drive = self.road.play
        time_s = drive.setting.moment.time_s + drive.frame / HZ
        self.commands += (Command(time_s, float(self.target_speed), to_left),)

    def step(self, dt: float) -> None:
        x_m, y_m, heading, speed_mps = self.road.play.poses[0].tolist()
        self.position, self.heading, self.speed = np.array([x_m, y_m]), heading, speed_mps
        if self.road.play.frame % LOOKS == 0 or not self.on_road:
            self.on_state_update()


class FreshStage(Stage):
    """Show where everybody is in SUMO, frame by frame."""

    def step(self, dt: float) -> None:
        play, ego = self.play, self.ego
        before, there = play.poses.copy(), play.there
        play.move(ego.commands)
        ego.step(dt)
        if not np.array_equal(there, play.there):
            self.show()
        self._collide(before)


class Fresh(Recorded):
    """Play layouts of fresh traffic; the seed of a reset says which."""

    def __init__(self, source: "Source", parameters: Parameters | None = None) -> None:
        self.warm_up_s = parameters.warm_up_s if parameters else Parameters.warm_up_s
        limit_s = parameters.time_limit_s if parameters else None
        super().__init__(cast("Any", source), limit_s=limit_s)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin the layout of a seed; without one, nothing is there yet."""
        if seed is None:
            return None, {}
        source = cast("Source", self.recording)
        self.setting = setting(source.inputs, seed, self.warm_up_s, self.limit_s)
        return super(Recorded, self).reset(seed=seed, options=options)

    def _reset(self) -> None:
        setting = cast("FreshSetting", self.setting)
        self.road = FreshStage(setting.ground.network, cast("Any", Drive.start(setting)))
        tracks = setting.cast.tracks
        self.road.puppets = [Puppet(self.road, n, track) for n, track in enumerate(tracks)]
        self.vehicle = self._ego(ToldEgo)
        self.road.vehicles = [self.vehicle]
        self.road.show()
        self.road.objects = [Wall(low, high) for low, high in setting.boxes]
        self.vehicle.tell(0)


@dataclass(frozen=True)
class Source:
    """Describe fresh traffic as `Recorded` needs it of a recording."""

    inputs: Inputs

    @dataclass(frozen=True)
    class Facts:
        """Hold how many decisions an episode has, how far apart, and the time between two poses."""

        decisions: int = DECISIONS
        period_s: float = PERIOD_S
        step_s: float = STEP_S

    @property
    def facts(self) -> "Source.Facts":
        return self.Facts()

    @property
    def scenes_stated(self) -> tuple["Source.Facts", ...]:
        return (self.Facts(),)

    @property
    def speeds_mps(self) -> tuple[float, ...]:
        """Return the ego's target speeds: none, half and all of the greatest limit, rounded."""
        limits = [lane.limit_mps or 0.0 for lane in simulation.map_of(self.inputs).lanes.values()]
        top = max(2.0, float(np.round(max(limits))))
        return 0.0, top / 2, top


@lru_cache(maxsize=LAYOUTS_KEPT)
def setting(inputs: Inputs, seed: int, warm_up_s: float, limit_s: float) -> FreshSetting:
    """Return what there is in the layout of a seed; the same object for the same layout."""
    goal_s = limit_s - (LIMIT - AFTER) * PERIOD_S
    layout = drawn(inputs, seed, warm_up_s, WINDOW_M, goal_s, limit_s)
    return FreshSetting(layout.scene, layout.moment, WINDOW_M, HZ, goal_s, limit_s, drawn=layout)


@dataclass
class FreshWorld(RecordedWorld):
    """Simulate one episode of fresh traffic, frame by frame."""

    env: Any = None  # a `Fresh`

    @classmethod
    def environment(cls, name: str, parameters: environments.Parameters | None = None) -> Fresh:
        return Fresh(Source(inputs_named(name)), cast("Parameters | None", parameters))

    @classmethod
    def configuration(cls, scenario: Scenario) -> dict[str, Any]:
        """Return which SUMO plays, and how, for a dataset's manifest."""
        inputs = inputs_named(scenario.name)
        return {
            "sumo": simulation.version(),
            "options": dict(simulation.OPTIONS),
            "speed_mode": simulation.SPEED_MODE,
            "lane_change_mode": simulation.LANE_CHANGE_MODE,
            "sha256": inputs.digest,
        }

    @classmethod
    def problems(cls, scenario: Scenario) -> Iterator[str]:
        yield from ()  # a layout's moment follows from its seed

    @classmethod
    def files(cls, scenario: Scenario) -> Mapping[str, bytes]:
        return inputs_named(scenario.name).files

    @classmethod
    def drivers(cls) -> Mapping[str, Callable[[Scenario, SceneGraph], str]]:
        return {driver.NAME: _undisturbed}


def _undisturbed(scenario: Scenario, graph: SceneGraph) -> str:
    """Return the action that brings the ego nearest to where it is later if nobody decides."""
    return driver.follow(scenario, graph, setting_of(scenario))


def setting_of(scenario: Scenario) -> FreshSetting:
    """Return what there is in the layout of a layout's scenario."""
    p, seed = cast("Parameters", scenario.parameters), scenario.layout_seed
    assert seed is not None
    return setting(inputs_named(scenario.name), seed, p.warm_up_s, p.time_limit_s)


@dataclass(frozen=True)
class Layouts:
    """Return, when called with a layout seed, the scenario whose place becomes that layout's."""

    name: str  # the scenario's name
    parameters: Parameters

    def __call__(self, seed: int) -> Scenario:
        p = self.parameters
        layout = setting(inputs_named(self.name), seed, p.warm_up_s, p.time_limit_s)
        scene = layout.scene.name
        by_id = {f"v{n}": f"{scene}/{track.id}" for n, track in enumerate(layout.cast.tracks, 1)}
        return replace(scenario(self.name), names=Names(layout.moment.time_s, by_id, True))


class FreshScenario(RecordedScenario):
    """Describe fresh traffic as a scenario; each layout is a run of SUMO, with its road."""

    by_seed = Layouts


@lru_cache(maxsize=16)
def scenario(name: str) -> Scenario:
    """Return fresh traffic as a scenario, by its name, such as `sumo:crossing@0123456789ab`.

    Raises UserError if no folder that is known has the files, or SUMO is not installed.
    """
    simulation.version()
    return described(
        FreshScenario,
        scenario_of_environment(name, FreshWorld),
        Parameters,
        DECISIONS,
        PERIOD_S,
        dial="warm_up_s",
        description=f"Scenario {name}: fresh traffic of SUMO.\n",
        source=f"simulated with SUMO {simulation.version()}",
    )
