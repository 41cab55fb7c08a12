"""Drive the closed loop: a decision is made from what vehicles see when it is due,
and acts when it is ready.

Decision k is due at k decision periods. The model answers from what each vehicle sees then. The
action is taken in the first frame that begins after the decision's latency; until then the ego
keeps to its last one. A decision that is still open when the next one is due continues, and the
next one is skipped.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, ClassVar

import msgspec
import numpy as np
from msgspec import structs

from harness.coordination.operating_point import OperatingPoint
from harness.coordination.plans import STANDING_MPS, Plans
from harness.core.arrays import Ints
from harness.dataset.freeze import records_of
from harness.dataset.load import Earlier, Scene
from harness.dataset.select import Choice
from harness.evaluate import branches
from harness.evaluate.branches import Course, Decision, Trajectory
from harness.evaluate.draws import OF_ANOTHER_AGENT
from harness.evaluate.helper_numbers import Helpers
from harness.evaluate.walk import Decided, Due, SceneWorld
from harness.runs import metric
from harness.runs.records import ClosedLoop, Episode
from harness.runs.settings import DriveSettings
from harness.world import conflict_measures, reference, scenarios
from harness.world.drivers import PRIVILEGED
from harness.world.lookouts import radios
from harness.world.outcome import Outcome, rating
from harness.world.parameters import frames
from harness.world.scenario import Scenario
from harness.world.seats import agent_share, offset_of, offsets, places_by
from harness.world.swarm import alone, ends, gravest
from harness.world.world import World


@dataclass(frozen=True)
class LiveSource:
    """Describe the layouts of a scenario to drive in closed loop, as `harness drive` does.

    A layout is one start situation, drawn by its seed; episode e of the `episodes` has layout seed
    `first_seed` + e. `scenario_name` is the scenario's name, with settings as they are typed. With
    a `choice`, only the episodes that it has selected, by settings of an extension, are driven.
    `name` stands in names of runs' folders, and `kind` is the kind of world.
    """

    first_seed: int  # layout seed of episode 0
    episodes: int  # number of episodes
    # name of the scenario, with settings as they are typed, such as `NAME:beacon_loss=0.3`
    scenario_name: str = scenarios.DEFAULT
    choice: Choice | None = None  # what chose some of the episodes, such as a sample; None for all
    name: ClassVar[str] = "drive"  # word for the scenes in the names of runs' folders
    kind: ClassVar[metric.World] = "closed-loop"  # the kind of world: a simulated one

    @cached_property
    def scenario(self) -> Scenario:
        return scenarios.get(self.scenario_name)

    @property
    def numbers(self) -> Sequence[int]:
        """Return the numbers of the episodes to drive; a run that stops early drives the first."""
        return self.choice.numbers if self.choice else range(self.episodes)

    @property
    def actions(self) -> tuple[str, ...]:
        return self.scenario.actions

    @property
    def layout_seeds(self) -> Sequence[int]:
        return [self.first_seed + number for number in self.numbers]

    def record(self) -> ClosedLoop:
        # As a run's file has them, so that one that is read is of the same scenes: lists, and no
        # tuples.
        parameters = json.loads(json.dumps(self.scenario.parameters.stated()))
        return ClosedLoop(
            scenario={"name": self.scenario.name, "parameters": parameters},
            first_seed=self.first_seed,
            episodes=len(self.numbers),
            late_against="full-view driver, whose decisions act after decision_lag_s",
            selection={"of": self.episodes, **self.choice.given} if self.choice else {},
        )

    def first(self, count: int) -> "LiveSource":
        """Return at most `count` of these episodes to drive, from the first.

        Nothing chooses among them any more.
        """
        return replace(self, episodes=min(count, self.episodes))

    def settings(self) -> DriveSettings:
        return DriveSettings(
            scenario=scenarios.argument(self.scenario),
            episodes=self.episodes,
            first_seed=self.first_seed,
        )

    def trial(self, most: int, ego_alone: bool) -> Iterator[Scene]:
        """Yield one decision point of each of up to `most` episodes, at different times.

        With `ego_alone` it has no scene graph of a helper. A scene graph is what one vehicle knows
        of a scene.
        """
        p = self.scenario.parameters
        for number in self.numbers[:most]:
            trajectory = Trajectory(
                number, World.start(self.scenario, self.first_seed + number), []
            )
            trajectory.world.advance(round(number * p.decision_period_s * p.simulation_hz / 2))
            yield look(trajectory.world, 0, number, 0, ego_alone)


class LiveWorld(SceneWorld):
    """Simulate the episodes of layouts under all conditions and channel seeds.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages. Episodes of one layout, a start situation, that have acted alike so far share a
    simulation. A decision takes effect in the first frame after its latency.
    """

    def __init__(
        self,
        scenario: Scenario,
        first_seed: int,
        numbers: Sequence[int],
        points: Sequence[OperatingPoint],
        seeds: Sequence[int],
        ego_alone: bool,
    ) -> None:
        """Start the episodes of these `numbers`; episode 0 has layout seed `first_seed`.

        With `ego_alone` helpers are never asked, and no scene graphs of theirs are made.
        """
        self.scenario, self._p = scenario, scenario.parameters
        self._first_seed, self._ego_alone = first_seed, ego_alone
        self._going: list[Trajectory] = []
        for number in numbers:
            courses = [Course(point, seed) for point, seed in product(points, seeds)]
            world = World.start(scenario, first_seed + number)
            self._going.append(Trajectory(number, world, courses))
        self._ended: list[Trajectory] = []
        self._helpers = Helpers()
        self._decisions: list[Decision] = []
        self._step, self._tick, self._ticks = 0, 0, offsets(scenario)

    def observe(self) -> Sequence[Scene]:
        while self._going and self._step < self._p.decisions:
            self._deciding = []
            for trajectory in self._going:
                for agent in trajectory.under_way:
                    if self._is_due(trajectory, agent):
                        waits = [agent in course.open for course in trajectory.courses]
                        for course, waiting in zip(trajectory.courses, waits, strict=True):
                            course.skipped += waiting
                        if not all(waits):
                            self._deciding.append((trajectory, agent))
            if self._deciding:
                points = [(t.world, agent, t.number) for t, agent in self._deciding]
                before = [t.scenes.get(agent) for t, agent in self._deciding]
                self.scenes = looks(points, self._step, self._ego_alone, before)
                for (t, agent), scene in zip(self._deciding, self.scenes, strict=True):
                    t.scenes[agent] = scene
                self._numbers = self._helpers.numbers(self.scenes)
                return self.scenes
            self._advance()
        return ()

    def due(self, point: OperatingPoint) -> Due:
        places = self._places(point)
        at = np.array([n for n, _ in places], dtype=int)
        seed = np.array([course.seed for _, course in places], dtype=int)
        number = np.array(
            [
                t.number + scene.agent * OF_ANOTHER_AGENT
                for (t, _), scene in zip(self._deciding, self.scenes, strict=True)
            ]
        )
        episode = number[at]
        keys = seed, self._first_seed + episode, np.full(len(at), self._step), self._p.decisions
        draws = self._numbers.draws(at, *keys)
        senders = self._senders(places) if point.needs("plans") else None
        return Due(at, episode, seed, draws, senders)

    def _senders(self, places: Sequence[tuple[int, Course]]) -> Ints:
        """Return the decision that each helper makes itself now, (n, H), as `Due.senders`."""
        rows: dict[tuple[int, str], int] = {}
        for row, (n, course) in enumerate(places):
            rows[id(course), self.scenes[n].viewers[0]] = row
        senders = np.full((len(places), max(len(scene.viewers) for scene in self.scenes) - 1), -1)
        for row, (n, course) in enumerate(places):
            for h, helper in enumerate(self.scenes[n].viewers[1:]):
                senders[row, h] = rows.get((id(course), helper), -1)
        return senders

    def plans(self) -> Plans | None:
        if not agent_share(self.scenario):
            return None
        road, vehicles = (
            self.scenario.road(),
            [t.world.vehicles[agent] for t, agent in self._deciding],
        )
        spawns, egos = [v.spawn for v in vehicles], [scene.state.ego for scene in self.scenes]
        x_m, y_m, heading_rad, speed_mps, time_s = np.array(
            [
                (v.x_m, v.y_m, v.heading_rad, v.speed_mps, s.state.time_s)
                for v, s in zip(egos, self.scenes, strict=True)
            ]
        ).T
        ahead_m = (road.zone_m[0] - x_m) * np.cos(heading_rad) + (road.zone_m[1] - y_m) * np.sin(
            heading_rad
        )
        distance_m = np.hypot(road.zone_m[0] - x_m, road.zone_m[1] - y_m)
        reaches_s = distance_m / np.maximum(speed_mps, STANDING_MPS)
        reaches_s[(speed_mps < STANDING_MPS) | (ahead_m <= 0)] = np.inf
        arc_m = road.project([(s.approach, s.route) for s in spawns], x_m, y_m)[0]
        driven_s = (arc_m - [s.arc_m for s in spawns]) / [s.speed_mps for s in spawns]
        number = np.array([agent for _, agent in self._deciding])
        nobody = np.empty((len(number), 0), dtype=int)
        return Plans(
            nobody, number[:, None], reaches_s[:, None], np.maximum(time_s - driven_s, 0.0)[:, None]
        )

    def step(self, decided: Sequence[Decided[Scene]]) -> None:
        actions, hz = self.scenario.actions, self._p.simulation_hz
        due_frame = self._frame
        for part in decided:
            latencies_s, chosen = part.result.latency_s.tolist(), part.result.action.tolist()
            for (n, course), latency_s, action in zip(
                self._places(part.point), latencies_s, chosen, strict=True
            ):
                decision = Decision(actions[action], due_frame + frames(latency_s, hz))
                course.open[self._deciding[n][1]] = course.last[self._deciding[n][1]] = decision
                self._decisions.append(decision)
        self._advance()

    def _places(self, point: OperatingPoint) -> list[tuple[int, Course]]:
        return [
            (n, course)
            for n, (trajectory, agent) in enumerate(self._deciding)
            for course in trajectory.courses
            if agent not in course.open and course.point is point
        ]

    def _is_due(self, trajectory: Trajectory, agent: int) -> bool:
        """Return whether an agent decides at this tick;
        each has a tick of its own, or all have the first.
        """
        return offset_of(self.scenario, trajectory.world.seed, agent) == self._ticks[self._tick]

    @property
    def _frame(self) -> int:
        """The frame of this tick, or that of the time limit after the last decision."""
        over = self._step >= self._p.decisions
        return self._p.due_frame(self._step) + (0 if over else self._ticks[self._tick])

    def _advance(self) -> None:
        self._tick = (self._tick + 1) % len(self._ticks)
        self._step += self._tick == 0
        parts = branches.advance(self._going, self._frame)
        for part in parts:
            part.measure()
        self._ended += [part for part in parts if part.world.ended]
        self._going = [part for part in parts if not part.world.ended]

    def columns(self) -> dict[str, Any]:
        """Return when each decision took effect, and how near others came, by column, `(n,)`.

        The n decisions are in the order of the calls of `step`, which plays them. Columns are
        `acts_at_s`, the time in s at which it takes effect, `acted`, whether it did, and the least
        time to collision and post-encroachment time in s until the agent's next decision. An agent
        is a vehicle that decides for itself.
        """
        ttc_s = np.array([decision.ttc_s for decision in self._decisions])
        pet_s = np.array([decision.pet_s for decision in self._decisions])
        return {
            "acts_at_s": np.array([d.frame for d in self._decisions]) / self._p.simulation_hz,
            "acted": np.array([d.acted for d in self._decisions]),
            **conflict_measures.columns(ttc_s, pet_s),
        }

    def episodes(self) -> list[Episode]:
        return ended(self.scenario, self._ended)


def ended(scenario: Scenario, trajectories: Sequence[Trajectory]) -> list[Episode]:
    """Return the record of each ended episode, one for each course of each trajectory.

    A trajectory is a simulated world, a course an episode of it under one condition and channel
    seed. A success is late if it takes too long against a driver that sees everything and whose
    decisions act after the lag (the dataset's time from a decision to its action). Where several
    agents decide nobody is late: no such driver exists for all of them together. A condition is a
    named set of settings of the radio, of asking helpers and of fusing their messages. An agent is
    a vehicle that decides for itself.
    """
    if agent_share(scenario):
        alone_s = alone(scenario, list(dict.fromkeys(t.world.seed for t in trajectories)))
        return [
            _swarm(t, course, alone_s[t.world.seed]) for t in trajectories for course in t.courses
        ]
    seeds = {t.number: t.world.seed for t in trajectories if t.world.outcome.success}
    worlds = [World.start(scenario, seeds[number]) for number in sorted(seeds)]
    outcomes = reference.finish(worlds, [PRIVILEGED] * len(worlds))
    references = dict(zip(sorted(seeds), outcomes, strict=True))
    return [
        _episode(t, course, references.get(t.number)) for t in trajectories for course in t.courses
    ]


def look(world: World, agent: int, number: int, step: int, ego_alone: bool) -> Scene:
    """Return the scene in which one vehicle of a simulated world decides now.

    `agent` is its index among the world's vehicles, 0 the ego. `number` is the episode's, and
    `step` that of the decision. With `ego_alone` the scene lacks what helpers know, their scene
    graphs.
    """
    [scene] = looks([(world, agent, number)], step, ego_alone)
    return scene


def looks(
    points: Sequence[tuple[World, int, int]],
    step: int,
    ego_alone: bool,
    before: Sequence[Scene | None] | None = None,
) -> list[Scene]:
    """Return the scene in which each agent decides now, given its world, index and episode.

    `points` has for each the simulated world, the index of the agent among its vehicles (0 the ego)
    and the number of the episode; `step` is the number of the decision. With `ego_alone` scenes
    lack what helpers know, their scene graphs. `before` has each agent's decision point before.
    """
    states = [structs.replace(world.state(agent), step=step) for world, agent, _ in points]
    scenes = dict[int, Scene]()
    for scenario, places in places_by(world.seat(agent) for world, agent, _ in points).items():
        seen = [
            (
                points[n][0],
                states[n],
                points[n][2],
                [states[n].ego] if ego_alone else [states[n].ego, *states[n].helpers],
            )
            for n in places
        ]
        for n, record in zip(places, records_of(scenario, seen), strict=True):
            world, agent, _ = points[n]
            place = world.answering.index(agent) if agent else 0
            seat = scenario if agent or scenario.has_own_world else None
            scenes[n] = Scene(
                record,
                seat=seat,
                agent=place,
                several=agent_share(world.scenario) > 0,
                before=Earlier(before[n] if before else None),
            )
    return [scenes[n] for n in range(len(points))]


def _episode(trajectory: Trajectory, course: Course, full_view: Outcome | None) -> Episode:
    """Return how an episode ended; it is `late` if it cleared too long after the full-view
    driver.
    """
    world = trajectory.world
    ended = world.outcome
    outcome = (
        ended.judged(full_view, world.layout.danger, world.scenario.parameters)
        if full_view
        else ended
    )
    failure = "" if outcome.success else outcome.result
    delay_s = None
    if full_view and full_view.time_s is not None and full_view.success and ended.success:
        delay_s = round((ended.time_s or 0.0) - full_view.time_s, 3)
    return Episode(
        condition=course.point.name,
        seed=course.seed,
        episode=trajectory.number,
        layout_seed=world.seed,
        danger=world.layout.danger or "none",
        success=outcome.success,
        failure=failure,
        outcome=rating(failure, world.scenario.parameters),
        delay_s=delay_s,
        time_s=outcome.time_s,
        partner=outcome.partner,
        striker=outcome.striker,
        fault=outcome.fault,
        least_gap_m=round(outcome.least_gap_m, 3),
        hard_brakings=world.journey.hard_brakings,
        other_crashes=outcome.other_crashes,
        skipped=course.skipped,
        cluster=world.scenario.cluster_of(world.seed),
        **radios(world.scenario, world.seed, world.layout.danger),
    )


def _swarm(trajectory: Trajectory, course: Course, alone_s: Mapping[int, float]) -> Episode:
    """Return how an episode of several agents ended: it succeeds if all of them reach their goals.

    Its failure is the gravest of theirs, and of those the first;
    `alone_s` has when each would clear alone.
    """
    world = trajectory.world
    journeys, ends_of_agents = world.journeys, ends(world, alone_s)
    failing = gravest(journeys)
    worst = None if failing is None else journeys[failing].outcome
    lost_s = {end.agent: end.lost_s for end in ends_of_agents if end.lost_s is not None}
    most = max(lost_s, key=lost_s.__getitem__, default=None)
    time_s = worst.time_s if worst else max(end.time_s or 0.0 for end in ends_of_agents)
    failure = worst.result if worst else ""
    return Episode(
        condition=course.point.name,
        seed=course.seed,
        episode=trajectory.number,
        layout_seed=world.seed,
        danger=world.layout.danger or "none",
        success=worst is None,
        failure=failure,
        outcome=rating(failure, world.scenario.parameters),
        time_s=time_s,
        partner=worst.partner if worst else None,
        striker=worst.striker if worst else None,
        fault=worst.fault if worst else None,
        least_gap_m=round(min(journey.outcome.least_gap_m for journey in journeys.values()), 3),
        hard_brakings=sum(journey.hard_brakings for journey in journeys.values()),
        other_crashes=world.outcome.other_crashes,
        skipped=course.skipped,
        agents=len(ends_of_agents),
        arrived=len(lost_s),
        met=sum(end.met for end in ends_of_agents),
        agents_lost_s=round(sum(lost_s.values()), 3) if lost_s else None,
        most_lost_s=None if most is None else lost_s[most],
        gave_way=most if most is not None and lost_s[most] > 0 else None,
        journeys=msgspec.json.encode(ends_of_agents).decode(),
        cluster=world.scenario.cluster_of(world.seed),
    )
