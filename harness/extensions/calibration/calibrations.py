"""Correct the probabilities of answers by what was fitted on tune layouts:
files `calibrations/*.toml`.

`harness model calibrate` writes one. What it holds is frozen, for one model and one question: the
weights, the prompt, the answer mode, the scenario and the role. It may hold two things. A prior,
the mean answer over tune questions, is divided out (Zhou and others 2023, "batch calibration"): it
needs no tree. A temperature sharpens or flattens what is left (Guo and others 2017): its likelihood
of the optimal actions is the best. Both leave an answer that could not be read as it is.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from harness.coordination.intents import Intents
from harness.core import resources
from harness.core.arrays import Floats
from harness.core.config import Count, convert, toml
from harness.core.errors import UserError, printable, unknown
from harness.core.files import read_once
from harness.runs.fit import Fit, check_seeds

FOLDER = "calibrations"
COOLEST, HOTTEST = 0.05, 20.0  # temperatures
OFF = 2e-4  # of a prior's sum, for each action: the least prior and rounding
LEAST_PRIOR = 1e-4  # a prior below counts as that: less would let one answer in 10 000 decide all
Level = Literal["L0", "L1", "L0+L1"]
WHAT = "calibration"  # in messages


@dataclass(frozen=True)
class Correction:
    """Hold a correction that makes one role's stated probabilities fit how often they are right.

    An answer is a probability for each of A actions, and a role is who gives it: the ego (the car
    that decides), or a helper that it asks. First the `prior`, each action's mean probability (A,),
    is divided out; then probabilities are raised to 1 / `temperature` and scaled to sum to 1.
    """

    answers: Count  # number of answers that it was fitted on
    # probabilities are raised to 1 / temperature and scaled to sum to 1; 1 changes nothing
    temperature: Annotated[float, Meta(ge=COOLEST, le=HOTTEST)] = 1.0
    # the mean answer, a probability an action; empty where none is divided out
    prior: tuple[Annotated[float, Meta(ge=LEAST_PRIOR, le=1)], ...] = ()

    def of(self, p: Floats) -> Floats:
        """Return corrected answers `(..., A)`, given probabilities of A actions, `(..., A)`.

        A failed answer, a row of NaN, stays as it is.
        """
        powers = (p / np.array(self.prior or 1.0)) ** (1.0 / self.temperature)
        total = powers.sum(axis=-1, keepdims=True)
        return np.where(total > 0, powers / np.where(total > 0, total, 1.0), p)


@dataclass(frozen=True, kw_only=True)
class Calibration(Fit):
    """Hold a file of `calibrations/`: corrections of one model's stated probabilities.

    `obstacle` and `obstacle_of_models` say for which model, prompt and scenario they hold.
    """

    level: Level  # L0 divides a prior out, L1 has a temperature, L0+L1 both
    ego: Correction  # of the ego's answers
    helper: Correction | None = None  # of helpers' answers; None where no helper answered

    def of(self, intents: Intents) -> Intents:
        """Return a copy of what vehicles intend, with the ego's and the helpers' answers corrected.

        An intent is the probabilities that a vehicle gives to the ego's actions; `intents` has
        arrays of them for the ego and its helpers. Those of helpers stay as they are if `helper` is
        None.
        """
        helpers = self.helper.of(intents.helpers) if self.helper else intents.helpers
        return replace(intents, own=self.ego.of(intents.own), helpers=helpers)


def names() -> list[str]:
    """Return the names of all files of `calibrations/`, those that ship and the project's.

    A calibration corrects a model's stated probabilities.
    """
    return resources.names(FOLDER)


def file_of(name: str) -> Any:
    """Return the path of a calibration's file, by its name.

    A calibration corrects a model's stated probabilities. Raises UserError if it is unknown.
    """
    if name not in names():
        raise unknown("calibration", name, names(), "; `harness model calibrate` makes one")
    return resources.find(FOLDER, f"{name}.toml")


def calibration(name: str) -> Calibration:
    """Load what corrects one model's stated probabilities, by the name of its file.

    Raises UserError if it is unknown or its file is wrong.
    """
    return _read(file_of(name))


@read_once
def _read(path: Any) -> Calibration:
    where = f"calibration file {printable(path)}"
    calibration = convert(toml(path, where), Calibration, where)
    check_seeds(where, WHAT, calibration.first_seed, calibration.last_seed)
    for correction in filter(None, (calibration.ego, calibration.helper)):
        if len(correction.prior) not in (0, len(calibration.actions)):
            raise UserError(
                f"{where}: prior has {len(correction.prior)} values; give one an action, or none"
            )
        if correction.prior and abs(sum(correction.prior) - 1) > OFF * len(correction.prior):
            raise UserError(
                f"{where}: prior sums to {sum(correction.prior):g}, not 1; fit it again"
            )
        if bool(correction.prior) != ("L0" in calibration.level):
            raise UserError(
                f"{where}: level {calibration.level} goes with a prior if it has L0; fit it again"
            )
        if correction.temperature != 1 and "L1" not in calibration.level:
            raise UserError(
                f"{where}: level {calibration.level} has no temperature but 1; fit it again"
            )
    return calibration
