"""Audit whether a scenario gives its hidden danger away:
what the ego sees must not tell what it cannot see.

A small classifier learns, from the numbers of the ego's own scene graph while the danger is out of
sight, whether there is a danger and where it comes from. A layout is never on both sides of the
cross-validation. Only decision points of one step are compared, since fewer dangers are still
hidden at later steps, and only answers of one fold's model. If the classifier does better than
chance, any model can: then an ego alone is not blind.

Beacons of traffic (`radio_share`) are left out: who hears the car that would be the danger, and
hears that it is none, knows that and has not guessed it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from harness.core import extras, noise
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError
from harness.core.parallel import Workers, spread
from harness.core.statistics import Estimate, wilson
from harness.world.drivers import choose
from harness.world.perception.graph import scene_graph
from harness.world.scenario import Scenario
from harness.world.scene_numbers import numbers
from harness.world.world import World

MOST_AUC = 0.60  # above it, a scenario gives its danger away
LEAST_AUC_LOST = 0.01  # a number is named if shuffling it costs at least this much AUC
FOLDS = 5
RESAMPLES = 1999
BLIND = ("cruise", "local-view")  # drivers that cannot know of what the ego does not see
DANGER, NONE = "danger", ""
# a danger's sector; steps and numbers
Hidden = tuple[str, list[tuple[int, dict[str, float | None]]]]


@dataclass(frozen=True)
class Audit:
    """Hold how well what the ego sees predicts the hidden danger of a scenario, and by what.

    The ego is the car that decides, and the danger the vehicle that it would meet if it kept its
    speed. The danger is out of sight at first, so a scenario is fair only if nothing in sight tells
    whether it is there. A sector (left, right, oncoming) is where it can come from. A step is a
    decision of an episode, numbered from 0. An AUC is 0.5 for a guess and 1 for certainty.
    """

    scenario: str  # name of the scenario
    layouts: int  # number of layouts, drawn start situations
    seed: int  # layout seed of the first one
    # numbers, from 0, of the decisions that were compared: those at which at least half of the
    # dangers are hidden. Later, an empty road is an observation and gives nothing away
    steps: tuple[int, ...]
    # for each question (`danger`, and each sector that it can come from) the AUC: probability that
    # a layout with it ranks above one without. Intervals are a bootstrap over layouts, for these
    # models
    auc: Mapping[str, Estimate]
    # numbers of the ego's scene graph (what it knows of the scene) that give the danger away, by
    # name, with the AUC lost without each; empty unless an AUC is above `MOST_AUC`
    told_by: Mapping[str, float]

    @property
    def worst(self) -> str:
        return max(self.auc, key=lambda question: self.auc[question].value)

    @property
    def tells(self) -> bool:
        return self.auc[self.worst].value > MOST_AUC


@dataclass(frozen=True)
class HiddenPoints:
    """Hold m decision points, some for each layout, at which the danger is out of the ego's sight.

    A decision point is one situation in which the ego must act; a layout is a drawn start
    situation. The danger is the vehicle that the ego would meet if it kept its speed. Each point
    has k numbers that the ego's scene graph (what it knows of the scene) states, such as speeds and
    distances.
    """

    layout: Ints  # index of each point's layout (start situation), (m,)
    step: Ints  # index of its decision in the episode, (m,)
    danger: Any  # NumPy array: sector that its danger comes from, (m,); `NONE` without a danger
    names: tuple[str, ...]  # name of each of the k numbers
    numbers: Floats  # numbers of the scene graphs, (m, k); NaN if the ego does not know one


def audit(
    scenario: Scenario,
    layouts: int,
    seed: int,
    progress: Callable[[int], None],
    workers: Workers = 1,
) -> Audit:
    """Test, in simulated layouts, whether what the ego sees gives a scenario's hidden danger away.

    A layout is a start situation. There are `layouts` of them, with layout seeds `seed` to `seed +
    layouts - 1`. `progress` is called with the number of layouts just done; `workers` is the number
    of processes, or a cluster. Raises UserError without scikit-learn, or if too few layouts have a
    danger, or too few have none.
    """
    extras.need("an audit", "sklearn")
    seeds = range(seed, seed + layouts)
    silent = replace(scenario, parameters=replace(scenario.parameters, radio_share=0.0))
    points = _selected(spread(partial(_hidden, silent), seeds, workers, progress), scenario)
    auc, told_by = judge(points, tuple(scenario.road().sectors))
    return Audit(scenario.name, layouts, seed, tuple(np.unique(points.step).tolist()), auc, told_by)


def _hidden(scenario: Scenario, seed: int) -> Hidden:
    """Return the sector of a layout's danger,
    and the ego's numbers at every step until it is in sight.

    A braking vehicle counts as the danger in sight, since it may brake for the danger.
    """
    start = World.start(scenario, seed)
    branches: list[tuple[World, tuple[str, ...]]] = [(start, BLIND)]
    hidden = []
    while branches:
        world, drivers = branches.pop()
        if world.outcome.ended or world.step >= scenario.parameters.decisions:
            continue
        graph = scene_graph(scenario, world.state(), world.layout.spawns[0].id)
        if any(node.id == world.layout.danger_id or node.braking for node in graph.nodes):
            continue
        hidden.append((world.step, dict(numbers(graph, scenario.road()))))
        ways: dict[str, tuple[str, ...]] = {}
        for driver in drivers:
            action = choose(scenario, driver, graph, None)
            ways[action] = (*ways.get(action, ()), driver)
        for action, some in ways.items():
            on = world if len(ways) == 1 else world.branch()
            on.act(action)
            branches.append((on, some))
    return start.layout.danger or NONE, hidden


def _selected(layouts: list[Hidden], scenario: Scenario) -> HiddenPoints:
    """Return all layouts' decision points at the steps where at least half of the dangers are
    hidden.
    """
    dangers = sum(danger != NONE for danger, _ in layouts)
    for count, what in ((dangers, "have a danger"), (len(layouts) - dangers, "have none")):
        if count < FOLDS:
            raise UserError(
                f"{count} of {len(layouts)} layouts of {scenario.name} {what}; an audit needs "
                f"{FOLDS}, give more with --layouts"
            )
    hidden = [0] * scenario.parameters.decisions
    for there, points in layouts:
        if there != NONE:
            for at in {at for at, _ in points}:
                hidden[at] += 1
    steps = [k for k, count in enumerate(hidden) if 2 * count >= dangers]
    rows = [
        (layout, step, danger, values)
        for layout, (danger, points) in enumerate(layouts)
        for step, values in points
        if step in steps
    ]
    if not rows:
        raise UserError(
            f"scenario {scenario.name} hides no danger: most are in sight from the start, so there "
            "is nothing to audit"
        )
    layout, step, danger, values = zip(*rows, strict=True)
    table = np.array([list(row.values()) for row in values], dtype=float)
    return HiddenPoints(np.array(layout), np.array(step), np.array(danger), tuple(values[0]), table)


def judge(
    points: HiddenPoints, sectors: tuple[str, ...]
) -> tuple[dict[str, Estimate], dict[str, float]]:
    """Test whether what the ego sees predicts the danger that it cannot see; say how well.

    The danger is the vehicle that the ego would meet if it kept its speed. A scenario is fair only
    if nothing in sight tells that it is there, or from which sector (left, right, oncoming) it
    comes. Classifiers (boosted trees) learn that from numbers of the ego's view in some layouts
    (start situations), and score the others.

    Args:
        points: the situations in which the ego must act, with the numbers that it knows there and
            the true danger.
        sectors: the names of the sectors that the danger can come from.

    Returns:
        By question (`danger`, is there one; or a sector, does it come from there) the AUC with its
        95 % interval: the probability that a layout where it is true scores above one where it is
        not. And, if one AUC is above `MOST_AUC`, by name the numbers without which it falls most,
        with by how much; else an empty dict.
    """
    from sklearn.ensemble import HistGradientBoostingClassifier
    from sklearn.model_selection import StratifiedGroupKFold

    layout, step, danger = points.layout, points.step, points.danger
    is_known, classes = ~np.isnan(points.numbers), np.unique(danger)
    folds = list(
        StratifiedGroupKFold(FOLDS, shuffle=True, random_state=0).split(is_known, danger, layout)
    )
    # Learning fails on a number that is unknown wherever a model learns.
    varies = []
    for k, column in enumerate(points.numbers.T):
        known_where_learnt = all(is_known[learnt, k].any() for learnt, _ in folds)
        if known_where_learnt and len(np.unique(column[is_known[:, k]])) > 1:
            varies.append(k)
    table, names = points.numbers[:, varies], [points.names[k] for k in varies]
    trees = partial(
        HistGradientBoostingClassifier, max_leaf_nodes=8, early_stopping=False, random_state=0
    )
    models = [trees(max_iter=40).fit(table[learnt], danger[learnt]) for learnt, _ in folds]

    def answers(table: Floats) -> Floats:
        """Return probabilities (m, classes), each by the model that has not seen its layout."""
        scores = np.zeros((len(table), len(classes)))
        for model, (_, tested) in zip(models, folds, strict=True):
            columns = np.searchsorted(classes, model.classes_)
            scores[np.ix_(tested, columns)] = model.predict_proba(table[tested])
        return scores

    model_of = np.empty(len(layout), dtype=int)
    for k, (_, tested) in enumerate(folds):
        model_of[tested] = k
    alike = step * FOLDS + model_of  # scores of two models do not compare

    def ranks(question: str, scores: Floats) -> "Ranks":
        score = scores[:, classes == (NONE if question == DANGER else question)][:, 0]
        if question == DANGER:
            return Ranks.compare(layout, alike, 1 - score, danger != NONE)
        return Ranks.compare(layout, alike, score, danger == question)

    scores = answers(table)
    counts = {sector: len(np.unique(layout[danger == sector])) for sector in sectors}
    questions = [DANGER, *(sector for sector, count in counts.items() if count >= FOLDS)]
    auc = {question: ranks(question, scores).estimate() for question in questions}
    worst = max(auc, key=lambda question: auc[question].value)
    lost: dict[str, float] = {}
    if auc[worst].value > MOST_AUC:
        for k, name in enumerate(names):
            shuffled = table.copy()
            shuffled[:, k] = _shuffled(table[:, k], step, name)
            lost[name] = auc[worst].value - ranks(worst, answers(shuffled)).auc
    most = sorted(lost, key=lambda name: -lost[name])[:5]
    return auc, {name: lost[name] for name in most if lost[name] > LEAST_AUC_LOST}


def _shuffled(column: Floats, step: Ints, name: str) -> Floats:
    shuffled, draws = column.copy(), noise.generator("audit", name)
    for k in np.unique(step):
        at = np.flatnonzero(step == k)
        shuffled[at] = column[draws.permutation(at)]
    return shuffled


@dataclass(frozen=True)
class Ranks:
    """Hold how often layouts with the danger in question score higher than layouts without it.

    A layout is a start situation; the danger in question is any, or one from a certain sector
    (left, right, oncoming), and a score is its predicted probability. Arrays are (with, without): a
    row for each layout with the danger and a column for each without.
    """

    # number of pairs of points in which the layout with it ranks higher, (with, without); a tie
    # counts half
    above: Floats
    pairs: Floats  # number of all compared pairs of points, (with, without)

    @classmethod
    def compare(cls, layout: Ints, alike: Ints, score: Floats, there: Bools) -> "Ranks":
        """Compare scores of m decision points, of layouts with the danger in question and without.

        All arrays are (m,). `layout` is the number of each point's layout (start situation), and
        `score` the predicted probability of the danger. `alike` is the number of the point's group:
        only scores of one group compare, those of one step and one trained model. `there` is
        whether the layout has the danger. Returns the counts of pairs by layout.
        """
        have, have_not = np.unique(layout[there]), np.unique(layout[~there])
        above, pairs = np.zeros((2, len(have), len(have_not)))
        for k in np.unique(alike):
            with_it, without = (np.flatnonzero((alike == k) & side) for side in (there, ~there))
            at = np.ix_(
                np.searchsorted(have, layout[with_it]), np.searchsorted(have_not, layout[without])
            )
            apart = score[with_it][:, None] - score[without]
            np.add.at(above, at, (apart > 0) + 0.5 * (apart == 0))
            np.add.at(pairs, at, 1.0)
        return cls(above, pairs)

    @property
    def auc(self) -> float:
        return float(self.above.sum() / self.pairs.sum())

    def estimate(self) -> Estimate:
        """Return the AUC: the probability that a layout with the danger scores above one without.

        A layout is a start situation, and the danger a vehicle that the ego would meet. The 95 %
        interval has the percentiles of a bootstrap over the layouts, whose number is its `n`.
        """
        have, have_not = self.pairs.shape
        draws = noise.generator("audit", "bootstrap")
        times = draws.multinomial(have, np.full(have, 1 / have), RESAMPLES)
        times_not = draws.multinomial(have_not, np.full(have_not, 1 / have_not), RESAMPLES)
        above, pairs = (((times @ of) * times_not).sum(axis=1) for of in (self.above, self.pairs))
        low, high = np.quantile((above / pairs)[pairs > 0], [0.025, 0.975])
        if low == high:  # AUC of 0 or 1: resampled layouts cannot differ
            low, high = wilson(self.auc, min(have, have_not))
        return Estimate(self.auc, float(low), float(high), have + have_not, 0)


class OfDatasets:
    """Audit a scenario while `harness dataset build` makes a dataset of it.

    An audit tests whether what the ego sees gives the hidden danger away. `ready` raises UserError
    where scikit-learn is missing. `found` runs the audit on `layouts` start situations with layout
    seeds from `seed` on, and returns its result as a sentence for the dataset's README.
    """

    def ready(self) -> None:
        extras.need("an audit", "sklearn")

    def found(
        self,
        scenario: Scenario,
        layouts: int,
        seed: int,
        progress: Callable[[int], None],
        workers: Workers,
    ) -> str:
        auc = audit(scenario, layouts, seed, progress, workers).auc[DANGER]
        return (
            "Whether there is a hidden danger can be told from what the ego sees with an AUC of "
            f"{auc.value:.2f} [{auc.low:.2f}, {auc.high:.2f}]\n(`harness dataset scenario audit`, "
            f"n = {auc.n} layouts; .50 is a guess)."
        )


OF_DATASETS = OfDatasets()
