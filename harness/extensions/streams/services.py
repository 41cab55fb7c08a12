"""Tell what the ego holds, when it decides, of the CAMs and CPMs that others have sent unasked.

It holds the newest report of each object by each sender, and carries it on at constant speed, with
an error that grows. CAMs stand in the place of the scene's own beacons. Losses are drawn by layout
and link, not by the channel's seed, so that n seeds ask no more questions than one.

    loss      of the condition's channel, on each link, at the time of sending
    delay     from a look to the ego, declared
    size      of the condition's encoding; a CPM's by the number of objects
    errors    of the sender's sensors and of its own pose, which are a beacon's
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from math import cos, hypot, sin
from typing import NamedTuple

import numpy as np
from msgspec import structs

from harness.coordination.encodings import ENCODINGS, JSON
from harness.coordination.streams import Hearing, Sent
from harness.core import noise
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.files import canonical_bytes
from harness.core.strangers import worded
from harness.dataset.load import Scene, by_seat
from harness.extensions.streams.inclusion import LONGEST_S, SHORTEST_S
from harness.extensions.streams.motion import moments
from harness.extensions.streams.sending import (
    CAM,
    CPM,
    ROUNDING_S,
    Look,
    Message,
    Stretch,
    most_looks,
    senders,
    stretch,
    stretches,
)
from harness.radio.channel import Channel, Draws, Physical
from harness.radio.constant import Radio
from harness.radio.fading import NO_SEED, Trips
from harness.radio.wrapped import broadcast, is_ours, label, link_loss
from harness.world.perception.graph import listed_graphs, sectors_in_sight
from harness.world.perception.sensors import Detection
from harness.world.perception.shared import (
    Report,
    Told,
    detection_of,
    itself,
    report,
    state_in_message,
    with_reports,
)
from harness.world.scenario import Scenario
from harness.world.scene_graph import BY_BEACON, SceneGraph, Sector
from harness.world.sight_lines import site
from harness.world.state import VehicleState, WorldState

HEARD = re.compile(
    r"(?!cpm:[^:]*:\Z)"  # of CPMs that are not there no key tells
    r"(?P<kind>cam|cpm):(?P<interval>[0-9]{1,9}(\.[0-9]{1,9})?):"
    r"(?P<looks>([0-9]{1,6}(\.[0-9]{1,6})*)?)"
)
AND = ";"  # in what an ego holds of a sender, between CAMs and CPMs
KEPT_S = 2.0  # age at which the ego drops a report: two of the longest intervals
GROWS_MPS2 = 2.0  # standard deviation of the acceleration that a report does not tell, assumed

SCENES_AT_ONCE = 64  # whose streams are computed together: more need more memory

Sending = tuple[Scene, Stretch]  # a scene, and what was sent up to it since the decision before
Key = tuple[str, Look]  # id of a scene, and the look that a message is of


class Held(NamedTuple):
    """Hold what an ego holds of one sender in a scene, of one kind of messages."""

    scene: Scene  # of the ego that received it
    last: Message  # the newest one
    # of each object the newest CPM, and what it says; nothing of CAMs
    newest: tuple[tuple[Message, Detection], ...]

    @property
    def messages(self) -> list[Message]:
        """Return the messages that this is of; one may be there twice."""
        return [self.last, *(message for message, _ in self.newest)]


@dataclass(frozen=True)
class Services:
    """Hold what vehicles send unasked, and how: a `Stream` (`harness.coordination.streams`)."""

    interval_s: float  # seconds between two looks, and the least between two messages of a kind
    delay_s: float = 0.0  # seconds from a look to the ego's having its message
    channel: Channel | None = None  # radio channel; None where only what was heard is shown
    encoding: str = JSON  # how messages are written, which is their size
    # seconds from any message of a helper to its next, as congestion control has it; 0 without
    between_s: float = 0.0
    kinds: tuple[str, ...] = (CPM,)  # what is sent, `CAM` before `CPM`

    def heard(self, scenario: Scenario, scenes: Sequence[Scene]) -> list[Mapping[str, str]]:
        texts: list[Mapping[str, str]] = []
        for begin in range(0, len(scenes), SCENES_AT_ONCE):
            some = scenes[begin : begin + SCENES_AT_ONCE]
            for scene, messages in zip(some, self.received(scenario, some), strict=True):
                looks: dict[tuple[str, str], set[int]] = {}
                # A CAM that is lost, or none, is in the place of a beacon, too.
                for sender in _beacons(scene) if CAM in self.kinds else ():
                    looks[sender, CAM] = set()
                for sender, kind, look in self._newest(scene, messages):
                    looks.setdefault((sender, kind), set()).add(look)
                of_sender: dict[str, list[str]] = {}
                for sender, kind in sorted(looks):
                    text = self._text(kind, looks[sender, kind])
                    of_sender.setdefault(sender, []).append(text)
                texts.append({sender: AND.join(each) for sender, each in of_sender.items()})
        return texts

    def _text(self, kind: str, looks: set[int]) -> str:
        return f"{kind}:{self.interval_s:g}:{'.'.join(map(str, sorted(looks)))}"

    def _newest(self, scene: Scene, messages: Sequence[Message]) -> set[tuple[str, str, int]]:
        """Return sender, kind and look of the newest message of each object, and of each sender."""
        now_s = scene.state.time_s
        # by sender, kind and object; the object is "" for any
        newest: dict[tuple[str, str, str], int] = {}
        for message in messages:
            sender, number, time_s, kind = message.look
            if now_s - KEPT_S <= time_s <= now_s - self.delay_s + ROUNDING_S:
                for name in ("", *(d.id for d in message.objects)):
                    newest[sender, kind, name] = max(number, newest.get((sender, kind, name), 0))
        return {(sender, kind, number) for (sender, kind, _), number in newest.items()}

    def received(self, scenario: Scenario, scenes: Sequence[Scene]) -> list[list[Message]]:
        """Return what each scene's ego receives, however late, that is young enough to matter."""
        young = [list(_young(scene)) for scene in scenes]
        once = {id(at): at for of_scene in young for at in of_scene}
        received: list[list[Message]] = [[] for _ in scenes]
        for kind in self.kinds:
            of_kind = self._crossed(scenario, list(once.values()), kind)
            crossed = dict(zip(once, of_kind, strict=True))
            for of_scene, messages in zip(young, received, strict=True):
                messages += [message for at in of_scene for message in crossed[id(at)]]
        return received

    def _crossed(
        self, scenario: Scenario, scenes: Sequence[Scene], kind: str
    ) -> list[list[Message]]:
        """Return what of a kind each scene's ego receives since the decision before."""
        sent = list(zip(scenes, stretches(scenario, scenes, self.interval_s, kind), strict=True))
        new = [each for each in sent if self not in each[1].crossed]
        crosses = iter((self._draws(scenario, new) >= self._loss(new)).tolist())
        for _, each in new:
            each.crossed[self] = [message for message in each.messages if next(crosses)]
        return [each.crossed[self] for _, each in sent]

    def _draws(self, scenario: Scenario, sent: Sequence[Sending]) -> Floats:
        """Return the draws, by link and look, that decide which messages are lost, (n,)."""
        most, draws = most_looks(scenario, self.interval_s), []
        for scene, each in sent:
            seed, ego = scene.state.episode_seed, scene.state.ego.id
            for message in each.messages:
                of_link = _uniforms(message.look.kind, seed, message.sender, ego, most)
                draws.append(of_link[message.look.number])
        return np.array(draws)

    def _loss(self, sent: Sequence[Sending]) -> Floats:
        """Return the probability that each message is lost on its way to the ego, (n,)."""
        n = sum(len(each.messages) for _, each in sent)
        if not n:
            return np.zeros(0)
        if not isinstance(self.channel, Physical):
            return np.full(n, _declared_loss(self.channel))
        links: list[tuple[WorldState, Message, WorldState]] = []  # in a scene, and when it was sent
        for scene, each in sent:
            states = moments(scene, [message.look.time_s for message in each.messages])
            links += [(scene.state, *both) for both in zip(each.messages, states, strict=True)]
        sites = site([(state, (now.ego.id, message.sender)) for now, message, state in links])
        places = [_place(now, message.sender) for now, message, _ in links]
        seeds = np.array([now.episode_seed for now, _, _ in links])
        bits = self.bits([message for _, message, _ in links])[:, None]
        # Shadowing goes by a sender's place, that of replies; where others are does not matter.
        xy_m = np.full((n, 2 + max(places), 2), np.nan)
        place, xy_m[:, :1] = np.array(places)[:, None], sites.xy_m[:, :1]
        np.put_along_axis(xy_m, 1 + place[..., None], sites.xy_m[:, 1:], axis=1)
        trips = Trips(np.full(n, NO_SEED), seeds, np.zeros(n, dtype=int), 1)

        def shadow(decorrelation_m: float) -> Floats:
            return np.take_along_axis(trips.shadow(xy_m, decorrelation_m), place, axis=1)

        loss = link_loss(self.channel, sites, shadow, bits)
        return np.broadcast_to(loss, (n, 1))[:, 0]

    def bits(self, messages: Sequence[Message]) -> Floats:
        """Return the size of n messages in bits, in this stream's encoding, (n,)."""
        if self.encoding == JSON:
            return np.array([8.0 * len(_written(message)) for message in messages])
        encoding, headers = ENCODINGS[self.encoding], isinstance(self.channel, Physical)
        objects = np.array([len(message.objects) for message in messages])
        bits = encoding.packet_bits("objects", headers, objects=objects)
        if CAM not in self.kinds:
            return bits
        of_cams = np.array([message.look.kind == CAM for message in messages], dtype=bool)
        return np.where(of_cams, encoding.packet_bits("beacon", headers), bits)

    def sent(self, scenario: Scenario, scenes: Sequence[Scene]) -> Sent:
        messages, places = list[Message](), list[int]()
        for kind in self.kinds:
            of_scenes = stretches(scenario, scenes, self.interval_s, kind)
            for n, (scene, each) in enumerate(zip(scenes, of_scenes, strict=True)):
                if scene.before():
                    helpers = {v.id for v in scene.state.helpers}
                    of_helpers = [m for m in each.messages if m.sender in helpers]
                    messages += of_helpers
                    places += [n] * len(of_helpers)
        bits, place = self.bits(messages), np.array(places, dtype=int)
        sums = []
        for of_each in (np.ones(len(messages)), bits, self._airtime_s(bits)):
            sums.append(np.bincount(place, of_each, len(scenes)).astype(float))
        return Sent(*sums)

    def allowed_s(self, scenario: Scenario, scenes: Sequence[Scene]) -> list[Mapping[str, float]]:
        """Return when each helper may reply, s after each of n scenes, by what it sent last.

        Messages after the scene hold up no reply: which ones are due depends on what is decided.
        """
        if not self.between_s:
            return [{} for _ in scenes]
        by_sender = [dict[str, float]() for _ in scenes]
        for kind in self.kinds:
            of_scenes = stretches(scenario, scenes, self.interval_s, kind)
            for scene, each, waits_s in zip(scenes, of_scenes, by_sender, strict=True):
                for sender, at_s in each.last_s.items():
                    wait_s = at_s + self.between_s - scene.state.time_s
                    waits_s[sender] = max(wait_s, waits_s.get(sender, 0.0))
        return list(by_sender)

    def _airtime_s(self, bits: Floats) -> Floats:
        """Return the time on air of n messages of these sizes, s, (n,); NaN where it is unknown."""
        assert self.channel is not None, "a stream is sent over a channel"
        n = len(bits)
        one = np.zeros(n, dtype=int)
        # no draw changes a time on air
        link, jitter, waits = np.zeros((n, 0, 2)), np.zeros((n, 0)), np.zeros((n, 1))
        draws = Draws(link, jitter, Trips(one, one, one, 1), waits)
        with worded(label(self.channel), built_in=is_ours(self.channel)):
            airtime_s = broadcast(self.channel, bits, draws).airtime_s
        return np.broadcast_to(airtime_s, bits.shape)

    def graphs(self, scenario: Scenario, heard: Sequence[Hearing]) -> list[SceneGraph]:
        of_egos = [_held(scenario, each.source, each.texts) for each in heard]
        of_senders = list(chain(*of_egos))
        states = _states(of_senders)
        sectors = iter(_sectors(scenario, states, of_senders))
        cases = []
        for hearing, of_ego in zip(heard, of_egos, strict=True):
            scene, reports, seen = hearing.scene, [], []
            for held in of_ego:
                sent, in_sight = held, next(sectors)
                change = hearing.changes.get(held.last.sender)
                if change and held.last.look.kind == CPM:
                    sent, in_sight = _changed(scenario, states, held, in_sight, change)
                reports.append(_reports(scenario, states, sent))
                seen.append(in_sight)
            graph = scene.graphs[scene.viewers[0]]
            if any(CAM in text for text in hearing.texts.values()):
                graph = _without_beacons(graph)
            cases.append(Told(scene.state, graph, reports, seen))
        return with_reports(scenario, cases)


def _beacons(scene: Scene) -> list[str]:
    """Return the ids of the vehicles that a scene's ego knows by the scene's own beacons alone."""
    nodes = scene.graphs[scene.viewers[0]].nodes
    return [node.id for node in nodes if node.sensors == BY_BEACON]


def _without_beacons(graph: SceneGraph) -> SceneGraph:
    """Return a graph without who is known by the scene's own beacons alone."""
    nodes = graph.sensed
    names = {node.id for node in nodes}
    conflicts = tuple(conflict for conflict in graph.conflicts if conflict.vehicle in names)
    return structs.replace(graph, nodes=nodes, conflicts=conflicts)


def _declared_loss(channel: Channel | None) -> float:
    """Return the loss of all links of a channel that is not physical."""
    assert isinstance(channel, Radio), "another one is refused where conditions are made"
    with worded(label(channel), built_in=is_ours(channel)):
        loss = float(channel.loss)
        if not 0.0 <= loss <= 1.0:
            raise ValueError(f"a loss of {loss:g}")
    return loss


def _written(message: Message) -> bytes:
    """Return a message as compact JSON."""
    listed = []
    for d in message.objects:
        numbers = [round(d.x_m, 1), round(d.y_m, 1), round(d.speed_mps, 1)]
        listed.append([d.id, d.kind, *numbers, d.indicator])
    return canonical_bytes({"from": message.sender, "objects": listed})


def _sectors(
    scenario: Scenario, states: Mapping[Key, WorldState], held: Sequence[Held]
) -> list[Sequence[Sector]]:
    """Return how much of each direction of danger each sender saw at its last look.

    CAMs do not tell.
    """
    sectors: list[Sequence[Sector]] = [()] * len(held)
    for seat, of_seat in by_seat([each.scene for each in held], scenario).items():
        views, places = [], [n for n in of_seat if held[n].last.look.kind == CPM]
        for n in places:
            last = held[n].last
            views.append((states[_key(held[n].scene, last)], last.sender))
        for n, in_sight in zip(places, sectors_in_sight(seat, views), strict=True):
            sectors[n] = in_sight
    return sectors


def _changed(
    scenario: Scenario,
    states: Mapping[Key, WorldState],
    held: Held,
    sectors: Sequence[Sector],
    change: Callable[[SceneGraph, Scene], SceneGraph],
) -> tuple[Held, Sequence[Sector]]:
    """Return what an ego holds of a sender if each CPM was changed, and the sectors of the last.

    Which CPMs go, and how long they are, is by what the sender sees, whatever it then writes.
    """
    by_look = {message.look.number: message for message in held.messages}
    messages = [by_look[number] for number in sorted(by_look)]
    looks = []
    for message in messages:
        state = states[_key(held.scene, message)]
        looks.append((state, state.vehicle(message.sender)))
    objects, seat = [message.objects for message in messages], held.scene.seat or scenario
    graphs = listed_graphs(seat, looks, objects, [sectors] * len(messages))
    newest: dict[str, tuple[Message, Detection]] = {}
    for message, (state, sender), graph in zip(messages, looks, graphs, strict=True):
        sent = change(graph, held.scene.changed(state=state))
        newest |= {node.id: (message, detection_of(sender, node)) for node in sent.sensed}
        sectors = sent.sectors
    return Held(held.scene, held.last, tuple(newest.values())), sectors


def _held(scenario: Scenario, scene: Scene, texts: Mapping[str, str]) -> list[Held]:
    """Return what an ego holds of each sender, of which `texts` name the looks."""
    held = []
    for sender, text in texts.items():
        for kind, interval_s, looks in heard_of(text):
            messages = []
            for at in _young(scene):
                for message in stretch(scenario, at, interval_s, kind).messages:
                    if message.sender == sender and message.look.number in looks:
                        messages.append(message)
            messages.sort(key=lambda message: message.look.number)
            newest: dict[str, tuple[Message, Detection]] = {}
            for message in messages if kind == CPM else ():
                newest |= {d.id: (message, d) for d in message.objects}
            if messages:
                held.append(Held(scene, messages[-1], tuple(newest.values())))
    return held


def heard_of(text: str) -> list[tuple[str, float, frozenset[int]]]:
    """Return kind of messages, interval, s, and looks, each that the key of an answer names.

    Raises UserError if the text, which may be a stranger's, names none.
    """
    heard = []
    for part in text.split(AND):
        match = HEARD.fullmatch(part)
        interval_s = float(match["interval"]) if match else 0.0
        if not match or not SHORTEST_S <= interval_s <= LONGEST_S:
            raise UserError(f"{printable(text)!r} is no stream")
        looks = frozenset(map(int, filter(None, match["looks"].split("."))))
        heard.append((match["kind"], interval_s, looks))
    return heard


def _young(scene: Scene) -> Iterator[Scene]:
    """Yield a scene and those before it up to which CPMs were sent that are young enough."""
    at: Scene | None = scene
    while at is not None and at.state.time_s > scene.state.time_s - KEPT_S:
        yield at
        at = at.before()


def _place(state: WorldState, sender: str) -> int:
    """Return the index of a sender among all senders of a state, the helpers first."""
    return [v.id for v in senders(state, CAM)].index(sender)


def _key(scene: Scene, message: Message) -> Key:
    return scene.id, message.look


def _states(held: Sequence[Held]) -> dict[Key, WorldState]:
    """Return the state of the world at the look of each message that egos hold."""
    # by the scene up to which a stretch goes: the times that are wanted in it
    times_s: dict[int, tuple[Scene, dict[Key, float]]] = {}
    for each in held:
        for message in each.messages:
            at = each.scene
            while (
                before := at.before()
            ) is not None and before.state.time_s >= message.look.time_s:
                at = before
            _, of_stretch = times_s.setdefault(id(at), (at, {}))
            of_stretch[_key(each.scene, message)] = message.look.time_s
    states: dict[Key, WorldState] = {}
    for at, of_stretch in times_s.values():
        states.update(zip(of_stretch, moments(at, list(of_stretch.values())), strict=True))
    return states


def _reports(scenario: Scenario, states: Mapping[Key, WorldState], held: Held) -> list[Report]:
    """Return what a sender reports of itself, by its last message, and of each object."""
    p, now_s = scenario.parameters, held.scene.state.time_s
    poses: dict[int, tuple[VehicleState, VehicleState]] = {}  # true and stated, by look
    for message in held.messages:
        if message.look.number not in poses:
            state = states[_key(held.scene, message)]
            pose = state_in_message(p, state, message.sender)
            poses[message.look.number] = state.vehicle(message.sender), pose
    last = held.last.look
    reports = [aged(itself(p, poses[last.number][1]), now_s - last.time_s)]
    for message, detection in held.newest:
        true, pose = poses[message.look.number]
        there = report(p, pose, as_stated(detection, true, pose))
        reports.append(aged(there, now_s - message.look.time_s))
    return reports


def as_stated(d: Detection, true: VehicleState, pose: VehicleState) -> Detection:
    """Return an object where its sender puts it, who has it in its own frame.

    The sender is at `true`, and its message says that it is at `pose`, so that errors of its own
    pose move the object, too.
    """
    turn = pose.heading_rad - true.heading_rad
    dx, dy = d.x_m - true.x_m, d.y_m - true.y_m
    return structs.replace(
        d,
        x_m=pose.x_m + dx * cos(turn) - dy * sin(turn),
        y_m=pose.y_m + dx * sin(turn) + dy * cos(turn),
        heading_rad=None if d.heading_rad is None else d.heading_rad + turn,
    )


def aged(earlier: Report, age_s: float) -> Report:
    """Return a report as it is held some seconds later: carried on at constant speed.

    Its object stays where it was seen if its heading is not known. The standard deviation of its
    place grows by that of its speed and of an acceleration that it does not tell.
    """
    d = earlier.detection
    x_m, y_m = d.x_m, d.y_m
    drift_m = hypot(earlier.speed_m2ps2**0.5 * age_s, GROWS_MPS2 * age_s**2 / 2)
    if d.heading_rad is None:
        drift_m = hypot(drift_m, d.speed_mps * age_s)
    else:
        x_m += age_s * d.speed_mps * cos(d.heading_rad)
        y_m += age_s * d.speed_mps * sin(d.heading_rad)
    place_m2 = earlier.place_m2 + np.eye(2) * drift_m**2
    speed_m2ps2 = earlier.speed_m2ps2 + (GROWS_MPS2 * age_s) ** 2
    detection = structs.replace(d, x_m=x_m, y_m=y_m, age_s=age_s)
    return Report(detection, earlier.node, place_m2, speed_m2ps2)


@lru_cache(maxsize=4096)
def _uniforms(kind: str, seed: int, sender: str, receiver: str, n: int) -> Floats:
    return noise.uniforms((n,), kind, seed, sender, receiver)
