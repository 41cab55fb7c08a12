"""Find the lies that do most harm: play every course that they can lead to.

At a decision a lie matters by the action that it brings about. So a search keeps, of each episode
and channel seed, the decision points that lies can lead to, step by step, until one of these
actions gives away what the lies are to end: the episode's success, or that harm can be avoided.
What liars know is all: every answer, the rule, its memory, and where each action leads.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from harness.coordination.coordinate import (
    Coordination,
    FusionInputs,
    TieDraws,
    fuse,
    likeliest,
)
from harness.coordination.exchange import Exchange, exchange
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.plans import Plans
from harness.coordination.robust import Heads
from harness.coordination.rules import RULES
from harness.coordination.trust import trusting_only
from harness.core.arrays import Bools, Floats, Ints, any_of, taken
from harness.dataset.load import Dataset, Scene
from harness.evaluate.draws import tie_draws
from harness.evaluate.fusion import codes_of
from harness.evaluate.helper_numbers import Helpers
from harness.evaluate.walk import Ask, Decided, Due, SceneWorld
from harness.extensions.trust import lies
from harness.extensions.trust.attacks import Turn, attacks_of
from harness.radio.channel import Draws

TRUST = "trust"  # the rule with memory whose lies are looked for
AT_ONCE = 2048  # decisions that are fused at once, few enough for a processor's caches
STATES = 3  # most memories of a rule that are followed at one decision point
# From what vehicles intend and the draws, of n decisions, to which of H helpers lie, `(n, H)`.
Liars = Callable[[Intents, Draws], Bools]


@dataclass(frozen=True)
class Search:
    """Describe whose lies are looked for, under which condition, and what they are to end.

    A condition, `point`, is the settings of radio, asking and fusion, without an attack.
    """

    point: OperatingPoint  # the condition; each search has one of a name of its own
    liars: Liars  # which helpers lie
    # which actions keep what the lies are to end, such as that the episode can succeed, `(N, A)`,
    # at N decision points with A actions
    keeps: Bools
    # what liars claim of who and where they are, in the whole episode: attacks; empty for the truth
    claims: str = ""
    # whether to look for all that the rule `trust` could be brought to do if liars could choose
    # whom it trusts, but for honest helpers that it trusts without them: a bound, not a lie
    bounds: bool = False


class Front(NamedTuple):
    """Hold the decisions of one step to which lies can lead, n of them."""

    seed: Ints  # index of each one's channel seed, `(n,)`
    tree: Ints  # index of its layout's tree, `(n,)`
    at: Ints  # number of its decision point in the forest, `(n,)`
    state: Floats | None  # the rule's memory before each, `(n, K)`; None at the first step


class Play(NamedTuple):
    """Hold what comes of a lie in some decisions of a front, k of them."""

    rows: Ints  # their rows in the front, `(k,)`
    action: Ints  # what the ego then does, `(k,)`
    state: Floats  # the rule's memory after it, `(k, K)`
    trust: Floats  # how far the rule trusts liars after it, summed over them, `(k,)`


class Courses(SceneWorld):
    """Play all courses of recorded scenes that lies can lead to, for several searches at once.

    It is a world as `walk` takes it, in which each decision leads to several others.

    Attributes:
        lost: which episodes some lie ends badly, by the name of a search's condition, a mask of
            seeds and layouts, `(S, T)`.
        unsearchable: names of searches whose rule remembers what only its package knows, of which
            nothing is said.
    """

    def __init__(
        self,
        dataset: Dataset,
        searches: Sequence[Search],
        seeds: Sequence[int],
        ties: str,
        ask: Ask[Scene],
    ) -> None:
        """Begin at the first decision of each layout.

        Args:
            dataset: the recorded scenes.
            searches: what is looked for.
            seeds: the channel's seeds.
            ties: which of equally likely actions is taken: the `first`, or one that is `drawn`.
            ask: asks the ego's model again with lies, where conditions do so.
        """
        self.scenario, self._dataset, self._forest = dataset.scenario, dataset, dataset.forest
        self._seeds, self._ties, self._ask = np.array(seeds), ties, ask
        self._searches = {search.point: search for search in searches}
        self._at_stake = {search.point: self._decides(search.keeps) for search in searches}
        shape = len(seeds), len(self._forest.root)
        seed, tree = (index.ravel() for index in np.indices(shape))
        start = Front(seed, tree, self._forest.root[tree], None)
        self._fronts = dict.fromkeys(self._searches, start)
        self._helpers = Helpers()
        self.lost = {point.name: np.zeros(shape, dtype=bool) for point in self._searches}
        self.unsearchable: set[str] = set()

    def _decides(self, keeps: Bools) -> Bools:
        """Return where some later action gives away what `keeps` is about, `(N,)`."""
        forest, ends = self._forest, ~keeps
        for rows in forest.levels_backwards():
            child = forest.child[rows]
            ends[rows] |= (child >= 0) & ends[child].any(axis=-1)
        return np.asarray(ends.any(axis=-1))

    def observe(self) -> Sequence[Scene]:
        places = [front.at for front in self._fronts.values()]
        self._shown = np.unique(np.concatenate(places))
        self.scenes = self._dataset.scenes([self._forest.ids[n] for n in self._shown.tolist()])
        self._numbers = self._helpers.numbers(self.scenes)
        return self.scenes

    def due(self, point: OperatingPoint) -> Due:
        front, forest = self._fronts[point], self._forest
        seed, decisions = self._seeds[front.seed], self.scenario.parameters.decisions
        at = np.searchsorted(self._shown, front.at)
        keys = seed, forest.seeds[front.tree], forest.step[front.at], decisions
        return Due(at, forest.episodes[front.tree], seed, self._numbers.draws(at, *keys))

    def plans(self) -> Plans | None:
        return None

    def step(self, decided: Sequence[Decided[Scene]]) -> None:
        fronts = {part.point: self._after(part) for part in decided}
        self._fronts = {point: fronts.get(point, _NOTHING) for point in self._searches}

    def _after(self, part: Decided[Scene]) -> Front:
        """Return where lies lead from the decisions of a step; note the episodes that they end."""
        search, front, forest = self._searches[part.point], self._fronts[part.point], self._forest
        lost, gives_away = self.lost[part.point.name], ~search.keeps[front.at]
        reached = np.zeros(gives_away.shape, dtype=bool)
        plays = []
        if part.point.has_fusion_call:
            every_play = _asked_plays(search, part, front, self._ties, self._ask)
        else:
            every_play = _plays(search, part, front, self._ties, reached, gives_away)
        for play in every_play:
            reached[play.rows, play.action] = True
            plays.append(play)
        ended = (reached & gives_away).any(axis=1)
        lost[front.seed[ended], front.tree[ended]] = True
        rows, action, state, trust = map(np.concatenate, zip(*plays, strict=True))
        if state.shape[1] and part.point.fusion.consensus != TRUST:
            self.unsearchable.add(part.point.name)
            return _NOTHING
        at = forest.child[front.at[rows], action]
        after = Front(front.seed[rows], front.tree[rows], at, state)
        is_open = (at >= 0) & self._at_stake[part.point][at] & ~lost[after.seed, after.tree]
        return _most_trusted(after, np.flatnonzero(is_open), trust)


_NOBODY = np.empty(0, dtype=int)
_NOTHING = Front(_NOBODY, _NOBODY, _NOBODY, None)


def _most_trusted(front: Front, rows: Ints, trust: Floats) -> Front:
    """Return rows of a front: of each seed and decision point those in which trust is highest.

    They are at most `STATES`, of different trust; one where a rule has no memory.
    """
    trust = np.round(trust, 3)
    order = rows[np.lexsort([-trust[rows], front.at[rows], front.seed[rows]])]
    keys = np.stack([front.seed[order], front.at[order], trust[order]])
    differs = keys[:, 1:] != keys[:, :-1]
    order = order[np.insert(differs.any(axis=0), 0, True)[: len(order)]]
    place = np.stack([front.seed[order], front.at[order]])
    is_first = np.insert((place[:, 1:] != place[:, :-1]).any(axis=0), 0, True)[: len(order)]
    count = np.arange(len(order))
    nth = count - np.maximum.accumulate(np.where(is_first, count, 0))
    kept = order[nth < STATES]
    assert front.state is not None
    return Front(front.seed[kept], front.tree[kept], front.at[kept], front.state[kept])


def _plays(
    search: Search,
    part: Decided[Scene],
    front: Front,
    ties: str,
    reached: Bools,
    gives_away: Bools,
) -> Iterator[Play]:
    """Yield what comes of each lie; `reached`, `(n, A)`, is kept up to date by who takes them."""
    truth, draws, point = part.said.intents, part.due.draws, part.point
    drawn_ties = tie_draws(draws, ties)
    intents, liars, draws = with_claims(search.claims, truth, search.liars(truth, draws), draws)
    heard = exchange(point, intents, draws)
    every = _Decisions(point, heard, intents, liars, front.state)
    kinds = every.kinds(front.at, drawn_ties)
    decisions = every.take(kinds.first)
    if search.bounds:
        yield from map(kinds.spread, _bounds(decisions))
        return
    honest = decisions.fused()
    yield kinds.spread(honest)
    yield kinds.spread(decisions.silent().fused())
    actions = truth.own.shape[-1]
    places = np.arange(len(kinds.first))
    yield from map(kinds.spread, decisions.each(lies.certain(actions), places))
    if lies.is_certainty_enough(point):
        return
    if honest.state.shape[-1]:  # a rule with memory
        others = truth.helpers[kinds.first]
        voices = np.concatenate([decisions.heard.own[:, None], others], axis=1)
        yield from map(kinds.spread, decisions.each(lies.near_others(voices), places))
        return
    lies_heard = any_of(decisions.heard.on_time & decisions.liars)
    is_of_heads = isinstance(RULES[point.fusion.consensus], Heads)
    if is_of_heads and lies.is_likeliest_taken(point):
        lies_heard &= ~_agreed(decisions)
    remaining = lies.lattice(actions)
    while len(remaining):
        # further actions matter only in episodes that are not lost yet
        is_open = ~any_of(reached & gives_away) & any_of(~reached)
        places = kinds.of_some(is_open)
        places = places[lies_heard[places]]
        if not len(places):
            return
        count = max(1, AT_ONCE // len(places))
        yield from map(kinds.spread, decisions.each(remaining[:count], places))
        remaining = remaining[count:]


def _asked_plays(
    search: Search, part: Decided[Scene], front: Front, ties: str, ask: Ask[Scene]
) -> Iterator[Play]:
    """Yield what the ego's model answers to each of a set of messages of liars, and to none."""
    truth, draws, at = part.said.intents, part.due.draws, part.due.at
    liars, drawn_ties = search.liars(truth, draws), tie_draws(draws, ties)
    rows, nobody = np.arange(len(at)), np.zeros_like(liars)
    for attack, silent in (
        ("", nobody),
        ("", liars),
        *product(lies.messages_to_ask(part.point), [nobody]),
    ):
        point = part.point.changed(attack=attack)
        sent, _, _ = with_claims(attack, truth, liars, draws)
        heard = exchange(point, sent, draws)
        heard = replace(heard, on_time=heard.on_time & ~silent)
        attackers = liars if point.rewrites.changes.of_attackers else None
        codes = codes_of(heard.on_time, at, attackers)[heard.on_time.any(axis=1)]
        fuses = ask.fusion_call(part.decision_points, np.unique(codes), point.rewrites)
        inputs = FusionInputs(fuses(at, attackers), front.state, drawn_ties)
        result = fuse(point, heard, sent, inputs)
        yield Play(rows, result.action, result.state, np.zeros(len(at)))


def _agreed(decisions: "_Decisions") -> Bools:
    """Return where a rule that counts heads lets no liar change a decision, `(n,)`.

    There is one liar, and all others, the ego among them and at least two, want one action.
    """
    heard, liars = decisions.heard, decisions.liars
    honest = heard.on_time & ~liars
    choice = np.argmax(np.nan_to_num(decisions.intents.helpers), axis=-1)
    differs = (choice != np.argmax(heard.own, axis=-1)[:, None]) & honest
    one_liar = np.sum(heard.on_time & liars, axis=1) == 1
    return np.asarray(one_liar & honest.any(axis=1) & ~differs.any(axis=1))


def _bounds(decisions: "_Decisions") -> Iterator["_Fused"]:
    """Yield what `trust` does with each set of helpers to trust, and each message of liars.

    Another's message can only speak for an honest helper, as long as liars claim nothing false. So
    whom the rule trusts that hears no liar, it trusts. Its memory is that of not hearing them.
    """
    alone = decisions.silent().coordinated()
    n, helpers, actions = decisions.intents.helpers.shape
    every_sent = [decisions]
    every_sent += [decisions.saying(message) for message in lies.certain(actions)]
    for trusts in product((False, True), repeat=helpers):
        trusted = (np.nan_to_num(alone.trust) >= 0.5) | np.array(trusts)
        state = trusting_only(trusted, actions)
        for sent in every_sent:
            policy = replace(sent, state=state).coordinated().fused
            yield _Fused(np.arange(n), policy, alone.state, np.zeros(n))


class _Fused(NamedTuple):
    """Hold what comes of a lie in some decisions of which none are alike, k of them."""

    rows: Ints  # which of the decisions, `(k,)`; they may be repeated
    policy: Floats  # the fused probabilities of A actions, `(k, A)`
    state: Floats  # the rule's memory after it, `(k, K)`
    trust: Floats  # how far the rule trusts liars after it, summed over them, `(k,)`


class _Kinds(NamedTuple):
    """Say which of n decisions of a front are alike, so that each kind, of k, is fused once."""

    first: Ints  # row of the first decision of each kind, `(k,)`
    of_row: Ints  # each decision's kind, `(n,)`
    ties: TieDraws | None  # draws the n decisions' ties

    def of_some(self, rows: Bools) -> Ints:
        """Return the kinds of which some decision is among `rows`, a mask `(n,)`.

        Ties are drawn for each, so that decisions of one kind may have led elsewhere.
        """
        return np.unique(self.of_row[rows])

    def spread(self, fused: _Fused) -> Play:
        """Return what comes of a lie in all decisions, from what comes of it in each kind."""
        rows = np.argsort(self.of_row, kind="stable")
        counts = np.bincount(self.of_row, minlength=len(self.first))
        begins = np.cumsum(counts) - counts
        repeats = counts[fused.rows]
        source = np.repeat(np.arange(len(repeats)), repeats)
        nth = np.arange(len(source)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        at = rows[begins[fused.rows][source] + nth]
        ties = self.ties and _TiesOf(self.ties, at, len(rows))
        action = likeliest(taken(fused.policy, source), ties)
        return Play(at, action, taken(fused.state, source), fused.trust[source])


@dataclass(frozen=True)
class _Decisions:
    """Hold n decisions of a front and what is heard there, to be fused."""

    point: OperatingPoint
    heard: Exchange
    intents: Intents
    liars: Bools
    state: Floats | None  # the rule's memory before each

    def kinds(self, at: Ints, ties: TieDraws | None) -> _Kinds:
        """Return which decisions are alike in all that a rule of the harness reads.

        `at`, `(n,)`, is the decision point of each. No two are alike for another rule, which may
        read when messages arrive. `ties` draws ties, which are each decision's own.
        """
        n = len(self.liars)
        if self.point.fusion.consensus not in RULES.built_in:
            return _Kinds(np.arange(n), np.arange(n), ties)
        intents, claims = self.intents, self.intents.claims
        inputs = [at, self.liars, self.heard.on_time, self.heard.own]
        inputs += [intents.helpers, intents.distance_m]
        if self.state is not None:
            inputs.append(self.state)
        if claims is not None:
            inputs += [claims.xy_m, claims.speed_mps, claims.time_s]
            inputs += [claims.error_m, claims.sensed_m]
        numbers = [values.reshape(n, -1).astype(float) for values in inputs]
        table = np.concatenate(numbers, axis=1)
        rows = table.view(np.dtype((np.void, table.strides[0]))).ravel()
        _, first, of_row = np.unique(rows, return_index=True, return_inverse=True)
        return _Kinds(first, of_row, ties)

    def take(self, at: Ints) -> "_Decisions":
        """Return the decisions at indices `at`, which may be repeated."""
        values = {}
        for field in fields(Exchange):
            values[field.name] = taken(getattr(self.heard, field.name), at)
        return _Decisions(
            self.point,
            Exchange(**values),
            self.intents.take(at),
            self.liars[at],
            None if self.state is None else taken(self.state, at),
        )

    def silent(self) -> "_Decisions":
        on_time = self.heard.on_time & ~self.liars
        return replace(self, heard=replace(self.heard, on_time=on_time))

    def saying(self, message: Floats) -> "_Decisions":
        """Return the decisions if all liars say a message, `(A,)`, or one each, `(n, A)`."""
        return replace(self, intents=lies.with_message(self.intents, self.liars, message))

    def coordinated(self) -> Coordination:
        return fuse(self.point, self.heard, self.intents, FusionInputs(None, self.state))

    def fused(self) -> _Fused:
        result = self.coordinated()
        trust = np.where(self.liars, np.nan_to_num(result.trust), 0.0).sum(axis=-1)
        return _Fused(np.arange(len(self.liars)), result.fused, result.state, trust)

    def each(self, messages: Sequence[Floats] | Floats, at: Ints) -> Iterator[_Fused]:
        """Yield what comes of each message, `(A,)` or `(n, A)`, in decisions at `at`, `(k,)`."""
        count = max(1, AT_ONCE // max(1, len(at)))
        for start in range(0, len(messages), count):
            some = messages[start : start + count]
            rows, lies_at = np.tile(at, len(some)), []
            for message in some:
                lies_at.append(np.broadcast_to(message, self.heard.own.shape)[at])
            fused = self.take(rows).saying(np.concatenate(lies_at)).fused()
            yield fused._replace(rows=rows)


@dataclass(frozen=True)
class _TiesOf:
    """Draw ties of some rows of n decisions, which may be repeated."""

    ties: TieDraws
    rows: Ints
    n: int

    def __call__(self, tied: Bools) -> Floats:
        is_tied = np.zeros(self.n, dtype=bool)
        is_tied[self.rows[tied]] = True
        draws = np.empty(self.n)
        draws[is_tied] = self.ties(is_tied)
        return draws[self.rows[tied]]


def with_claims(
    claims: str, truth: Intents, liars: Bools, draws: Draws
) -> tuple[Intents, Bools, Draws]:
    """Return what is sent if liars claim to be others or elsewhere, whose voices lie, and draws.

    `claims` has attacks on who and where liars, `(n, H)`, are; `truth` and `draws` are of n
    decisions with H helpers. The results are of the voices, `(n, H')`, which may be more.
    """
    n, helpers, actions = truth.helpers.shape
    no_past = np.empty((n, 0, helpers, actions))
    turn = Turn(truth, liars, truth.helpers, no_past, np.zeros((n, helpers)))
    sent = truth
    for attack in attacks_of(claims):
        sent = attack.act(sent, turn)
    if sent.voice_of is None:
        return sent, liars, draws
    voices = np.take_along_axis(liars, sent.voice_of, axis=-1)
    return sent, voices, draws.of_helpers(sent.voice_of)
