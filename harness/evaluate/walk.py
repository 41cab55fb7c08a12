"""The one loop: observe the world, get intents, coordinate under every condition and seed, act.

Frozen scenes, the closed loop and the calibrated proxy of the paper's study are worlds. They differ in where
their moments come from and in where an action leads, and in nothing else. A moment is one decision point.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from harness.coordination.claims import Claims
from harness.coordination.coordinate import Coordination, Fusion, FusionCall, fuse
from harness.coordination.exchange import Exchange, exchange
from harness.coordination.intents import Intents
from harness.coordination.operating_point import AS_SENT, OperatingPoint, Rewrites
from harness.coordination.scheduling import Outlook
from harness.core import noise
from harness.core.arrays import Bools, Floats, Ints
from harness.dataset.load import Scene
from harness.evaluate.attackers import Attackers, Said
from harness.evaluate.claims import claims
from harness.evaluate.fusion import codes_of
from harness.evaluate.outlook import outlook
from harness.radio.channel import Draws, Physical, Site, Unit
from harness.radio.fading import Trips
from harness.runs.decisions import Decisions, Labels, by_action, by_message
from harness.world.scenario import Scenario
from harness.world.sight_lines import site

Moment = TypeVar("Moment")
AskedMoment = TypeVar("AskedMoment", contravariant=True)


@dataclass(frozen=True)
class Due:
    """Decisions that are to be made now under one condition.

    Attributes:
        at: the moment of each, a position among those the world shows, (n,).
        episode: number of the episode of each, (n,).
        seed: seed of the channel's draws of each, (n,).
        draws: those draws, (n, ...).
    """

    at: Ints
    episode: Ints
    seed: Ints
    draws: Draws

    @property
    def episodes(self) -> list[tuple[int, int]]:
        """Number and seed of each."""
        return list(zip(self.episode.tolist(), self.seed.tolist(), strict=True))


@dataclass(frozen=True)
class Decided(Generic[Moment]):
    """Decisions made under one condition.

    Attributes:
        point: the condition.
        moments: those the world showed.
        due: what was to be decided.
        result: what was, (n, ...).
        said: what reached the channel for it.
    """

    point: OperatingPoint
    moments: Sequence[Moment]
    due: Due
    result: Coordination
    said: Said


class World(Protocol[Moment]):
    """Where decision points come from, and where actions lead."""

    def observe(self) -> Sequence[Moment]:
        """Every distinct moment in which some episode is to decide now; none if all episodes are decided."""
        ...

    def due(self, point: OperatingPoint) -> Due:
        """The decisions of a condition that are due in the moments just shown."""
        ...

    def site(self, units: Collection[Unit]) -> Site | None:
        """Where vehicles and units are in the moments just shown, (n, ...); None without places."""
        ...

    def outlook(self) -> Outlook | None:
        """What egos see in the moments just shown, (n, ...); None in a world without places."""
        ...

    def claims(self) -> Claims | None:
        """What helpers say of themselves in the moments just shown, (n, ...); None as above."""
        ...

    def step(self, decided: Sequence[Decided[Moment]]) -> None:
        """Act on the decisions, one `Decided` a condition, and advance to the next moments."""
        ...


class Placed:
    """A world whose moments are scenes.

    Attributes:
        scenario: of the scenes.
        scenes: those just shown.
    """

    scenario: Scenario
    scenes: Sequence[Scene]

    def site(self, units: Collection[Unit]) -> Site:
        """Where the vehicles of each scene are, and these units."""
        moments = [(scene.state, scene.viewers) for scene in self.scenes]
        return site(moments, units, self.scenario.road().zone_m)

    def outlook(self) -> Outlook:
        """What the ego of each scene sees."""
        return outlook(self.scenario.road(), self.scenes)

    def claims(self) -> Claims:
        """What the helpers of each scene say of themselves."""
        return claims(self.scenario, self.scenes)


class Fuses(Protocol):
    """Fusion calls that have been answered."""

    def __call__(self, moments: Ints, attackers: Bools | None = None, /) -> FusionCall:
        """The call of decisions at moments (n,), with the attackers (n, H) if messages show them."""
        ...


class Ask(Protocol[AskedMoment]):
    """Where intents come from."""

    def __call__(self, moments: Sequence[AskedMoment]) -> Intents:
        """What every vehicle intends in these moments, (n, ...)."""
        ...

    def blind(self, moments: Sequence[AskedMoment], at: Ints) -> Intents:
        """The same where helpers are shown nothing, (n, ...); it has to be known at these places alone."""
        ...

    def fusion_call(self, moments: Sequence[AskedMoment], codes: Ints, rewrites: Rewrites = AS_SENT) -> Fuses:
        """The ego's answers to these sets of messages (`codes_of`), shown so."""
        ...


def walk(
    world: World[Moment], points: Sequence[OperatingPoint], ask: Ask[Moment]
) -> Iterator[Sequence[Decided[Moment]]]:
    """Walk a world under some conditions until every episode is decided; yields each step's decisions."""
    memories: dict[str, Memory] = {point.name: Memory() for point in points}
    attackers = {point.name: Attackers(point) for point in points}
    while moments := world.observe():
        intents = ask(moments)
        due = {point: each for point in points if len((each := world.due(point)).at)}
        if any(isinstance(point.channel, Physical) for point in due):
            intents = replace(intents, site=world.site({point.unit for point in due if point.unit}))
        if any(point.needs("outlook") for point in due):
            intents = replace(intents, outlook=world.outlook())
        if any(point.needs("claims") for point in due):
            intents = replace(intents, claims=world.claims())
        places = [each.at for point, each in due.items() if point.asks_blind]
        blind = ask.blind(moments, np.unique(np.concatenate(places))) if places else None
        said = {
            point: attackers[point.name].said(heard(point, intents, blind, each), each.draws, each.episodes)
            for point, each in due.items()
        }
        sent = {point: exchange(point, of.intents, of.draws) for point, of in said.items()}
        calls = _fusion_calls(due, said, sent, moments, ask)
        decided = []
        for point, each in due.items():
            of = said[point]
            call = calls[point.rewrites](each.at, shown(point, of)) if point.asks_again else None
            fusion = Fusion(call, memories[point.name].recall(each))
            result = fuse(point, sent[point], of.intents, fusion)
            decided.append(Decided(point, moments, each, result, of))
        for part in decided:
            memories[part.point.name].keep(part.due, part.result.state)
        yield decided
        world.step(decided)


def heard(point: OperatingPoint, intents: Intents, blind: Intents | None, due: Due) -> Intents:
    """What the vehicles of each decision intend; in a control, its helpers say something else.

    `blind`, what they say who are shown nothing. `shuffled`, what those of another layout do: the next layout
    in which the same seed has a decision at this step; an ego without one hears nobody. Who is asked, how far
    it is and how long it takes stay.
    """
    own = intents.take(due.at)
    if point.asks_blind:
        assert blind is not None
        said = blind.take(due.at)
        return replace(own, helpers=said.helpers, valid=said.valid, payload_bits=said.payload_bits)
    if point.messages != "shuffled":
        return own
    order = np.lexsort((due.episode, due.seed))
    following = np.roll(order, -1)
    starts = np.flatnonzero(np.diff(due.seed[order], prepend=due.seed[order[0]] - 1))
    following[np.roll(starts, -1) - 1] = order[starts]  # the last of a seed hears its first
    other = np.empty_like(order)
    other[order] = following
    said, alone = own.take(other), other == np.arange(len(other))
    valid = said.valid & ~alone[:, None]
    return replace(own, helpers=said.helpers, valid=valid, payload_bits=said.payload_bits)


class Memory:
    """What a condition's consensus rule remembers of each episode and seed."""

    def __init__(self) -> None:
        self._state: dict[tuple[int, int], Floats] = {}

    def recall(self, due: Due) -> Floats | None:
        """The state of each decision's episode, (n, K); None at the first step."""
        return np.array([self._state[place] for place in due.episodes]) if self._state else None

    def keep(self, due: Due, state: Floats) -> None:
        """The state for the next step, (n, K), if the rule has any."""
        if state.shape[-1]:
            self._state |= dict(zip(due.episodes, state, strict=True))


def _fusion_calls(
    due: Mapping[OperatingPoint, Due], said: Mapping[OperatingPoint, Said],
    sent: Mapping[OperatingPoint, Exchange], moments: Sequence[Moment], ask: Ask[Moment],
) -> dict[Rewrites, Fuses]:  # fmt: skip
    """One fusion call for each set of messages that any condition hears; who is heard depends on none."""
    calls = {}
    for rewrites in dict.fromkeys(point.rewrites for point in due if point.asks_again):
        alike = {point: each for point, each in due.items() if point.rewrites == rewrites}
        calls[rewrites] = ask.fusion_call(moments, heard_codes(alike, said, sent), rewrites)
    return calls


def heard_codes(
    due: Mapping[OperatingPoint, Due], said: Mapping[OperatingPoint, Said],
    sent: Mapping[OperatingPoint, Exchange],
) -> Ints:  # fmt: skip
    """The sets of messages that the conditions with fusion calls hear (`codes_of`), ascending."""
    codes = [np.empty(0, dtype=int)]
    for point, each in due.items():
        if point.asks_again:
            on_time = sent[point].on_time
            codes.append(codes_of(on_time, each.at, shown(point, said[point]))[on_time.any(axis=1)])
    return np.unique(np.concatenate(codes))


def shown(point: OperatingPoint, said: Said) -> Bools | None:
    """Who attacks, (n, H), where a fusion call shows it; else None."""
    return said.attackers if point.rewrites.attack else None


@lru_cache(maxsize=1 << 16)
def _channel(seed: int, layout_seed: int, steps: int, helpers: int) -> NDArray[np.float64]:
    return noise.uniforms((2 + steps, helpers), "channel", seed, layout_seed)


def channel_draws(seed: Ints, layout_seed: Ints, step: Ints, steps: int, helpers: int) -> Draws:
    """The channel's draws of decisions (n,): a link is up or down for an episode, jitter is a decision's own.

    The key is the seed and the episode's layout, so every condition, prompt and model, frozen and in the
    closed loop, has the same.
    """
    seeds, of_seed = np.unique(seed, return_inverse=True)
    layouts, of_layout = np.unique(layout_seed, return_inverse=True)
    # By a number each: rows take several times as long to tell apart.
    pairs, place = np.unique(of_seed * len(layouts) + of_layout, return_inverse=True)
    which = np.divmod(pairs, max(len(layouts), 1))
    drawn = zip(seeds[which[0]].tolist(), layouts[which[1]].tolist(), strict=True)
    of_pairs = np.array([_channel(s, layout, steps, helpers) for s, layout in drawn])
    of_pairs = of_pairs.reshape(len(pairs), 2 + steps, helpers)
    trips = Trips(seed, layout_seed, step, steps)
    return Draws(of_pairs[place, :2].transpose(0, 2, 1), of_pairs[place, 2 + step], trips)


@lru_cache(maxsize=64)
def busy_ratio(point: OperatingPoint) -> float:
    """Channel busy ratio under the background load; NaN where the channel does not know."""
    channel = point.channel
    return channel.busy_ratio() if isinstance(channel, Physical) else float("nan")


def columns(decided: Decided[Any]) -> dict[str, Any]:
    """Numbers of decisions (n,) by name, NaN where unknown."""
    c, point = decided.result, decided.point
    anybody = c.on_time.any(axis=-1)
    return {
        "messages": c.messages, "requests": c.requests, "request_bits": c.request_bits,
        "reply_bits": c.reply_bits, "airtime_ms": c.airtime_s * 1000, "triggered": c.triggered,
        "busy_ratio": np.full(c.messages.shape, busy_ratio(point)),
        "own_failed": c.own_failed,
        "entropy_nats": c.entropy_nats, "normalised_entropy": c.normalised_entropy,
        "own_weight": c.weights[..., 0], "latency_ms": c.latency_s * 1000,
        "deadline_missed": np.where(np.isnan(c.latency_s), np.nan, c.deadline_missed),
        "fusion_ms": c.fusion_s * 1000,
        "fusion_failed": np.where(anybody & point.asks_again, c.fusion_failed, np.nan),
        "effective_loss": np.where(c.triggered, c.loss, np.nan), "observed_loss": c.observed_loss,
    }  # fmt: skip


def table(decided: Sequence[Decided[Scene]], more: Mapping[str, Any], actions: Sequence[str]) -> Decisions:
    """The table of decisions, in the order of episode, step, moment, condition and seed.

    Args:
        decided: in any order.
        more: further columns (n,), in the order of `decided`.
        actions: meta-actions.
    """
    first = {id(part.moments): part.moments for part in decided}
    starts = np.cumsum([0, *map(len, first.values())]).tolist()
    start = dict(zip(first, starts, strict=False))
    scenes = [scene for moments in first.values() for scene in moments]
    places = max(len(scene.viewers) for scene in scenes) - 1
    helpers = max(places, *(part.said.attackers.shape[1] for part in decided))
    at = np.concatenate([start[id(part.moments)] + part.due.at for part in decided])
    n_each = [len(part.due.at) for part in decided]
    points = list(dict.fromkeys(part.point.name for part in decided))
    point = np.repeat([points.index(part.point.name) for part in decided], n_each)

    def of_scenes(values: Iterable[Any]) -> Any:
        return np.array(list(values))[at]

    def widened(arrays: Iterable[Any]) -> Any:
        return np.concatenate([np.pad(each, ((0, 0), (0, helpers - each.shape[1]))) for each in arrays])

    def of_messages(name: str) -> Any:
        return widened(getattr(part.result, name) for part in decided)

    numbers = [columns(part) for part in decided]
    asked, arrival_s = of_messages("asked"), of_messages("arrival_s")
    sent = {
        "delivered": of_messages("delivered"), "on_time": of_messages("on_time"),
        "arrival_ms": np.where(np.isfinite(arrival_s), arrival_s * 1000, np.nan),
        "weight": widened([part.result.weights[:, 1:] for part in decided]),
        "trust": of_messages("trust"), "attacker": widened([part.said.attackers for part in decided]),
    }  # fmt: skip
    voices = [f"voice-{n + 1}" for n in range(helpers - places)]  # of a helper that has several
    senders = [[*scene.viewers[1:], *[None] * (places + 1 - len(scene.viewers)), *voices] for scene in scenes]
    episode, step = (of_scenes(scene.record[name] for scene in scenes) for name in ("episode", "step"))
    ids = [scene.id for scene in scenes]
    rank = np.unique(ids, return_inverse=True)[1]
    order = np.lexsort((point, rank[at], step, episode))
    values = {
        **{name: np.concatenate([each[name] for each in numbers]) for name in numbers[0]},
        **by_action("fused", np.concatenate([part.result.fused for part in decided]), actions),
        **more,
        **{
            column: array
            for name, each in sent.items()
            for column, array in by_message(name, np.where(asked, each, np.nan)).items()
        },
        "seed": np.concatenate([part.due.seed for part in decided]), "episode": episode, "step": step,
    }  # fmt: skip
    labels = {
        "scene": _labels(ids, at), "danger": _labels([s.record["danger"]["sector"] for s in scenes], at),
        "condition": Labels(point, points),
        "action": Labels(np.concatenate([part.result.action for part in decided]), actions),
        **{
            f"helper_{h + 1}": _labels([row[h] for row in senders], at, asked[:, h]) for h in range(helpers)
        },
    }  # fmt: skip
    return Decisions.of({**values, **labels}, actions, helpers).take(order)


def _labels(of_scenes: Sequence[str | None], at: Ints, there: Any = True) -> Labels:
    names = list(dict.fromkeys(label for label in of_scenes if label is not None))
    code: dict[str | None, int] = {None: -1, **{name: place for place, name in enumerate(names)}}
    return Labels(np.where(there, np.array([code[label] for label in of_scenes])[at], -1), names)
