"""Hold what a recording states against its tables: nothing that can be computed is taken."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from harness.core.errors import UserError, printable
from harness.core.files import bytes_of, sha256_bytes
from harness.core.resources import folder
from harness.dataset.load import released
from harness.extensions.environments.place import AFTER
from harness.extensions.roads.moments import conflicts_at
from harness.extensions.roads.scene import EARLY_S, SLACK_M, Scene
from harness.extensions.roads.sessions import Sessions, Traffic
from harness.extensions.roads.tables import FACTS, FORMER, Facts, Moment, Recording

EVERY = 10  # rows of a track from one speed to the next that counts


@dataclass
class Speeds:
    """Collect how fast motor vehicles of scenes drive."""

    speeds_mps: list[float] = field(default_factory=list)

    def add(self, scene: Scene) -> None:
        for track in scene.tracks.values():
            if not track.still and track.kind not in ("bicycle", "pedestrian"):
                self.speeds_mps += track.poses[::EVERY, 3].tolist()

    def targets_mps(self) -> tuple[float, float, float]:
        """Return the ego's target speeds: none, half and all of what 95 % of poses stay below."""
        fast = [speed for speed in self.speeds_mps if speed > 1]
        top = max(2.0, float(np.round(np.percentile(fast, 95)))) if fast else 10.0
        return 0.0, top / 2, top


def horizon_s(facts: Facts) -> float:
    """Return the time that an episode of a recording needs, s."""
    return (facts.decisions + AFTER) * facts.period_s


class _Computed(NamedTuple):
    """Hold what a recording's tables give."""

    sessions: Sessions
    speeds_mps: tuple[float, ...]
    problem: str | None  # what the first moment that cannot be lacks


@lru_cache(maxsize=16)
def _computed(recording: Recording) -> _Computed:
    """Read all tables of a recording, scene by scene."""
    speeds, traffic = Speeds(), dict[str, Traffic]()
    by_scene: dict[str, list[Moment]] = {}
    for moment in recording.moments:
        by_scene.setdefault(moment.scene, []).append(moment)
    problems: list[str] = []
    for scene in recording.scenes():
        traffic[scene.name] = Traffic.of(scene)
        speeds.add(scene)
        possible_moments: list[Moment] = []
        for moment in by_scene.get(scene.name, ()):
            of_moment = list(_problems(scene, moment, recording.facts))
            problems += of_moment
            if not of_moment:
                possible_moments.append(moment)
        if possible_moments:
            problems += _other_conflicts(scene, possible_moments, recording.facts)
    return _Computed(Sessions.of(traffic), speeds.targets_mps(), next(iter(problems), None))


def sessions_of(recording: Recording) -> Sessions:
    """Return the sessions of a recording, all of whose tables are read once."""
    return _computed(recording).sessions


def hold(recording: Recording) -> None:
    """Raise UserError where a recording states what its tables do not give.

    Such are target speeds, purposes of moments, moments of somebody who is not there so long, and
    those of a scene that is another one again; and who is hidden at a moment, and when both meet.
    Moments that were drawn by what it states of its files are those of released recordings alone.
    """
    if recording.is_former and recording.digest not in _released():
        raise UserError(
            f"recording {printable(recording.folder / FACTS)} has the format {FORMER}, whose draw "
            "of moments went by what it states of its files; import these again: "
            "`harness dataset import`"
        )
    computed, until_s = _computed(recording), horizon_s(recording.facts)
    problem = computed.problem
    if recording.speeds_mps != computed.speeds_mps:
        texts = ", ".join(f"{speed:g}" for speed in computed.speeds_mps)
        problem = problem or f"other speeds_mps than its tables give: {texts}"
    chosen_s = recording.choice.get("horizon_s", until_s)
    if chosen_s != until_s:
        decisions = recording.facts.decisions
        problem = problem or f"decisions {decisions}, and moments of another number of them"
    for moment in recording.moments:
        purpose = computed.sessions.purpose(moment.scene, moment.time_s, until_s)
        first = computed.sessions.first[moment.scene]
        if first != moment.scene:
            problem = problem or f"{_which(moment)}; that scene is {printable(first, 60)} again"
        if moment.purpose != purpose and problem is None:
            given = "none" if purpose is None else purpose
            problem = f"{_which(moment)} for {moment.purpose}; its tables give {given}"
    if problem is not None:
        raise UserError(
            f"recording {printable(recording.folder / FACTS)} states {problem}; make the recording "
            "again: `harness dataset import`"
        )


@lru_cache(maxsize=1)
def _released() -> frozenset[str]:
    """Return the digests of the recordings that released datasets have."""
    digests = set[str]()
    for name, pin in released().items():
        path = folder("datasets") / name / "manifest.json"
        data = bytes_of(path, "record") if (path.parent / FACTS).is_file() else b""
        if sha256_bytes(data) == pin:
            digests.add(json.loads(data)["files"][FACTS])
    return frozenset(digests)


def _problems(scene: Scene, moment: Moment, facts: Facts) -> Iterator[str]:
    track, until_s = scene.tracks.get(moment.vehicle), moment.time_s + horizon_s(facts)
    if track is None:
        yield f"{_which(moment)}, and nobody there is called so"
        return
    if not track.begin_s - EARLY_S <= moment.time_s <= until_s <= track.end_s + EARLY_S:
        there = f"{track.begin_s:g} to {track.end_s:g} s"
        yield f"{_which(moment)} and until {until_s:g} s; that vehicle is there {there}"
    if moment.hidden is not None:
        other = scene.tracks.get(moment.hidden)
        here = track.at(moment.time_s)
        there_then = None if other is None else other.at(moment.time_s)
        if other is track or here is None or there_then is None:
            yield f"{_which(moment)}; its hidden road user is not there then"
        elif np.hypot(*(here - there_then)[:2]) > facts.window_m + SLACK_M:
            yield f"{_which(moment)}; its hidden road user is beyond {facts.window_m:g} m"


def _other_conflicts(scene: Scene, moments: Sequence[Moment], facts: Facts) -> Iterator[str]:
    """Yield what moments whose vehicles are there state of a conflict that the tables do not."""
    conflicts = conflicts_at(scene, moments, facts.window_m, horizon_s(facts))
    for moment, conflict in zip(moments, conflicts, strict=True):
        claim = moment.hidden, moment.conflict_s
        if claim != conflict:
            given = _conflict_text(*conflict)
            yield f"{_which(moment)} with {_conflict_text(*claim)}; its tables give {given}"


def _conflict_text(hidden: str | None, conflict_s: float | None) -> str:
    if hidden is None:
        return "nobody hidden in conflict"
    return f"{printable(hidden, 60)} hidden and in conflict after {conflict_s:g} s"


def _which(moment: Moment) -> str:
    vehicle = printable(moment.vehicle, 60)
    return f"a moment of {printable(moment.scene, 60)}, {vehicle} at {moment.time_s:g} s"
