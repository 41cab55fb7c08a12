"""Say which scenes of a recording are of one traffic, and what each is for.

A scene is what moves in it, whatever file it is from: `Traffic.content` is its digest. Scenes that
share traffic, such as cuts of one session that overlap, are one session. What a session is for
follows from digests alone, so that no further file moves it: but up to `FEW` are cut by time, and
one more deals all of them anew.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.seeds import FIRST, Purpose
from harness.extensions.roads.scene import Scene, Track

DEALT: Sequence[Purpose] = ("report", "report", "tune", "train")  # by the rest of a digest by 4
FEW = 2  # sessions of a recording that are cut by time, so that each purpose has a part
APART = 2  # horizons between two parts of a scene that is cut by time
SHARED = 50  # scenes with more than one in so many places in common share traffic
MOVES_MPS = 0.5  # who is slower stands
STEPS = np.array([0.1, 0.1, 0.1, 0.5])  # m, m, rad and m/s, to which shared poses are rounded
FINE = 1000  # parts of a metre, a radian, a second and a metre a second that a digest tells apart
ODD = np.array(
    [0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93],
    dtype=np.uint64,
)


class Traffic(NamedTuple):
    """Hold what tells a scene's traffic from that of others."""

    content: str  # hex digest of kinds, sizes, times since its begin, and poses
    span_s: tuple[float, float]  # its begin and end
    places: Ints  # hashes of two who move side by side, each once, about one a second

    @classmethod
    def of(cls, scene: Scene) -> "Traffic":
        """Return the traffic of a scene."""
        span_s = scene.begin_s, scene.end_s
        return cls(_content(scene), span_s, _places(scene))


def _content(scene: Scene) -> str:
    """Return the digest of a scene's tracks, in no order and without their ids."""
    begin_s = scene.begin_s
    whole = hashlib.sha256()
    for digest in sorted(digest_of(track, begin_s) for track in scene.tracks.values()):
        whole.update(digest)
    return whole.hexdigest()


def digest_of(track: Track, begin_s: float) -> bytes:
    """Return the digest of a track's kind, size, times since one, and poses."""
    poses = _turned(track.poses)
    numbers = [track.length_m, track.width_m, *(track.time_s - begin_s), *poses.flat]
    fine = np.round(np.array(numbers) * FINE).astype("<i8")
    return hashlib.sha256(f"{track.kind} {len(poses)} ".encode() + fine.tobytes()).digest()


def _turned(poses: Floats) -> Floats:
    """Return poses (n, 4) with headings from 0 up to a turn, rounded so that a turn is none."""
    turned = np.array(poses)
    turn = round(2 * np.pi, 3)
    turned[:, 2] = np.round(turned[:, 2] % (2 * np.pi), 3) % turn
    return turned


def _places(scene: Scene) -> Ints:
    """Return hashes of the poses of two who move at one time, next to each other from west to east.

    One who moves alone says little: in simulated traffic many drive through one place.
    """
    movers = [track for track in scene.tracks.values() if not track.still]
    if not movers:
        return np.empty(0, dtype=np.int64)
    poses = np.concatenate([track.poses for track in movers])
    times = np.concatenate([track.time_s for track in movers])
    moves = np.abs(poses[:, 3]) > MOVES_MPS
    poses, frames = poses[moves], np.round(times[moves] * FINE).astype(np.int64)
    order = np.lexsort((poses[:, 1], poses[:, 0], frames))
    poses, frames = poses[order], frames[order]
    one: Ints = np.zeros(len(poses), dtype=np.uint64)
    for column, step, odd in zip(_turned(poses).T, STEPS, ODD, strict=True):
        one = one + np.round(column / step).astype(np.int64).astype(np.uint64) * odd
    one = _mixed(one)
    both = _mixed(one[:-1] * ODD[0] + one[1:])[frames[:-1] == frames[1:]]
    every = max(1, round(1 / scene.step_s))  # which are taken says their hash, and no clock
    return np.unique(both[both % np.uint64(every) == 0].view(np.int64))


def _mixed(values: Ints) -> Ints:
    """Return numbers (n,) whose bits all depend on all bits of others."""
    mixed = (values ^ (values >> np.uint64(31))) * ODD[1]
    return np.asarray(mixed ^ (mixed >> np.uint64(29)))


@dataclass(frozen=True)
class Sessions:
    """Hold the traffic of a recording's scenes, and the session of each."""

    traffic: Mapping[str, Traffic]  # by the name of the scene
    session: Mapping[str, str]  # of each scene: the least content of the scenes in it
    first: Mapping[str, str]  # of each scene: the first by name of those that are the same
    contents: Mapping[str, int]  # of each session: how many scenes it has that are not the same

    @classmethod
    def of(cls, traffic: Mapping[str, Traffic]) -> "Sessions":
        """Return the sessions of some scenes."""
        by_content = {traffic[name].content: name for name in sorted(traffic, reverse=True)}
        contents = sorted(by_content)
        places = [traffic[by_content[content]].places for content in contents]
        firsts = [contents[first] for first in _firsts(places)]
        session_of = dict(zip(contents, firsts, strict=True))
        session = {name: session_of[each.content] for name, each in traffic.items()}
        first = {name: by_content[each.content] for name, each in traffic.items()}
        return cls(traffic, session, first, Counter(firsts))

    @property
    def shared(self) -> int:
        """Return how many scenes share traffic with another that is not the same."""
        return sum(n for n in self.contents.values() if n > 1)

    def contents_of(self, scene: str) -> list[str]:
        """Return the contents of the session of a scene, that of the session first."""
        names = [name for name, each in self.session.items() if each == self.session[scene]]
        return sorted({self.traffic[name].content for name in names})

    def purpose(self, scene: str, time_s: float, horizon_s: float) -> str | None:
        """Return what a moment of a scene is for; None in a gap between two purposes."""
        session = self.session[scene]
        if len(self.contents) <= FEW and self.contents[session] == 1:
            return part_of(time_s, self.traffic[scene].span_s, horizon_s)
        return dealt(session)


def _firsts(places: Sequence[Ints]) -> Iterable[int]:
    """Return for each of n scenes the first that it shares traffic with, itself or by others."""
    firsts = list(range(len(places)))
    for (one, other), common in sorted(_common(places).items()):
        if common * SHARED > min(len(places[one]), len(places[other])):
            first, second = sorted((firsts[one], firsts[other]))
            firsts = [first if each == second else each for each in firsts]
    return firsts


def _common(places: Sequence[Ints]) -> Counter[tuple[int, int]]:
    """Return how many places two of n scenes have in common, where they have one."""
    common = Counter[tuple[int, int]]()
    scenes_of: dict[int, list[int]] = {}
    for scene, each in enumerate(places):
        for place in each.tolist():
            scenes = scenes_of.setdefault(place, [])
            common.update((earlier, scene) for earlier in scenes)
            scenes.append(scene)
    return common


def dealt(session: str) -> Purpose:
    """Return what a session that is not cut is for, by its digest: half of all are for report."""
    return DEALT[int(session[:8], 16) % len(DEALT)]


def part_of(time_s: float, span_s: tuple[float, float], horizon_s: float) -> str | None:
    """Return the purpose of a moment of a scene that is cut by time; None between two parts.

    `span_s` is the scene's begin and end. Parts are of one length, and `APART` horizons lie between
    the last moment of one and the first of the next, since an episode may take longer than the
    horizon. A scene too short for that is for reports alone.
    """
    begin_s, end_s = span_s
    gap_s = APART * horizon_s
    # no moment is later than a horizon before the end
    length_s = (end_s - begin_s - horizon_s - (len(FIRST) - 1) * gap_s) / len(FIRST)
    if length_s <= 0:
        return list(FIRST)[-1]
    place = int((time_s - begin_s) // (length_s + gap_s))
    within_s = time_s - begin_s - place * (length_s + gap_s)
    is_in = 0 <= place < len(FIRST) and within_s < length_s
    return list(FIRST)[place] if is_in else None
