"""Every set of helpers that an ego could ask, at every decision point that asking them leads to.

Frozen scenes say how each course ends, and draws are keyed by seed, layout and step. So what any
choice of helpers comes to, with these answers and these draws, follows backwards from the ends,
exactly. The best of all choices is the oracle: a bound, since no car knows what a helper will say,
or how an episode ends.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from harness.coordination.contents import INTENT
from harness.coordination.coordinate import FusionInputs, fuse
from harness.coordination.exchange import exchange, worth_of
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.parts import PLAIN
from harness.coordination.rules import EGO_PROMPT, RULES
from harness.coordination.scheduling import chosen
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, printable
from harness.dataset.forest import Forest
from harness.evaluate.draws import tie_draws
from harness.evaluate.helper_numbers import Helpers
from harness.evaluate.outlook import outlook
from harness.evaluate.walk import as_sent
from harness.radio.channel import Draws
from harness.studies.replayed_run import ReplayedRun
from harness.world.sight_lines import site

MOST_SETS = 64
# Of a decision; an episode has their sums.
COSTS = ("messages", "airtime_ms", "latency_ms", "decisions", "energy_j")
PRICE = 1e-6  # of a message in successes, where the fewest messages break a tie


@dataclass(frozen=True)
class Level:
    """Hold what the ego does, and what it costs, by whom it asks, at the decision points of a step.

    A decision point is a situation in which the ego must act, and a step has all N that are equally
    many decisions from the start. The other axes are S channel seeds, K sets of helpers that could
    be asked, and C costs (`COSTS`: messages, air time and so on). Where an axis is S x N, the first
    seed's N points come first.
    """

    # indices of the decision points in the forest, the dataset's decision trees, ascending, (N,)
    at: Ints
    action: Ints  # index of the meta-action that the ego takes if it asks a set, (S, N, K)
    costs: Floats  # costs of asking a set, in the order of `COSTS`, (S, N, K, C); NaN where unknown
    # all vehicles' intents (probabilities of actions), and what the ego sees, (S x N, ...)
    intents: Intents
    draws: Draws  # the channel's random numbers, (S x N, ...)


# A rule of whom to ask, as `Choices.backwards` calls it.
Choose = Callable[[Level, Floats, Floats], Ints]


@dataclass(frozen=True)
class Choices:
    """Hold what follows at each decision point of a dataset if the ego asks each set of helpers.

    A decision point is a situation in which the ego must act. There are K sets of some of H
    helpers; the empty one, of nobody, is the first. With it, any rule for whom to ask can be scored
    exactly, without asking the model again.
    """

    # the dataset's decision trees: every decision point that actions can lead to, and how each
    # course ends
    forest: Forest
    sets: Bools  # whether a set has a helper, (K, H)
    levels: tuple[Level, ...]  # the decision points by step, the first step's first

    def backwards(self, choose: Choose) -> Iterator[tuple[Level, Floats, Floats, Ints]]:
        """Yield, for each step from the last to the first, what asking each set of helpers does.

        This is dynamic programming from an episode's end. The axes are S channel seeds, N decision
        points of the step, K sets of helpers who are asked together, and C costs (`COSTS`). A tuple
        has the step's level, success (S, N, K), 1 or 0, and costs (S, N, K, C) from there to the
        episode's end, and the indices in `sets` of the chosen sets, (S, N).

        Args:
            choose: returns the index of the set asked in each decision, (S, N), given the level,
                and the success, (S, N, K), and costs, (S, N, K, C), to which each set leads with
                the choices of later steps.
        """
        # What the decision points of the next step come to, by what was chosen there.
        following = np.empty(0, dtype=int)
        success, costs = np.empty((0, 0)), np.empty((0, 0, len(COSTS)))
        for level in reversed(self.levels):
            at = level.at[:, None]
            child, tree = self.forest.child[at, level.action], self.forest.tree[at]
            ends = self.forest.succeeds(self.forest.edge[at, level.action], tree).astype(float)
            spent = level.costs
            if len(following):
                seed = np.arange(len(child))[:, None, None]
                place = np.minimum(np.searchsorted(following, child), len(following) - 1)
                ends = np.where(child >= 0, success[seed, place], ends)
                spent = spent + np.where((child >= 0)[..., None], costs[seed, place], 0.0)
            k = choose(level, ends, spent)
            success, costs = _values_of(ends, k), _values_of(spent, k)
            following = level.at
            yield level, ends, spent, k

    def played(self, choose: Choose) -> tuple[Floats, Floats]:
        """Return success, (S, E), and costs, (S, E, C), of every episode under the rule `choose`.

        A decision point is a situation in which the ego must act. The axes are S channel seeds, E
        episodes and C costs (`COSTS`). Success is 1 or 0. `choose` is called for each step, the
        last first, with its N decision points, and the success, (S, N, K), and costs, (S, N, K, C),
        to which each of K sets of helpers leads; it returns the index of the set to ask, (S, N).
        """
        [*_, (level, ends, spent, k)] = self.backwards(choose)
        root = np.searchsorted(level.at, self.forest.root)
        return _values_of(ends, k)[:, root], _values_of(spent, k)[:, root]

    def oracle(self) -> tuple[Floats, Floats]:
        """Return success, (S, E), and costs, (S, E, C), if the ego always asked the best set.

        That is a bound: only who knows how each course of actions ends could ask so. The axes are S
        channel seeds, E episodes and C costs (`COSTS`). Of equally good sets, those with the fewest
        messages are taken.
        """

        def best(level: Level, ends: Floats, spent: Floats) -> Ints:
            messages = spent[..., COSTS.index("messages")]
            return np.asarray(np.argmax(ends - PRICE * messages, axis=-1))

        return self.played(best)

    def index(self, mask: Bools) -> Ints:
        """Return the index in `sets` of each set of helpers that is given as a mask, `(...)`.

        `mask`, `(..., H)`, says which of the H helpers are in the set; it may leave out the last
        ones.
        """
        helpers = self.sets.shape[1]
        bits = 1 << np.arange(helpers)
        codes = self.sets @ bits
        order = np.argsort(codes)
        padding = [(0, 0)] * (mask.ndim - 1) + [(0, helpers - mask.shape[-1])]
        wanted = np.pad(mask, padding) @ bits
        places: Ints = order[np.searchsorted(codes[order], wanted)]
        return places

    def scheduled(self, point: OperatingPoint, worths: Sequence[Floats] | None = None) -> Choose:
        """Return the rule by which an operating point chooses whom to ask, a function.

        An operating point is the settings of radio, asking and fusion. Its schedule says what
        asking each helper is worth, and it has the threshold above which, and how many at most, the
        ego asks. `worths` is what asking is worth, as the method `worths` returned it for the
        point; without it that is computed. The function takes a level (the decision points,
        situations in which the ego must act, of one step), and the success, (S, N, K), and costs,
        (S, N, K, C), to which each of K sets of helpers leads, by S channel seeds, N decision
        points and C costs; it returns the index of the set to ask, (S, N).
        """
        lookup = None if worths is None else dict(zip(map(id, self.levels), worths, strict=True))

        def choose(level: Level, ends: Floats, spent: Floats) -> Ints:
            intents = level.intents
            worth = worth_of(point, intents, level.draws) if lookup is None else lookup[id(level)]
            may_ask = intents.valid & (intents.range_m <= point.ask.radius_m)
            mask = chosen(worth, point.ask.above, may_ask, intents.range_m, point.ask.max_helpers)
            return self.index(mask).reshape(ends.shape[:2])

        return choose

    def worths(self, point: OperatingPoint) -> list[Floats]:
        """Return what asking each helper is worth by an operating point's schedule, in its unit.

        An operating point is the settings of radio, asking and fusion, and its schedule the rule
        for whom to ask. The list has one array for each step, the first first: `(S x N, H)`, for S
        channel seeds by N decision points (situations in which the ego must act) and H helpers; `(S
        x N, 1)` where the worth is the same for all helpers.
        """
        return [worth_of(point, level.intents, level.draws) for level in self.levels]


def _values_of(values: Floats, k: Ints) -> Floats:
    """Return the values, (S, N, ...), of the sets `k`, (S, N), from those of each set,
    (S, N, K, ...).
    """
    index = k.reshape(*k.shape, *[1] * (values.ndim - 2))
    return np.asarray(np.take_along_axis(values, index, 2)[:, :, 0])


def refuse_idle(point: OperatingPoint) -> None:
    """Raise UserError if at an operating point no rule for whom to ask changes anything."""
    if why := point.idle("schedule"):
        raise UserError(f"--condition {printable(point.name)}: no schedule changes anything: {why}")


def refuse(point: OperatingPoint, helpers: int, actions: int) -> None:
    """Raise UserError if decisions depend on more than whom the ego hears now.

    Then what each set of helpers leads to cannot be computed apart, and the best choice is not
    known. It is so if the settings `point` have a fusion call (the model is asked again with the
    messages), a consensus rule (how messages are fused) with memory, another content of messages
    than intents (probabilities of actions), what changes messages, or messages sent unasked.
    `helpers` and `actions` are the numbers of helpers and of meta-actions.
    """
    name, consensus = printable(point.name), point.fusion.consensus
    if consensus == EGO_PROMPT or RULES[consensus].start((), helpers, actions).shape[-1]:
        raise UserError(
            f"--condition {name}: consensus {consensus} is no function of who is heard now, so "
            "that the oracle would be none; give linear, or another without memory"
        )
    changed = {"content": point.ask.content != INTENT}
    for part in point.more:
        first_setting, *_ = part.__struct_fields__
        of_answers = part.needs_all or part.question != PLAIN or part.elsewhere
        changed[first_setting] = of_answers or part.unasked(point) is not None
    for setting in changed:
        if changed[setting]:
            raise UserError(f"--condition {name}: the oracle knows no {setting}; leave it out")


def choices(
    stored: ReplayedRun,
    point: OperatingPoint,
    seeds: Sequence[int],
    progress: Callable[[int], None],
) -> Choices:
    """Compute what asking each set of helpers leads to, in each situation that a choice leads to.

    With the result, rules for whom to ask can be compared without asking the model again.

    Args:
        stored: the run whose answers are used; its model is asked for those that it lacks.
        point: the operating point (settings of radio, asking and fusion); its limit of helpers
            counts, and its schedule, the rule for whom to ask, does not.
        seeds: the channel seeds that draws are made from.
        progress: called with 1 for each step.

    Raises:
        UserError: decisions depend on more than whom the ego hears now, or there are too many sets.
    """
    dataset, forest, seed = stored.dataset, stored.dataset.forest, np.array(seeds)
    helpers = stored.vehicles - 1
    refuse(point, helpers, len(dataset.actions))
    sizes = range(min(point.ask.max_helpers, helpers) + 1)
    members = [some for size in sizes for some in combinations(range(helpers), size)]
    if len(members) > MOST_SETS:
        raise UserError(
            f"--condition {printable(point.name)}: {len(members)} sets of helpers, {MOST_SETS} at "
            "most; give a smaller max_helpers"
        )
    sets = np.zeros((len(members), helpers), dtype=bool)
    for row, some in zip(sets, members, strict=True):
        row[list(some)] = True
    at, levels, numbering = forest.root, list[Level](), Helpers()
    while len(at):
        level = _level(stored, point, seed, at, sets, numbering)
        levels.append(level)
        following = forest.child[at[:, None], level.action]
        at = np.unique(following[following >= 0])
        progress(1)
    return Choices(forest, sets, tuple(levels))


def _level(
    stored: ReplayedRun,
    point: OperatingPoint,
    seeds: Ints,
    at: Ints,
    sets: Bools,
    numbering: Helpers,
) -> Level:
    dataset, forest = stored.dataset, stored.dataset.forest
    scenario, shape = dataset.scenario, (len(seeds), len(at))
    scenes = dataset.scenes([forest.ids[n] for n in at.tolist()])
    intents = replace(stored.whole(scenes), outlook=outlook(scenario, scenes))
    if point.physical:
        places = [(scene.state, scene.viewers) for scene in scenes]
        layouts = [scenario.at(scene.state.episode_seed) for scene in scenes]
        zones_m, names = [at.road().zone_m for at in layouts], [at.names for at in layouts]
        intents = replace(intents, site=site(places, point.antennas, zones_m, names))
    seed, node = (index.ravel() for index in np.indices(shape))
    steps, width = scenario.parameters.decisions, intents.range_m.shape[1]
    keys = seeds[seed], forest.seeds[forest.tree[at]][node], forest.step[at][node], steps
    draws = numbering.numbers(scenes).draws(node, *keys)
    intents = as_sent(point, point.prepared(intents.take(node)))
    ties = tie_draws(draws, stored.spec.ties)
    joules = stored.joules(scenes, point)[node]
    actions, costs = [], []
    for helpers in sets[:, :width]:
        schedule = np.broadcast_to(helpers, intents.valid.shape)
        messages = exchange(point, intents, draws, schedule)
        result = fuse(point, messages, intents, FusionInputs(ties=ties))
        actions.append(result.action.reshape(shape))
        of_set = {
            "messages": result.messages,
            "airtime_ms": 1e3 * result.airtime_s,
            "latency_ms": 1e3 * result.latency_s,
            "decisions": np.ones(len(node)),
            "energy_j": stored.energy_j(point, result, joules),
        }
        stacked = np.stack([of_set[name] for name in COSTS], -1)
        costs.append(stacked.reshape(*shape, len(COSTS)))
    return Level(at, np.stack(actions, -1), np.stack(costs, 2), intents, draws)
