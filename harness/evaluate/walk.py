"""The one loop over decision points: observe the world, get intents, coordinate under every condition, act.

There are three kinds of world: frozen scenes, the closed loop, and the calibrated proxy of the paper's study.
They differ only in where their moments come from and where an action leads. A moment is one decision point.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from harness.coordination.claims import Claims
from harness.coordination.coordinate import Coordination, Fusion, FusionCall, TieDraws, fuse
from harness.coordination.exchange import Exchange, exchange, needed
from harness.coordination.intents import Intents
from harness.coordination.operating_point import AS_SENT, OperatingPoint, Rewrites
from harness.coordination.scheduling import Outlook
from harness.core import noise
from harness.core.arrays import Bools, Floats, Ints, any_of
from harness.dataset.load import Scene
from harness.evaluate.attackers import Attackers, Said
from harness.evaluate.claims import claims
from harness.evaluate.fusion import codes_of
from harness.evaluate.outlook import outlook
from harness.radio.channel import Draws, Site, Unit
from harness.radio.fading import Trips
from harness.runs.decisions import Decisions, Labels, by_action, by_message
from harness.world.scenario import Scenario
from harness.world.sight_lines import site

Moment = TypeVar("Moment")
AskedMoment = TypeVar("AskedMoment", contravariant=True)


@dataclass(frozen=True)
class Due:
    """The decisions that are due now under one condition."""

    at: Ints  # the moment of each decision, as an index into the moments that the world shows, (n,)
    episode: Ints  # the episode's number of each, (n,)
    seed: Ints  # the seed of the channel's draws for each, (n,)
    draws: Draws  # those draws, (n, ...)

    @property
    def episodes(self) -> list[tuple[int, int]]:
        """Number and seed of each decision's episode."""
        return list(zip(self.episode.tolist(), self.seed.tolist(), strict=True))


@dataclass(frozen=True)
class Decided(Generic[Moment]):
    """Decisions made under one condition."""

    point: OperatingPoint  # the condition
    moments: Sequence[Moment]  # the moments that the world showed
    due: Due  # the decisions that were due
    result: Coordination  # what was decided, (n, ...)
    said: Said  # what vehicles said to the channel, as the attacks leave it


class World(Protocol[Moment]):
    """Where decision points come from, and where actions lead."""

    def observe(self) -> Sequence[Moment]:
        """Return each distinct moment in which some episode decides now; none if all episodes are decided."""
        ...

    def due(self, point: OperatingPoint) -> Due:
        """Return the decisions of a condition that are due in the moments just shown."""
        ...

    def site(self, units: Collection[Unit]) -> Site | None:
        """Return where vehicles and units are in the moments just shown, (n, ...); None without places."""
        ...

    def outlook(self) -> Outlook | None:
        """Return what egos see in the moments just shown, (n, ...); None in a world without places."""
        ...

    def claims(self) -> Claims | None:
        """Return what helpers claim in the moments just shown, (n, ...); None in a world without places."""
        ...

    def step(self, decided: Sequence[Decided[Moment]]) -> None:
        """Act on the decisions, one `Decided` a condition, and advance to the next moments."""
        ...


class Placed:
    """A world whose moments are scenes."""

    scenario: Scenario  # the scenario of the scenes
    scenes: Sequence[Scene]  # the scenes just shown

    def site(self, units: Collection[Unit]) -> Site:
        """Return where the vehicles of each scene and these roadside units are."""
        moments = [(scene.state, scene.viewers) for scene in self.scenes]
        return site(moments, units, self.scenario.road().zone_m)

    def outlook(self) -> Outlook:
        """Return what the ego of each scene sees."""
        return outlook(self.scenario.road(), self.scenes)

    def claims(self) -> Claims:
        """Return what the helpers of each scene claim about themselves."""
        return claims(self.scenario, self.scenes)


class Fuses(Protocol):
    """The answered fusion calls of some moments."""

    def __call__(self, moments: Ints, attackers: Bools | None = None, /) -> FusionCall:
        """Return the call for decisions at moments (n,), with the attackers (n, H) if messages show them."""
        ...


class Ask(Protocol[AskedMoment]):
    """The source of intents: it asks the agents."""

    def __call__(self, moments: Sequence[AskedMoment]) -> Intents:
        """Return what every vehicle intends in these moments, (n, ...); helpers may be `unasked`."""
        ...

    def blind(self, moments: Sequence[AskedMoment], at: Ints) -> Intents:
        """Return the same where helpers are shown nothing, (n, ...); only the moments `at` need values."""
        ...

    def helpers(self, moments: Sequence[AskedMoment], wanted: Bools, blind: bool = False) -> Intents:
        """Ask the helpers wanted, (n, H), and return the intents of the moments where any is wanted."""
        ...

    def fusion_call(self, moments: Sequence[AskedMoment], codes: Ints, rewrites: Rewrites = AS_SENT) -> Fuses:
        """Return the ego's answers to these sets of messages (`codes_of`), rewritten as `rewrites` says."""
        ...


def walk(
    world: World[Moment], points: Sequence[OperatingPoint], ask: Ask[Moment], ties: str
) -> Iterator[Sequence[Decided[Moment]]]:
    """Walk a world under some conditions until every episode is decided; yield the decisions of each step.

    Of actions that are equally likely, `ties` takes the `first`, or one that is `drawn`.
    """
    memories = {point: Memory() for point in points}
    attackers = {point: Attackers(point) for point in points}
    physical = {point for point in points if point.physical}
    while moments := world.observe():
        intents = ask(moments)
        due = {point: each for point in points if len((each := world.due(point)).at)}
        if not physical.isdisjoint(due):
            intents = replace(intents, site=world.site({point.unit for point in due if point.unit}))
        if any(point.needs("outlook") for point in due):
            intents = replace(intents, outlook=world.outlook())
        if any(point.needs("claims") for point in due):
            intents = replace(intents, claims=world.claims())
        asked_blind = [each.at for point, each in due.items() if point.blind_helpers]
        blind = ask.blind(moments, np.unique(np.concatenate(asked_blind))) if asked_blind else None
        intents, blind = _asked(ask, moments, due, intents, blind)
        broadcasts = {
            point: attackers[point].said(
                heard(point, intents, blind, each),
                each.draws,
                each.episodes if point.guard.attack else (),
            )
            for point, each in due.items()
        }
        sent = {point: exchange(point, each.intents, each.draws) for point, each in broadcasts.items()}
        calls = _fusion_calls(due, broadcasts, sent, moments, ask)
        decided = []
        for point, due_here in due.items():
            broadcast = broadcasts[point]
            call = (
                calls[point.rewrites](due_here.at, shown(point, broadcast)) if point.has_fusion_call else None
            )
            fusion = Fusion(call, memories[point].recall(due_here), tie_draws(due_here.draws, ties))
            result = fuse(point, sent[point], broadcast.intents, fusion)
            decided.append(Decided(point, moments, due_here, result, broadcast))
        for part in decided:
            memories[part.point].keep(part.due, part.result.state)
        yield decided
        world.step(decided)


def _asked(
    ask: Ask[Moment], moments: Sequence[Moment], due: Mapping[OperatingPoint, Due], intents: Intents,
    blind: Intents | None,
) -> tuple[Intents, Intents | None]:  # fmt: skip
    """Ask the helpers whose answers some condition uses, and return the intents, sighted and blind.

    An answer may fail, and another helper is asked in its place; so this may take several turns.
    """
    while True:
        wanted = {each: np.zeros(intents.range_m.shape, dtype=bool) for each in (False, True)}
        for point, due_here in due.items():
            here = heard(point, intents, blind, due_here)
            if here.unasked is not None and here.unasked.any():
                decision, helper = np.nonzero(here.unasked & needed(point, here, due_here.draws))
                moment = due_here.at[_sources(point, due_here)[decision]]
                wanted[point.blind_helpers][moment, helper] = True
        if not (wanted[False].any() or wanted[True].any()):
            return intents, blind
        if wanted[False].any():
            at = np.flatnonzero(wanted[False].any(axis=1))
            intents = intents.replaced(at, ask.helpers(moments, wanted[False]))
        if wanted[True].any():
            assert blind is not None
            at = np.flatnonzero(wanted[True].any(axis=1))
            blind = blind.replaced(at, ask.helpers(moments, wanted[True], blind=True))


def heard(point: OperatingPoint, intents: Intents, blind: Intents | None, due: Due) -> Intents:
    """Return the intents that each decision works with; a control replaces those of the helpers.

    With `messages=blind` they are the intents of helpers that are shown nothing. With `messages=shuffled`
    they come from another layout: the next one in which the same seed has a decision at this step. If there
    is none, the ego hears nobody. Who is asked, the distances and the times stay the same.
    """
    every = np.array_equal(due.at, np.arange(len(intents.own)))
    own = intents if every else intents.take(due.at)
    if point.blind_helpers:
        assert blind is not None
        source = blind.take(due.at)
        return _with_helpers(own, source, source.valid)
    if point.ask.messages != "shuffled":
        return own
    places = _sources(point, due)
    source, alone = own.take(places), places == np.arange(len(places))
    return _with_helpers(own, source, source.valid & ~alone[:, None])


def _with_helpers(own: Intents, source: Intents, valid: Bools) -> Intents:
    return replace(
        own, helpers=source.helpers, valid=valid, payload_bits=source.payload_bits, unasked=source.unasked
    )


def _sources(point: OperatingPoint, due: Due) -> Ints:
    """Return the decision whose helpers each decision hears, (n,): its own, but where they are shuffled."""
    if point.ask.messages != "shuffled":
        return np.arange(len(due.at))
    order = np.lexsort((due.episode, due.seed))
    following = np.roll(order, -1)
    starts = np.flatnonzero(np.diff(due.seed[order], prepend=due.seed[order[0]] - 1))
    following[np.roll(starts, -1) - 1] = order[starts]  # the last of a seed hears its first
    sources = np.empty_like(order)
    sources[order] = following
    return sources


class Memory:
    """What a condition's consensus rule remembers of each episode and seed."""

    def __init__(self) -> None:
        self._state: dict[tuple[int, int], Floats] = {}

    def recall(self, due: Due) -> Floats | None:
        """Return the state of each decision's episode, (n, K); None at the first step."""
        return np.array([self._state[place] for place in due.episodes]) if self._state else None

    def keep(self, due: Due, state: Floats) -> None:
        """Store the state for the next step, (n, K), if the rule has one."""
        if state.shape[-1]:
            self._state |= dict(zip(due.episodes, state, strict=True))


def _fusion_calls(
    due: Mapping[OperatingPoint, Due], broadcasts: Mapping[OperatingPoint, Said],
    sent: Mapping[OperatingPoint, Exchange], moments: Sequence[Moment], ask: Ask[Moment],
) -> dict[Rewrites, Fuses]:  # fmt: skip
    """Make one fusion call for each set of messages that any condition hears, and return them by rewrites.

    This can happen before any decision, since who is heard does not depend on the fusion.
    """
    calls = {}
    for rewrites in dict.fromkeys(point.rewrites for point in due if point.has_fusion_call):
        alike = {point: due_here for point, due_here in due.items() if point.rewrites == rewrites}
        calls[rewrites] = ask.fusion_call(moments, heard_codes(alike, broadcasts, sent), rewrites)
    return calls


def heard_codes(
    due: Mapping[OperatingPoint, Due], broadcasts: Mapping[OperatingPoint, Said],
    sent: Mapping[OperatingPoint, Exchange],
) -> Ints:  # fmt: skip
    """Return the sets of messages that the conditions with fusion calls hear (`codes_of`), ascending."""
    codes = [np.empty(0, dtype=int)]
    for point, due_here in due.items():
        if point.has_fusion_call:
            on_time = sent[point].on_time
            codes.append(codes_of(on_time, due_here.at, shown(point, broadcasts[point]))[on_time.any(axis=1)])
    return np.unique(np.concatenate(codes))


def shown(point: OperatingPoint, broadcast: Said) -> Bools | None:
    """Return who attacks, (n, H), if the text of a fusion call depends on it; else None."""
    return broadcast.attackers if point.rewrites.attack else None


@lru_cache(maxsize=1 << 16)
def _channel_uniforms(seed: int, layout_seed: int, steps: int, helpers: int) -> NDArray[np.float64]:
    return noise.uniforms((2 + steps, helpers), "channel", seed, layout_seed)


def channel_draws(seed: Ints, layout_seed: Ints, step: Ints, steps: int, helpers: int) -> Draws:
    """Return the channel's draws for decisions (n,).

    A link is up or down for a whole episode; jitter is drawn for each decision. The key is the seed and the
    episode's layout, so every condition, prompt and model has the same draws, frozen and in the closed loop.
    """
    seeds, seed_index = np.unique(seed, return_inverse=True)
    layouts, layout_index = np.unique(layout_seed, return_inverse=True)
    # One number for each pair: `np.unique` of rows takes several times as long.
    pairs, pair_of_decision = np.unique(seed_index * len(layouts) + layout_index, return_inverse=True)
    pair_index = np.divmod(pairs, max(len(layouts), 1))
    keys = zip(seeds[pair_index[0]].tolist(), layouts[pair_index[1]].tolist(), strict=True)
    uniforms = np.array([_channel_uniforms(s, layout, steps, helpers) for s, layout in keys])
    uniforms = uniforms.reshape(len(pairs), 2 + steps, helpers)
    trips = Trips(seed, layout_seed, step, steps)
    return Draws(
        uniforms[pair_of_decision, :2].transpose(0, 2, 1), uniforms[pair_of_decision, 2 + step], trips
    )


@lru_cache(maxsize=1 << 16)
def _tie_uniforms(seed: int, layout_seed: int, steps: int) -> NDArray[np.float64]:
    return noise.uniforms((steps,), "ties", seed, layout_seed)


def tie_draws(draws: Draws, ties: str) -> TieDraws | None:
    """Return what decides ties in decisions (n,): None where the `first` action is taken.

    The key is the seed, the episode's layout and the step, as in `channel_draws`.
    """
    trips = draws.trips
    if ties == "first" or trips is None:
        return None

    def drawn(tied: Bools) -> Floats:
        keys = (key[tied].tolist() for key in (trips.seed, trips.layout_seed, trips.step))
        return np.array(
            [_tie_uniforms(seed, layout, trips.steps)[step] for seed, layout, step in zip(*keys, strict=True)]
        )

    return drawn


@lru_cache(maxsize=1 << 10)
def busy_ratio(point: OperatingPoint) -> float:
    """Return the channel busy ratio under the background load; NaN if the channel has no such figure."""
    return point.physical.busy_ratio() if point.physical else float("nan")


def columns(decided: Decided[Any]) -> dict[str, Any]:
    """Return the numeric columns of decisions (n,) by name; NaN where unknown."""
    c, point = decided.result, decided.point
    anybody = any_of(c.on_time)
    return {
        "messages": c.messages, "requests": c.requests, "request_bits": c.request_bits,
        "reply_bits": c.reply_bits, "airtime_ms": c.airtime_s * 1000, "triggered": c.triggered,
        "busy_ratio": np.full(c.messages.shape, busy_ratio(point)),
        "own_failed": c.own_failed,
        "entropy_nats": c.entropy_nats, "normalised_entropy": c.normalised_entropy,
        "own_weight": c.weights[..., 0], "latency_ms": c.latency_s * 1000,
        "deadline_missed": np.where(np.isnan(c.latency_s), np.nan, c.deadline_missed),
        "fusion_ms": c.fusion_s * 1000,
        "fusion_failed": np.where(anybody & point.has_fusion_call, c.fusion_failed, np.nan),
        "effective_loss": np.where(c.triggered, c.loss, np.nan), "observed_loss": c.observed_loss,
    }  # fmt: skip


def table(decided: Sequence[Decided[Scene]], more: Mapping[str, Any], actions: Sequence[str]) -> Decisions:
    """Return the table of decisions, sorted by episode, step, moment, condition and seed.

    The decisions may be in any order; further columns (n,), `more`, are in that order.
    """
    moments_by_id = {id(part.moments): part.moments for part in decided}
    starts = np.cumsum([0, *map(len, moments_by_id.values())]).tolist()
    start = dict(zip(moments_by_id, starts, strict=False))
    scenes = [scene for moments in moments_by_id.values() for scene in moments]
    vehicles = max(len(scene.viewers) for scene in scenes) - 1
    helpers = max(vehicles, *(part.said.attackers.shape[1] for part in decided))
    at = np.concatenate([start[id(part.moments)] + part.due.at for part in decided])
    n_each = [len(part.due.at) for part in decided]
    points = list(dict.fromkeys(part.point.name for part in decided))
    point = np.repeat([points.index(part.point.name) for part in decided], n_each)

    def of_scenes(values: Iterable[Any]) -> Any:
        return np.array(list(values))[at]

    def widened(arrays: Iterable[Any]) -> Any:
        return np.concatenate([np.pad(array, ((0, 0), (0, helpers - array.shape[1]))) for array in arrays])

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
    voices = [f"voice-{n + 1}" for n in range(helpers - vehicles)]  # an attacker may have several voices
    senders = [
        [*scene.viewers[1:], *[None] * (vehicles + 1 - len(scene.viewers)), *voices] for scene in scenes
    ]
    episode, step = (of_scenes(getattr(s.record, name) for s in scenes) for name in ("episode", "step"))
    ids = [scene.id for scene in scenes]
    rank = np.unique(ids, return_inverse=True)[1]
    order = np.lexsort((point, rank[at], step, episode))
    values = {
        **{name: np.concatenate([part[name] for part in numbers]) for name in numbers[0]},
        **by_action("fused", np.concatenate([part.result.fused for part in decided]), actions),
        **more,
        **{
            column: array
            for name, messages in sent.items()
            for column, array in by_message(name, np.where(asked, messages, np.nan)).items()
        },
        "seed": np.concatenate([part.due.seed for part in decided]), "episode": episode, "step": step,
    }  # fmt: skip
    labels = {
        "scene": _labels(ids, at),
        "danger": _labels([s.record.danger.sector for s in scenes], at),
        "condition": Labels(point, points),
        "action": Labels(np.concatenate([part.result.action for part in decided]), actions),
        **{f"helper_{h + 1}": _labels([row[h] for row in senders], at, asked[:, h]) for h in range(helpers)},
    }
    return Decisions.of({**values, **labels}, actions, helpers).take(order)


def of_all_seeds(tables: Sequence[Decisions], points: Sequence[OperatingPoint]) -> Decisions:
    """Return tables of the same episodes and of different seeds, in their order, as `table` makes one."""
    if len(tables) == 1:
        return tables[0]
    whole = Decisions.concat(tables)
    ids = sorted(set().union(*(part.scenes for part in tables)))
    condition = whole.codes("condition", [point.name for point in points])
    order = np.lexsort((condition, whole.codes("scene", ids), whole.whole("step"), whole.whole("episode")))
    return whole.take(order)


def _labels(of_scenes: Sequence[str | None], at: Ints, mask: Any = True) -> Labels:
    names = list(dict.fromkeys(label for label in of_scenes if label is not None))
    code: dict[str | None, int] = {None: -1, **{name: place for place, name in enumerate(names)}}
    return Labels(np.where(mask, np.array([code[label] for label in of_scenes])[at], -1), names)
