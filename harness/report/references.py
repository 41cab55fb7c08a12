"""What a model is held against and needs none:
reference drivers, and an ego that looks at nothing.
"""

from collections.abc import Iterable, Mapping

from harness.backends.registry import ENGINES
from harness.core.arrays import Floats
from harness.core.statistics import rate_interval
from harness.dataset.load import Dataset
from harness.report.words import score_texts
from harness.runs.estimates import halved
from harness.runs.folder import Run
from harness.runs.headline import SUCCESS
from harness.runs.metric_values import by_danger, known_in
from harness.runs.records import Score
from harness.world.drivers import CONSTANT, OPEN_LOOP, UNIFORM, constant
from harness.world.scenario import Scenario

BESIDE = (OPEN_LOOP, CONSTANT, UNIFORM)  # rows beside a model's on the terminal, the best first


def in_trees(dataset: Dataset) -> dict[str, dict[str, Score]]:
    """Return the success of each reference driver, computed from a dataset's decision trees.

    A reference driver is a rule that needs no model. A decision tree has every course that actions
    can lead to from one start situation, and how it ends. The result maps the driver's name to
    scores by metric: success rate and, where dangers are known, balanced success (mean over layouts
    with and without a danger) and its halves. A danger is a vehicle that would meet an ego which
    keeps its speed.
    """
    clusters = dataset.clusters

    def scores(reference: str, success: Floats) -> dict[str, Score]:
        values = {SUCCESS: success, **by_danger(success, dataset.dangerous)}
        of_reference = {}
        for metric in known_in(values):
            rate = halved(
                metric, lambda half: rate_interval(values[half], clusters), clusters=clusters
            )
            of_reference[metric] = Score.of(reference, metric, rate, "episodes")
        return of_reference

    return {name: scores(name, success) for name, success in dataset.reference_success().items()}


def driven(runs: Iterable[Run], metric: str) -> dict[str, Score]:
    """Return a metric's score of each run that a reference driver decided, by the driver's name.

    Such a driver is a rule that needs no model. Runs of models, and runs without a value, are left
    out.
    """
    scores = {}
    for run in runs:
        engine = ENGINES.get(str(run.manifest.model.get("engine")))
        if engine and engine.capabilities.reference:
            scores[str(run.manifest.model["name"])] = run.score(run.conditions[0], metric)
    return {name: score for name, score in scores.items() if score and score.value is not None}


def label(name: str, scenario: Scenario) -> str:
    """Return a reference driver's display name; that of `constant` includes the action it takes.

    A reference driver is a rule that needs no model; `name` is its name, and `scenario` says which
    action that is.
    """
    action = constant(scenario) if name == CONSTANT else None
    return f"{name} {action}" if action else name


def meaning(name: str, exact: bool = True) -> str:
    """Return a sentence on what a reference driver of `BESIDE` does, which looks at nothing.

    Such a driver is a rule without a model; `name` is its name. `exact`: whether its success was
    computed from decision trees (all that actions lead to), and not estimated from a run.
    """
    exactly = "by the trees; a run of it draws"
    return {
        OPEN_LOOP: "open-loop: always the same sequence of actions, the best in tune layouts",
        CONSTANT: "constant: always the action that did best in the scenario's tune layouts",
        UNIFORM: f"uniform: every action equally likely, "
        f"{exactly if exact else 'drawn in its run'}",
    }[name]


def sentences(references: Mapping[str, Score], scenario: Scenario, exact: bool) -> str:
    """Return a caption's sentences on reference drivers: each one's success, and what it does.

    A reference driver is a rule without a model; `references` has the success of each by its name,
    and the best is named first. Empty without references. `exact` says whether success was computed
    from decision trees, which have all that actions lead to, and not estimated from a run.
    """
    if not references:
        return ""
    rates = []
    for name in sorted(references, key=lambda name: -(references[name].value or 0.0)):
        cell = score_texts(references[name])
        rates.append(f"{label(name, scenario)} {cell['value']} ({cell['interval']})")
    n = next(iter(references.values())).n
    text = (
        f" Dashed: references that need no model, in the same episodes: {', '.join(rates)}; n = "
        f"{n}."
    )
    meanings = [f"{meaning(name, exact)}." for name in BESIDE if name in references]
    return " ".join([text, *meanings])
