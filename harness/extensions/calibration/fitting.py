"""`harness model calibrate`: fit what corrects a model's probabilities,
on a run on tune layouts.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.core.seeds import seeds_text
from harness.dataset import rebuilt
from harness.dataset.forest import Forest
from harness.evaluate.texts import refuse_others
from harness.extensions.calibration.calibrations import (
    COOLEST,
    HOTTEST,
    LEAST_PRIOR,
    WHAT,
    Calibration,
    Correction,
    Level,
)
from harness.runs.contradictions import sound
from harness.runs.fit import check_answerers, check_seeds, question_of, weights_of
from harness.runs.folder import Run
from harness.runs.records import FrozenScenes
from harness.runs.reliability import likelihood_nats
from harness.runs.run_dataset import check_episodes, check_scenes, dataset_of

TEMPERATURES = np.geomspace(COOLEST, HOTTEST, 241)  # that are tried: 2.5 % apart, and 1 among them
DIGITS = 6  # of a prior


@dataclass(frozen=True)
class Fitted:
    """Hold the correction of one role's answers, and how likely the optimal actions are by them.

    The role is who answered, `ego` or `helper`. `before_nats` and `after_nats` are the mean
    negative log-likelihood of the optimal actions, in nats, without and with the correction: less
    is better.
    """

    role: str  # `ego` or `helper`
    correction: Correction  # the fitted correction
    # mean negative log-likelihood of the optimal actions in nats, where any action is optimal
    before_nats: float
    after_nats: float


def fit(p: Floats, optimal: Bools, level: Level) -> Correction:
    """Fit a correction on n answers `p`, (n, A), and a mask of the optimal actions there, (n, A).

    An answer is the probabilities of A actions; an action is optimal if success is still possible
    after it. Level `L0` has a prior, the mean of all answers; `L1` the temperature with the best
    likelihood of optimal actions, of equal ones that nearest to 1; `L0+L1` both. Raises UserError
    for `L1` if no action is optimal anywhere.
    """
    prior: tuple[float, ...] = ()
    if "L0" in level:
        prior = tuple(np.maximum(p.mean(axis=0), LEAST_PRIOR).round(DIGITS).tolist())
    if "L1" not in level:
        return Correction(len(p), prior=prior)
    has_optimal = optimal.any(axis=1)
    if not has_optimal.any():
        raise UserError(
            "no action is optimal in any of its decision points; give a run with more layouts"
        )
    tried = TEMPERATURES[np.argsort(np.abs(np.log(TEMPERATURES)), kind="stable")].round(4)
    nats = [
        nats_of(Correction(len(p), t, prior).of(p[has_optimal]), optimal[has_optimal])
        for t in tried.tolist()
    ]
    return Correction(len(p), float(tried[int(np.argmin(np.round(nats, 9)))]), prior)


def nats_of(p: Floats, optimal: Bools) -> float:
    """Return the mean negative log-likelihood of the optimal actions, in nats.

    `p`, (n, A), has n answers, each the probabilities of A actions, and `optimal`, (n, A), is true
    of those after which success is still possible. Answers without an optimal action are left out.
    NaN if that leaves none.
    """
    return float(np.nanmean(likelihood_nats(p, optimal))) if optimal.any() else float("nan")


def calibrate(
    folder: Path, level: Level, dataset: Path | None, command: str
) -> tuple[Calibration, list[Fitted]]:
    """Fit the correction of a model's stated probabilities on the answers of a finished run.

    The run must be on layouts (start situations) that are for tuning. Returns the calibration,
    which has the corrections, and for each role that answered (`ego`, `helper`) how much its
    correction gains.

    Args:
        folder: the run's folder.
        level: what is fitted: `L0` a prior, `L1` a temperature, `L0+L1` both.
        dataset: the folder of the run's dataset; None for where the run says it is.
        command: the command as typed, which the calibration states.

    Raises UserError for layouts of another purpose, several models, sampled answers, or if no
    answer of the ego could be parsed.
    """
    run, name = sound(folder), printable(folder)
    manifest = run.manifest
    if not isinstance(manifest.world, FrozenScenes):
        raise UserError(
            f"{name} was driven, and no tree says what follows; give a run of `harness eval`"
        )
    check_answerers(run)
    answerers = manifest.answerers
    data = dataset_of(run, dataset).of_episodes(run.grid.episodes)
    forest = data.forest
    first, last = int(forest.seeds.min()), int(forest.seeds.max())
    check_seeds(name, WHAT, first, last)
    check_episodes(run, data)
    rebuilt.refuse(data)
    check_scenes(run, data)
    refuse_others(run)
    of_roles = [_of_role(run, role, forest, level) for role in ("ego", "helper")]
    fitted = [each for each in of_roles if each]
    if not fitted or fitted[0].role != "ego":
        raise UserError(f"{name}: no answer of the ego could be read, so there is nothing to fit")
    corrections = {each.role: each.correction for each in fitted}
    seeds = seeds_text(first, last - first + 1)
    calibration = Calibration(
        command=command,
        fitted_on=f"{manifest.variant.model} on {manifest.world.name}, {seeds}, "
        f"{amount(len(forest.seeds), 'layout')}",
        first_seed=first,
        last_seed=last,
        scenario=data.scenario.name,
        actions=tuple(run.actions),
        question=question_of({**manifest.agent(0), "model": answerers.model}),
        weights=weights_of(answerers.identity),
        level=level,
        ego=corrections["ego"],
        helper=corrections.get("helper"),
    )
    return calibration, fitted


def _of_role(run: Run, role: str, forest: Forest, level: Level) -> Fitted | None:
    read_answers = [a for a in run.answers if a.role == role and a.intent]
    if not read_answers:
        return None
    p = np.array([a.intent for a in read_answers], dtype=float)
    optimal = forest.safe[[forest.place[a.scene] for a in read_answers]]
    correction = fit(p, optimal, level)
    return Fitted(role, correction, nats_of(p, optimal), nats_of(correction.of(p), optimal))
