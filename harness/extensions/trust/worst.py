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

from harness.coordination.coordinate import Coordination, FusionInputs, TieDraws, fuse
from harness.coordination.exchange import Exchange, exchange
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.plans import Plans
from harness.coordination.robust import Heads
from harness.coordination.rules import RULES
from harness.coordination.trust import trusting_only
from harness.core.arrays import Bools, Floats, Ints
from harness.dataset.load import Dataset, Scene
from harness.evaluate.draws import channel_draws, tie_draws
from harness.evaluate.fusion import codes_of
from harness.evaluate.walk import Ask, Decided, Due, SceneWorld
from harness.extensions.trust import lies
from harness.extensions.trust.attacks import Turn, attacks_of
from harness.radio.channel import Draws

TRUST = "trust"  # the rule with memory whose lies are looked for
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
        self._helpers = max((len(scene.viewers) for scene in self.scenes), default=1) - 1
        return self.scenes

    def due(self, point: OperatingPoint) -> Due:
        front, forest = self._fronts[point], self._forest
        seed, decisions = self._seeds[front.seed], self.scenario.parameters.decisions
        step = forest.step[front.at]
        draws = channel_draws(seed, forest.seeds[front.tree], step, decisions, self._helpers)
        at = np.searchsorted(self._shown, front.at)
        return Due(at, forest.episodes[front.tree], seed, draws)

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
    truth, draws, name = part.said.intents, part.due.draws, part.point.fusion.consensus
    drawn_ties = tie_draws(draws, ties)
    intents, liars, draws = with_claims(search.claims, truth, search.liars(truth, draws), draws)
    heard = exchange(part.point, intents, draws)
    decide = _Decide(part.point, front.state, drawn_ties, liars)
    silent = replace(heard, on_time=heard.on_time & ~liars)
    if search.bounds:
        yield from _bounds(decide, heard, silent, intents)
        return
    honest = decide(heard, intents)
    yield honest
    yield decide(silent, intents)
    actions = truth.own.shape[-1]
    for message in lies.certain(actions):
        yield decide(heard, lies.with_message(intents, liars, message))
    if lies.is_certainty_enough(part.point):
        return
    if honest.state.shape[-1]:  # a rule with memory
        voices = np.concatenate([heard.own[:, None], truth.helpers], axis=1)
        for message in lies.near_others(voices):
            yield decide(heard, lies.with_message(intents, liars, message))
        return
    lies_heard = (heard.on_time & liars).any(axis=1)
    if isinstance(RULES[name], Heads) and lies.is_likeliest_taken(part.point):
        lies_heard &= ~_agreed(heard, intents, liars)
    for message in lies.lattice(actions):
        # further actions matter only in episodes that are not lost yet
        is_open = lies_heard & ~reached.all(axis=1) & ~(reached & gives_away).any(axis=1)
        rows = np.flatnonzero(is_open)
        if len(rows):
            yield decide(heard, lies.with_message(intents, liars, message), rows)


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


def _agreed(heard: Exchange, intents: Intents, liars: Bools) -> Bools:
    """Return where a rule that counts heads lets no liar change a decision, `(n,)`.

    There is one liar, and all others, the ego among them and at least two, want one action.
    """
    honest = heard.on_time & ~liars
    choice = np.argmax(np.nan_to_num(intents.helpers), axis=-1)
    differs = (choice != np.argmax(heard.own, axis=-1)[:, None]) & honest
    one_liar = np.sum(heard.on_time & liars, axis=1) == 1
    return np.asarray(one_liar & honest.any(axis=1) & ~differs.any(axis=1))


def _bounds(
    decide: "_Decide", heard: Exchange, silent: Exchange, intents: Intents
) -> Iterator[Play]:
    """Yield what `trust` does with each set of helpers to trust, and each message of liars.

    Another's message can only speak for an honest helper, as long as liars claim nothing false. So
    whom the rule trusts that hears no liar, it trusts. Its memory is that of not hearing them.
    """
    alone = decide.fused(silent, intents)
    *n, helpers, actions = intents.helpers.shape
    every_sent = [intents]
    for message in lies.certain(actions):
        every_sent.append(lies.with_message(intents, decide.liars, message))
    for trusts in product((False, True), repeat=helpers):
        trusted = (np.nan_to_num(alone.trust) >= 0.5) | np.array(trusts)
        state = trusting_only(trusted, actions)
        for sent in every_sent:
            action = replace(decide, state=state).fused(heard, sent).action
            yield Play(np.arange(*n), action, alone.state, np.zeros(n))


@dataclass(frozen=True)
class _Decide:
    """Fuse what is said in the decisions of a front, from the rule's memory there."""

    point: OperatingPoint
    state: Floats | None
    ties: TieDraws | None
    liars: Bools

    def __call__(self, heard: Exchange, intents: Intents, rows: Ints | None = None) -> Play:
        liars, n = self.liars, len(self.liars)
        if rows is None:
            rows, result = np.arange(n), self.fused(heard, intents)
        else:
            liars = liars[rows]
            values = {field.name: getattr(heard, field.name)[rows] for field in fields(heard)}
            state = None if self.state is None else self.state[rows]
            ties = None if self.ties is None else _TiesOf(self.ties, rows, n)
            some = replace(self, state=state, ties=ties, liars=liars)
            result = some.fused(Exchange(**values), intents.take(rows))
        trust = np.where(liars, np.nan_to_num(result.trust), 0.0).sum(axis=-1)
        return Play(rows, result.action, result.state, trust)

    def fused(self, heard: Exchange, intents: Intents) -> Coordination:
        return fuse(self.point, heard, intents, FusionInputs(None, self.state, self.ties))


@dataclass(frozen=True)
class _TiesOf:
    """Draw ties of some rows of n decisions."""

    ties: TieDraws
    rows: Ints
    n: int

    def __call__(self, tied: Bools) -> Floats:
        of_all = np.zeros(self.n, dtype=bool)
        of_all[self.rows[tied]] = True
        return self.ties(of_all)


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
