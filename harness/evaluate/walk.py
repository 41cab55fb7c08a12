"""The one loop over decision points:
observe the world, get intents, coordinate under every condition, act.

The kinds of world are frozen scenes, the closed loop, and those whose decision points are drawn.
They differ only in where their decision points come from and where an action leads.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from harness.coordination.claims import Claims
from harness.coordination.contents_of_packages import able, bits
from harness.coordination.coordinate import Coordination, FusionCall, FusionInputs, fuse
from harness.coordination.exchange import Exchange, exchange, needed
from harness.coordination.intents import Intents
from harness.coordination.operating_point import AS_SENT, OperatingPoint, Rewrites
from harness.coordination.parts import PLAIN, Question
from harness.coordination.parts_of_packages import sources
from harness.coordination.plans import Plans
from harness.coordination.scheduling import Outlook
from harness.coordination.sent import SentIntents, Speaker
from harness.coordination.streams import Sent, Stream, Streamed
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError
from harness.core.strangers import strangers
from harness.dataset.load import Scene
from harness.evaluate.claims import claims
from harness.evaluate.draws import tie_draws
from harness.evaluate.fusion import codes_of
from harness.evaluate.outlook import outlook
from harness.evaluate.sharing import listed
from harness.radio.channel import Antenna, Draws, Site
from harness.world.scenario import Scenario
from harness.world.sight_lines import site

DecisionPoint = TypeVar("DecisionPoint")
AskedPoint = TypeVar("AskedPoint", contravariant=True)


@dataclass(frozen=True)
class Due:
    """Hold the n decisions to be made now under one condition, in all episodes and seeds.

    A condition is the settings of the radio, of asking helpers and of fusing their messages; each
    episode is played under it once for each seed of the channel's random draws. Of each decision,
    `at` (n,) is the index of its point, such as a scene, among those that `World.observe` returned
    last; `episode` (n,) is its episode's number and `seed` (n,) that of the channel. `draws` has
    the channel's random numbers for its H helpers. `senders` (n, H) is the index among these n of
    the decision that a helper, which here decides for itself, makes now, -1 for none; it is None
    where messages hold no plans.
    """

    # index of each decision's point, such as its scene, among those that `World.observe` returned
    # last, (n,)
    at: Ints
    episode: Ints  # number of each decision's episode, (n,)
    seed: Ints  # seed of the channel's draws for each, (n,)
    draws: Draws  # those draws, (n, ...)
    # index among these n decisions of the one that each of H helpers makes itself now, in the same
    # world, (n, H); -1 where it makes none. None where messages hold no plans
    senders: Ints | None = None

    @property
    def episodes(self) -> list[tuple[int, int]]:
        """Return of each decision the number of its episode and the seed of the channel's draws.

        Together the two tell which play of an episode it belongs to, under this condition.
        """
        return list(zip(self.episode.tolist(), self.seed.tolist(), strict=True))


@dataclass(frozen=True)
class Decided(Generic[DecisionPoint]):
    """Hold the n decisions that were made at one step under one condition.

    A step is one round of decisions in all episodes, and a condition, `point`, the settings of the
    radio, of asking helpers and of fusing their messages. `decision_points` are the situations to
    decide in, scenes as a rule. `due` says which decision is about which of them, in which episode
    and with which seed; `result` has what was decided, such as the index of each action, (n,),
    `said` the probabilities of actions that vehicles sent over the channel, attackers' lies
    included, and `streamed` how much helpers have sent unasked.
    """

    point: OperatingPoint  # the condition
    # the decision points, scenes as a rule, that `World.observe` returned; `due.at` has indices in
    # them
    decision_points: Sequence[DecisionPoint]
    due: Due  # the decisions that were due
    result: Coordination  # what was decided, (n, ...)
    said: SentIntents  # what vehicles sent over the channel, attackers' lies included
    # what helpers have sent unasked since the decision before, (n,); None if they send nothing so
    streamed: Sent | None


class World(Protocol[DecisionPoint]):
    """Describe where decision points come from and where actions lead, as `walk` needs it.

    A decision point is where an ego must decide, such as a scene. Worlds are recorded scenes, a
    simulation, and points that are drawn at random.
    """

    def observe(self) -> Sequence[DecisionPoint]:
        """Return each distinct decision point, such as a scene, at which decisions are due now.

        The list is empty once all episodes have ended.
        """
        ...

    def due(self, point: OperatingPoint) -> Due:
        """Return the decisions due at the points that `observe` returned last, under one condition.

        `point` is the condition: the settings of the radio, of asking helpers and of fusing their
        messages.
        """
        ...

    def site(self, antennas: Collection[Antenna]) -> Site | None:
        """Return the true positions of vehicles at the n points last observed, `(n, ...)`.

        `antennas` are those on no vehicle, such as beside the road, whose links are wanted, too.
        None in a world without positions.
        """
        ...

    def outlook(self) -> Outlook | None:
        """Return how much egos see of where a danger may come from, at the points last observed.

        A danger is a vehicle that would meet an ego which keeps its speed. What helpers would add
        is in it, too. Arrays are `(n, ...)`. None in a world without positions.
        """
        ...

    def claims(self) -> Claims | None:
        """Return the positions and speeds that helpers' broadcasts claim, to check them.

        They are of the n points last observed, `(n, ...)`; rules that rate trust check them. None
        in a world without positions.
        """
        ...

    def plans(self) -> Plans | None:
        """Return what agents say of their motion at the n last observed points, `(n, 1)`.

        An agent is a vehicle that decides for itself; each point is the decision of one. None in a
        world where only one ego decides.
        """
        ...

    def listed(self) -> tuple[Floats, Floats] | None:
        """Return how many objects each of H helpers lists, and their size in bits, both `(n, H)`.

        Objects are the vehicles that a helper sees, to be sent to the ego. They are of the n last
        observed points. None in a world without positions.
        """
        ...

    def step(self, decided: Sequence[Decided[DecisionPoint]]) -> None:
        """Act on the decisions, one `Decided` a condition, and go on to the next points.

        `observe` returns these then.
        """
        ...


class SceneWorld:
    """Describe a world, as `World` does, whose decision points are scenes of a scenario.

    It is a base class: it computes from the scenes what vehicles see and claim.
    """

    scenario: Scenario  # the scenario of the scenes
    scenes: Sequence[Scene]  # the scenes that `observe` returned last

    def site(self, antennas: Collection[Antenna]) -> Site:
        decision_points = [(scene.state, scene.viewers) for scene in self.scenes]
        layouts = [self.scenario.at(scene.state.episode_seed) for scene in self.scenes]
        zones_m = [layout.road().zone_m for layout in layouts]
        return site(decision_points, antennas, zones_m, [layout.names for layout in layouts])

    def outlook(self) -> Outlook:
        return outlook(self.scenario, self.scenes)

    def claims(self) -> Claims:
        return claims(self.scenario, self.scenes)

    def plans(self) -> Plans | None:
        return None

    def listed(self) -> tuple[Floats, Floats]:
        """Return how many objects each of H helpers lists, and their size in bits, both `(n, H)`.

        Objects are the vehicles that a helper sees, in each of the n scenes observed last.
        """
        return listed(self.scenes)


class Fuses(Protocol):
    """Describe a function that has the ego's answers after it heard messages, at some points.

    The ego's model is asked again with the messages that the ego heard (a fusion call); all sets of
    messages were stated beforehand (`Ask.fusion_call`). The function takes the indices of n
    decisions' points, (n,), and who attacks, and returns a function of who was heard, (n, H).
    """

    def __call__(self, decision_points: Ints, attackers: Bools | None = None, /) -> FusionCall:
        """Return the fusion call of n decisions: a function of who was heard, `(n, H)`.

        It returns the ego's answers, `(n, A)`, and their seconds, `(n,)`. `decision_points`,
        `(n,)`, has the number of each decision's point (`places_of`); `attackers`, `(n, H)`, says
        which senders attack, and is needed where what is shown of their messages is changed.
        """
        ...


class Ask(Protocol[AskedPoint]):
    """Describe what gives vehicles' intents when a run is played: it asks models, or has answers.

    An intent is the probabilities of the ego's actions that one vehicle's model answers.
    """

    def __call__(self, points: Sequence[AskedPoint], /) -> Intents:
        """Return what every vehicle intends at the n decision points `points`, `(n, ...)`.

        Helpers may be `unasked`: their models are asked once a condition needs them.
        """
        ...

    def others(self, points: Sequence[AskedPoint], /, question: Question, at: Ints) -> Intents:
        """Return vehicles' intents at n points, `(n, ...)`, if helpers are asked another question.

        An intent is the probabilities that a vehicle gives to the ego's actions. `question` is not
        the ordinary one, what the ego should do; such is one that shows helpers nothing. Only the
        points at the indices `at` need values.
        """
        ...

    def helpers(
        self, points: Sequence[AskedPoint], /, wanted: Bools, question: Question = PLAIN
    ) -> Intents:
        """Ask some helpers, those marked in `wanted`, `(n, H)`, at n points with H helpers.

        Returns the intents at the m points in which a helper is marked, `(m, ...)`, in their order.
        `question` is what the helpers are asked.
        """
        ...

    def streamed(
        self,
        points: Sequence[AskedPoint],
        /,
        stream: Stream,
        codes: Ints,
        rewrites: Rewrites = AS_SENT,
    ) -> Streamed:
        """Return what K egos answer once they have heard a stream, `(K, ...)`.

        `stream` are the messages that helpers send unasked. `codes`, `(K,)`, and `rewrites` are as
        in `fusion_call`, but that the integers say who attacks and not who was heard, which the
        stream says.
        """
        ...

    def fusion_call(
        self, points: Sequence[AskedPoint], /, codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> Fuses:
        """Return the ego's answers to being asked once more with K sets of messages, as a function.

        `codes`, `(K,)`, has for each set an integer that says at which of `points` who was heard
        (`harness.evaluate.fusion.codes_of`); `rewrites` says how the messages are shown. The
        function takes the indices of n decisions' points, `(n,)`, and who attacks, `(n, H)` or
        None, and returns one of who of H helpers was heard, `(n, H)`. This returns the ego's
        probabilities of A actions, `(n, A)`, and the seconds of each answer, `(n,)`.
        """
        ...

    def call_of_agents(
        self, points: Sequence[AskedPoint], /, at: Ints, intents: Intents
    ) -> FusionCall:
        """Return the function that asks n agents once more, with the plans that each has heard.

        An agent is a vehicle that decides for itself. `at`, `(n,)`, has the index in `points` of
        each one's own; `intents`, `(n, ...)`, has the plans, what vehicles state of their motion.
        The function takes who of H others was heard, `(n, H)`, and returns each agent's
        probabilities of A actions, `(n, A)`, and the seconds of each answer, `(n,)`, NaN for who
        heard nobody.
        """
        ...


def walk(
    world: World[DecisionPoint],
    points: Sequence[OperatingPoint],
    ask: Ask[DecisionPoint],
    ties: str,
) -> Iterator[Sequence[Decided[DecisionPoint]]]:
    """Play a world: yield the decisions of each step until every episode has ended.

    Each item has one `Decided` for each condition under which decisions were due; a step is one
    round of decisions in all episodes.

    Args:
        world: gives the decision points, and is told the decisions.
        points: the conditions: settings of the radio, of asking helpers and of fusing their
            messages. Every episode is played under each.
        ask: gives what vehicles intend, by asking their models.
        ties: which of equally likely actions is taken: the `first`, or one that is `drawn`.
    """
    steps = _steps(world, points, ask, ties)
    while True:
        with strangers():  # rules, channels, attacks, schedules and worlds may be a package's
            step = next(steps, None)
        if step is None:
            return
        yield step


def _steps(
    world: World[DecisionPoint],
    points: Sequence[OperatingPoint],
    ask: Ask[DecisionPoint],
    ties: str,
) -> Iterator[Sequence[Decided[DecisionPoint]]]:
    memories = {point: Memory() for point in points}
    speakers = {point: point.speaker() for point in points}
    while decision_points := world.observe():
        intents = ask(decision_points)
        due = _due(world, points)
        intents = _with_needs(world, due, intents)
        others = _others(ask, decision_points, due)
        streamed = _streamed(ask, decision_points, due, intents)
        answers = _answers_of_helpers(
            ask, decision_points, due, {PLAIN: intents, **others}, streamed
        )
        broadcasts: dict[OperatingPoint, SentIntents] = {}
        sent: dict[OperatingPoint, Exchange] = {}
        fusions: dict[OperatingPoint, FusionInputs] = {}
        for point, due_here in due.items():
            intents_here = heard(point, answers, due_here, streamed)
            speaker, draws = speakers[point], due_here.draws
            broadcasts[point] = _broadcast(point, speaker, intents_here, due_here)
            sent[point] = exchange(point, broadcasts[point].intents, broadcasts[point].draws)
            ties_here = tie_draws(draws, ties)
            state, first = memories[point].recall(due_here)
            fusions[point] = FusionInputs(None, state, ties_here, first)
        for point, due_here in due.items():
            call_of = partial(ask.call_of_agents, decision_points, due_here.at)
            decide = partial(_decided, point, fusions[point], call_of)
            broadcasts[point], sent[point] = point.again(broadcasts[point], sent[point], decide)
        calls = _fusion_calls(due, broadcasts, sent, decision_points, ask)
        decided = []
        for point, due_here in due.items():
            call = None
            if point.has_fusion_call and point.content.of_agents:
                call = ask.call_of_agents(decision_points, due_here.at, broadcasts[point].intents)
            elif point.has_fusion_call:
                places = places_of(point, due_here, len(decision_points))
                call = calls[point.rewrites](places, shown_attackers(point, broadcasts[point]))
            fusion = replace(fusions[point], call=call)
            result = fuse(point, sent[point], broadcasts[point].intents, fusion)
            memories[point].keep(due_here, result.state)
            traffic = streamed[point].sent if point.stream else None
            sent_intents = broadcasts[point]
            decided.append(Decided(point, decision_points, due_here, result, sent_intents, traffic))
        yield decided
        world.step(decided)


def _due(
    world: World[DecisionPoint], points: Sequence[OperatingPoint]
) -> dict[OperatingPoint, Due]:
    """Return the decisions that are due now, by condition; none of one without any."""
    due = {point: world.due(point) for point in points}
    return {point: due_here for point, due_here in due.items() if len(due_here.at)}


def _with_needs(
    world: World[DecisionPoint], due: Mapping[OperatingPoint, Due], intents: Intents
) -> Intents:
    """Return what vehicles intend with all that some condition needs to know of the world."""
    if any(point.physical for point in due):
        antennas = {antenna for point in due for antenna in point.antennas}
        intents = replace(intents, site=world.site(antennas))
    if any(point.needs("outlook") for point in due):
        intents = replace(intents, outlook=world.outlook())
    if any(point.needs("claims") for point in due):
        intents = replace(intents, claims=world.claims())
    if any(point.needs("plans") for point in due):
        intents = replace(intents, plans=world.plans())
    if any(point.needs("objects") for point in due):
        counts, bits = world.listed() or (None, None)
        intents = replace(intents, objects=counts, object_bits=bits)
    return intents


def _alone(point: OperatingPoint, intents: Intents) -> Intents:
    """Return what vehicles intend without what only another condition needs to know."""
    needless = [name for name in ("outlook", "claims", "plans") if not point.needs(name)]
    if not point.physical:
        needless.append("site")
    if not point.needs("objects"):
        needless += ["objects", "object_bits"]
    nothing: dict[str, Any] = dict.fromkeys(needless)
    return replace(intents, **nothing)


def _decided(
    point: OperatingPoint,
    fusion: FusionInputs,
    call_of: Callable[[Intents], FusionCall],
    heard: Exchange,
    intents: Intents,
) -> Coordination:
    call = call_of(intents) if point.has_fusion_call else None
    return fuse(point, heard, intents, replace(fusion, call=call))


def _others(
    ask: Ask[DecisionPoint],
    decision_points: Sequence[DecisionPoint],
    due: Mapping[OperatingPoint, Due],
) -> dict[Question, Intents]:
    """Return what vehicles intend by each question that is not the plain one."""
    at: dict[Question, list[Ints]] = {}
    for point, due_here in due.items():
        if point.question != PLAIN:
            at.setdefault(point.question, []).append(due_here.at)
    return {
        question: ask.others(decision_points, question, np.unique(np.concatenate(places)))
        for question, places in at.items()
    }


def _streamed(
    ask: Ask[DecisionPoint],
    decision_points: Sequence[DecisionPoint],
    due: Mapping[OperatingPoint, Due],
    intents: Intents,
) -> dict[OperatingPoint, Streamed]:
    """Return what egos answer that have heard what helpers send unasked, by condition."""
    codes = dict[OperatingPoint, Ints]()
    of_stream: dict[tuple[Stream, Rewrites], list[Ints]] = {}
    for point, due_here in due.items():
        if point.stream is not None:
            attackers = _attackers_unasked(point, due_here, intents)
            codes[point] = codes_of(attackers, places_of(point, due_here, len(decision_points)))
            of_stream.setdefault((point.stream, point.rewrites), []).append(codes[point])
    answers = dict[OperatingPoint, Streamed]()
    for (stream, rewrites), each in of_stream.items():
        distinct = np.unique(np.concatenate(each))
        of_distinct = ask.streamed(decision_points, stream, distinct, rewrites)
        for point in codes:
            if (point.stream, point.rewrites) == (stream, rewrites):
                answers[point] = of_distinct.take(np.searchsorted(distinct, codes[point]))
    return answers


def _attackers_unasked(point: OperatingPoint, due: Due, intents: Intents) -> Bools:
    """Return who attacks by what is sent unasked, `(n, H)`; `(n, 0)` if no attack changes that."""
    if not point.rewrites.changes.of_attackers:
        return np.zeros((len(due.at), 0), dtype=bool)
    return _broadcast(point, point.speaker(), intents.take(due.at), due).attackers


def _broadcast(point: OperatingPoint, speaker: Speaker, intents: Intents, due: Due) -> SentIntents:
    """Return what vehicles send in the n decisions that are due, given what they intend.

    Who attacks by what is sent unasked is drawn by layout alone, as its losses are: further seeds
    then ask no further questions.
    """
    draws = due.draws
    intents = _alone(point, intents)
    if point.needs("numbers"):
        intents = replace(intents, numbers=draws.numbers)
    if point.stream is None or not point.rewrites.changes.of_attackers or draws.trips is None:
        return speaker.said(intents, draws, due.episode, due.seed)
    of_layout = replace(draws, trips=draws.trips.of_layout())
    lies = speaker.said(intents, of_layout, due.episode, due.seed)
    return replace(lies, draws=replace(lies.draws, trips=draws.trips))


def _answers_of_helpers(
    ask: Ask[DecisionPoint],
    decision_points: Sequence[DecisionPoint],
    due: Mapping[OperatingPoint, Due],
    answers: Mapping[Question, Intents],
    streamed: Mapping[OperatingPoint, Streamed],
) -> Mapping[Question, Intents]:
    """Ask the helpers whose answers some condition uses, and return the intents by question.

    An answer may fail, and another helper is asked in its place; so this may take several turns.
    """
    answers = dict(answers)
    while True:
        wanted = {
            question: np.zeros(intents.range_m.shape, dtype=bool)
            for question, intents in answers.items()
        }
        for point, due_here in due.items():
            here = heard(point, answers, due_here, streamed)
            if here.unasked is not None and here.unasked.any():
                decision, helper = np.nonzero(here.unasked & needed(point, here, due_here.draws))
                shown_at = due_here.at[_sources(point, due_here)[decision]]
                wanted[point.question][shown_at, helper] = True
        if not any(helpers.any() for helpers in wanted.values()):
            return answers
        for question, helpers in wanted.items():
            if helpers.any():
                at = np.flatnonzero(helpers.any(axis=1))
                new = ask.helpers(decision_points, helpers, question)
                answers[question] = answers[question].replaced(at, new)


def heard(
    point: OperatingPoint,
    answers: Mapping[Question, Intents],
    due: Due,
    streamed: Mapping[OperatingPoint, Streamed],
) -> Intents:
    """Return what vehicles intend in n decisions that are due, as the ego may hear it.

    `point` is the condition, the settings; `due` has the decisions, and `answers` the intents at
    all decision points observed, by the question that helpers were asked. Helpers' may be answers
    to another question, or come from another decision's scene, as in a control; who has no other to
    hear from hears nobody. Distances and inference times stay the decision's own. `streamed` has
    what egos answer that have heard a stream, by condition.
    """
    intents = _able(point, answers[PLAIN], due, streamed.get(point))
    if point.question != PLAIN:
        source = _able(point, answers[point.question], due)
        intents = _with_helpers(intents, source, source.valid)
    elif point.elsewhere:
        places = _sources(point, due)
        source, alone = intents.take(places), places == np.arange(len(places))
        intents = _with_helpers(intents, source, source.valid & ~alone[:, None])
    return as_sent(point, intents) if point.asks else intents


def _with_own(intents: Intents, streamed: Streamed) -> Intents:
    """Return intents with the ego's as it answers once it has heard a stream."""
    inference_s = intents.inference_s.copy()
    inference_s[:, 0] = streamed.inference_s
    return replace(intents, own=streamed.own, inference_s=inference_s, allowed_s=streamed.allowed_s)


def _with_helpers(intents: Intents, source: Intents, valid: Bools) -> Intents:
    names = ("helpers", "payload_bits", "text_bytes", "unasked", "objects", "object_bits")
    sent = {name: getattr(source, name) for name in names}
    arrays = {name: array for name, array in sent.items() if array is not None}
    return replace(intents, valid=valid, **arrays)


def _able(
    point: OperatingPoint, intents: Intents, due: Due, streamed: Streamed | None = None
) -> Intents:
    """Return the intents of the decisions that are due, of helpers that can send the content.

    The egos' are `streamed`, if they have heard a stream.
    """
    every = np.array_equal(due.at, np.arange(len(intents.own)))
    of_due = intents if every else intents.take(due.at)
    if streamed is not None:
        of_due = _with_own(of_due, streamed)
    return able(point, point.prepared(of_due), due.senders)


def as_sent(point: OperatingPoint, intents: Intents) -> Intents:
    """Return intents with the sizes of replies, in bits, that messages have under a condition.

    They follow from what messages hold and how they are encoded. Both are settings of the operating
    point `point`.
    """
    sizes = bits(point, intents)
    return intents if sizes is intents.payload_bits else replace(intents, payload_bits=sizes)


def _sources(point: OperatingPoint, due: Due) -> Ints:
    """Return the decision whose helpers each decision hears, (n,):
    its own, unless messages come from elsewhere.
    """
    if point.elsewhere:
        return sources(point.elsewhere, due.episode, due.seed)
    return np.arange(len(due.at))


class Memory:
    """Keep what a consensus rule remembers from one decision of an episode to the next.

    The rule fuses vehicles' answers; its memory is numbers of its own, such as its trust in each
    helper. Each episode and seed of the channel's draws has its own, and a `Memory` is of one
    condition.
    """

    def __init__(self) -> None:
        self._state: dict[tuple[int, int], Floats] = {}

    def recall(self, due: Due) -> tuple[Floats, Bools] | tuple[None, None]:
        """Return what the rule that fuses messages remembers for n decisions, `(n, K)`.

        It is K numbers for each, 0 at the first of an episode, and a mask of those that are first,
        `(n,)`; None and None if all are. `due` has the decisions, each with its episode and seed.
        Raises UserError if K differs between episodes, as with their helpers.
        """
        if not self._state:
            return None, None
        states = [self._state.get(place) for place in due.episodes]
        lengths = {len(state) for state in states if state is not None}
        if not lengths:
            return None, None
        if len(lengths) > 1:
            raise UserError(
                "a consensus rule with memory: helpers come or go during an episode here, so that "
                "it remembers more in some episodes than in others; take another rule"
            )
        nothing = np.zeros(lengths.pop())
        first = np.array([state is None for state in states], dtype=bool)
        return np.array([nothing if state is None else state for state in states]), first

    def keep(self, due: Due, state: Floats) -> None:
        """Store what the rule that fuses messages remembers after n decisions; nothing if K is 0.

        `state`, `(n, K)`, is K numbers for each, and `due` has the decisions.
        """
        if state.shape[-1]:
            self._state |= dict(zip(due.episodes, state, strict=True))


def _fusion_calls(
    due: Mapping[OperatingPoint, Due],
    broadcasts: Mapping[OperatingPoint, SentIntents],
    sent: Mapping[OperatingPoint, Exchange],
    decision_points: Sequence[DecisionPoint],
    ask: Ask[DecisionPoint],
) -> dict[Rewrites, Fuses]:
    """Make one fusion call for each set of messages that any condition hears,
    and return them by rewrites.

    This can happen before any decision, since who is heard does not depend on the fusion.
    What agents decide is left out: it may be of a later round.
    """
    calls = {}
    due = {point: due_here for point, due_here in due.items() if not point.content.of_agents}
    for rewrites in dict.fromkeys(point.rewrites for point in due if point.has_fusion_call):
        alike = {point: due_here for point, due_here in due.items() if point.rewrites == rewrites}
        codes = heard_codes(alike, broadcasts, sent, len(decision_points))
        calls[rewrites] = ask.fusion_call(decision_points, codes, rewrites)
    return calls


def heard_codes(
    due: Mapping[OperatingPoint, Due],
    broadcasts: Mapping[OperatingPoint, SentIntents],
    sent: Mapping[OperatingPoint, Exchange],
    n: int,
) -> Ints:
    """Return all K sets of messages that some ego hears, each as an integer (`codes_of`), `(K,)`.

    They are sorted and distinct. Only conditions count whose egos are asked once more with what
    they heard. An operating point is a condition, the settings. The mappings have by condition the
    decisions due (`due`), what vehicles sent (`broadcasts`), and who was heard (`sent`); `n` is the
    number of decision points.
    """
    codes = [np.empty(0, dtype=int)]
    for point, due_here in due.items():
        if point.has_fusion_call:
            on_time = sent[point].on_time
            codes_here = codes_of(
                on_time, places_of(point, due_here, n), shown_attackers(point, broadcasts[point])
            )
            codes.append(codes_here[on_time.any(axis=1)])
    return np.unique(np.concatenate(codes))


def places_of(point: OperatingPoint, due: Due, n: int) -> Ints:
    """Return where each of m decisions is, as a number for the integers of `codes_of`, `(m,)`.

    Such an integer also says who was heard there. The decisions are due under the condition
    `point`, at `n` decision points. The number is the index of the decision's point; where messages
    come from another point, as in a control, it is `n` times that index plus the other point's.
    """
    return due.at * n + due.at[_sources(point, due)] if point.rewrites.elsewhere else due.at


def shown_attackers(point: OperatingPoint, broadcast: SentIntents) -> Bools | None:
    """Return a mask of the senders that attack, `(n, H)`; None if no prompt depends on it.

    A prompt that shows messages depends on it if attacks change these. `point` is the condition,
    and `broadcast` has what was sent in n decisions.
    """
    return broadcast.attackers if point.rewrites.changes.of_attackers else None
