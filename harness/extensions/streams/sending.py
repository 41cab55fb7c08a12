"""Say which messages vehicles send unasked between two decisions, and what is in them.

    CPM   A helper looks around every interval, and sends what the standard's rules pick
          (`inclusion.py`).
    CAM   A helper, and any vehicle whose beacons others hear, looks at itself, and sends its pose
          when the rules of beacons say so (`harness.world.beacons`).

Looks begin LEAD_S before the start. Their phase is drawn by layout and sender.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import chain
from math import floor, inf
from typing import Any, NamedTuple
from weakref import ref

from harness.core import noise
from harness.core.errors import UserError, printable
from harness.dataset.load import Scene
from harness.extensions.streams.inclusion import LONGEST_S, Sighting, due
from harness.extensions.streams.motion import moments
from harness.world.beacons import due_cam
from harness.world.perception.rays import surfaces
from harness.world.perception.sensors import Detection, reports
from harness.world.scenario import Scenario
from harness.world.scene_graph import BY_BEACON
from harness.world.state import Beacon, VehicleState, WorldState

CAM, CPM = "cam", "cpm"  # kinds of messages
LEAD_S = 2.0  # how long streams run before an episode starts
AT_ONCE = 64  # looks whose rays fit into the processor's cache
SCENES_KEPT = 2048  # whose CPMs stay in memory, some 10 kB each
ROUNDING_S = 1e-9


class Look(NamedTuple):
    """Name one look of a helper around itself, or of a vehicle at itself."""

    sender: str  # id of the vehicle
    number: int  # of the look, from 0, LEAD_S before the start
    time_s: float  # from the start of the episode
    kind: str = CPM  # or `CAM`: for which kind of message it is


class Message(NamedTuple):
    """Hold one message: the look that it is of, and the objects in it; a CAM's is its sender."""

    look: Look
    objects: tuple[Detection, ...]

    @property
    def sender(self) -> str:
        """Return the id of the vehicle that sends it."""
        return self.look.sender


class Stretch(NamedTuple):
    """Hold what is sent between two decisions, and what the next stretch goes on from."""

    messages: tuple[Message, ...]  # by time
    # what each object was when its sender last included it, by sender and object
    included: Mapping[str, Mapping[str, Sighting]]
    last_s: Mapping[str, float]  # when each sender sent last
    cams: Mapping[str, Beacon]  # each sender's last CAM, as it was when sent; none in one of CPMs
    crossed: dict[Any, list[Message]]  # what of it the ego receives, by stream, once computed


Pair = tuple[Scene, Scene | None]  # a decision point, and the one before it
NOTHING = Stretch((), {}, {}, {}, {})
# scenes with a note of their stretch, the oldest first; a driven one lives as long as its episode
_kept: deque[tuple[ref[Scene], str]] = deque()


def stretch(scenario: Scenario, scene: Scene, interval_s: float, kind: str = CPM) -> Stretch:
    """Return what vehicles send from the decision before to a scene, as `stretches` does."""
    [sent] = stretches(scenario, [scene], interval_s, kind)
    return sent


def stretches(
    scenario: Scenario, scenes: Sequence[Scene], interval_s: float, kind: str = CPM
) -> list[Stretch]:
    """Return what vehicles send from the decision before to each scene, computed once.

    `interval_s` is the time between two looks, s, and `kind` the kind of messages. At the first
    decision of a course it is what they send from LEAD_S before on.
    """
    note = f"{kind}:{interval_s:g}"
    generations = [_lacking(scenario, note, scenes)]
    while generations[-1]:
        earlier = [before for _, before in generations[-1]]
        generations.append(_lacking(scenario, note, earlier))
    for generation in reversed(generations):
        new = [each for each in generation if note not in each[0].notes]
        of_new = _new(scenario, new, note, interval_s, kind)
        for (scene, _), sent in zip(new, of_new, strict=True):
            scene.notes[note] = sent
            _kept.append((ref(scene), note))
    of_scenes = [scene.notes[note] for scene in scenes]
    while len(_kept) > SCENES_KEPT:
        kept, oldest_note = _kept.popleft()
        oldest = kept()
        if oldest is not None:
            del oldest.notes[oldest_note]
    return of_scenes


def _lacking(scenario: Scenario, note: str, scenes: Iterable[Scene | None]) -> list[Pair]:
    """Return the scenes that lack a note, each once and with the one before it."""
    lacking: dict[int, Scene] = {}
    for scene in scenes:
        if scene is not None and note not in scene.notes:
            lacking[id(scene)] = scene
    return [(scene, _checked(scenario, scene, scene.before())) for scene in lacking.values()]


def _checked(scenario: Scenario, scene: Scene, before: Scene | None) -> Scene | None:
    """Return the scene before another, of which a stranger's dataset may say anything.

    Raises UserError unless both are of one ego, at times that follow each other in an episode.
    """
    now_s, last_s = scene.state.time_s, scenario.parameters.time_limit_s
    since_s = 0.0 if before is None else before.state.time_s
    if not 0.0 <= since_s <= now_s <= last_s or (before and since_s == now_s):
        raise UserError(
            f"scene {printable(scene.id)} is {now_s:g} s after its episode's start, and the one "
            f"before it {since_s:g} s, of {last_s:g} s at most; build the dataset again"
        )
    if before and before.state.ego.id != scene.state.ego.id:
        raise UserError(
            f"scene {printable(scene.id)} has another ego than the one before it "
            f"({printable(before.id)}); build the dataset again"
        )
    return before


def most_looks(scenario: Scenario, interval_s: float) -> int:
    """Return an upper bound of a vehicle's looks in an episode, `interval_s` apart."""
    return floor((LEAD_S + scenario.parameters.time_limit_s) / interval_s) + 2


def _new(
    scenario: Scenario, pairs: Sequence[Pair], note: str, interval_s: float, kind: str
) -> list[Stretch]:
    """Return the stretch up to each scene; that up to the one before is noted there."""
    looks: list[list[Look]] = []
    states: list[WorldState] = []
    for scene, before in pairs:
        looks.append(_looks(scene, before, interval_s, kind))
        states += moments(scene, [look.time_s for look in looks[-1]])
    views = []
    for look, state in zip(chain.from_iterable(looks), states, strict=True):
        views.append((state, state.vehicle(look.sender)))
    at, new = 0, []
    detections = _detections(scenario, views) if kind == CPM else []
    for (_, before), of_scene in zip(pairs, looks, strict=True):
        earlier: Stretch = NOTHING if before is None else before.notes[note]
        here = slice(at, at + len(of_scene))
        at = here.stop
        if kind == CPM:
            new.append(_cpms(earlier, list(zip(of_scene, detections[here], strict=True))))
        else:
            themselves = [sender for _, sender in views[here]]
            new.append(_cams(earlier, list(zip(of_scene, themselves, strict=True))))
    return new


def _cams(earlier: Stretch, seen: Sequence[tuple[Look, VehicleState]]) -> Stretch:
    """Return the CAMs after an earlier stretch, of what each sender is at each look."""
    cams, messages = dict(earlier.cams), list[Message]()
    for look, v in seen:
        pose = v.x_m, v.y_m, v.heading_rad, v.speed_mps
        now = Beacon(v.id, look.time_s, look.time_s, *pose, None, ())
        if cam := due_cam(now, pose, cams.get(v.id)):
            cams[v.id] = cam
            itself = Detection(v.id, BY_BEACON, v.kind, None, *pose, None)
            messages.append(Message(look, (itself,)))
    last_s = {name: cam.time_s for name, cam in cams.items()}
    return Stretch(tuple(messages), {}, last_s, cams, {})


def _cpms(earlier: Stretch, seen: Sequence[tuple[Look, Sequence[Detection]]]) -> Stretch:
    """Return the CPMs after an earlier stretch, of what is seen at each look."""
    included = {sender: dict(objects) for sender, objects in earlier.included.items()}
    last_s, messages = dict(earlier.last_s), list[Message]()
    for look, detections in seen:
        sightings = {d.id: _sighting(d, look.time_s) for d in detections}
        before = included.get(look.sender, {})
        names = due(sightings, before)
        # Who is out of sight is new when it is seen again.
        now = {name: before[name] for name in sightings if name in before}
        now |= {name: sightings[name] for name in names}
        included[look.sender] = now
        if names or look.time_s - last_s.get(look.sender, -inf) >= LONGEST_S - ROUNDING_S:
            last_s[look.sender] = look.time_s
            messages.append(Message(look, tuple(d for d in detections if d.id in names)))
    return Stretch(tuple(messages), included, last_s, {}, {})


def senders(state: WorldState, kind: str) -> list[VehicleState]:
    """Return who sends messages of a kind: helpers, and CAMs all whose beacons others hear, too.

    Helpers are first, in the order of `WorldState.helpers`.
    """
    others = [v for v in state.vehicles if v.radio and v.part == "other"]
    return [*state.helpers, *(others if kind == CAM else [])]


def _looks(scene: Scene, before: Scene | None, interval_s: float, kind: str) -> list[Look]:
    """Return the senders' looks up to a scene since the one before it, by time.

    One that was not there yet has no known way to the scene, and does not look.
    """
    there, since_s = senders(scene.state, kind), scene.state.time_s - LEAD_S
    if before is not None:
        ids, since_s = {v.id for v in before.state.vehicles}, before.state.time_s
        there = [v for v in there if v.id in ids]
    looks = []
    for sender in there:
        begin_s = phase(scene.state.episode_seed, sender.id, kind) * interval_s - LEAD_S
        first = max(floor((since_s - begin_s) / interval_s + ROUNDING_S) + 1, 0)
        last = floor((scene.state.time_s - begin_s) / interval_s + ROUNDING_S)
        for number in range(first, last + 1):
            looks.append(Look(sender.id, number, begin_s + number * interval_s, kind))
    return sorted(looks, key=lambda look: look.time_s)


def _detections(
    scenario: Scenario, views: Sequence[tuple[WorldState, VehicleState]]
) -> list[list[Detection]]:
    """Return what each helper's sensors report at its look, given the world's state and itself."""
    detections: list[list[Detection]] = [[] for _ in views]
    for begin in range(0, len(views), AT_ONCE):
        some = views[begin : begin + AT_ONCE]
        reported = reports(some, surfaces(some), scenario.parameters)
        for (n, _), detection in reported.items():
            detections[begin + n].append(detection)
    return detections


def _sighting(d: Detection, time_s: float) -> Sighting:
    heading_rad = 0.0 if d.heading_rad is None else d.heading_rad
    return Sighting(time_s, d.x_m, d.y_m, d.speed_mps, heading_rad, d.kind or "vehicle")


@lru_cache(maxsize=4096)
def phase(seed: int, sender: str, kind: str = CPM) -> float:
    """Return the share of an interval by which a vehicle's looks are late, 0 to 1.

    It is drawn by the layout's `seed`, the vehicle's id, `sender`, and the kind of messages.
    """
    return float(noise.generator(kind, seed, sender).random())
