"""Correct the probabilities of answers by what was fitted on tune layouts:
files `calibrations/*.toml`.

`harness model calibrate` writes one. What it holds is frozen, for one model and one question: the
weights, the prompt, the answer mode, the scenario and the role. It may hold two things. A prior,
the mean answer over tune questions, is divided out (Zhou and others 2023, "batch calibration"): it
needs no tree. A temperature sharpens or flattens what is left (Guo and others 2017): its likelihood
of the optimal actions is the best. Both leave an answer that could not be read as it is.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from harness.coordination.intents import Intents
from harness.core import resources
from harness.core.arrays import Floats
from harness.core.config import Count, convert, toml
from harness.core.errors import UserError, printable, unknown
from harness.core.files import digest, read_once
from harness.core.seeds import purposes, seeds_text
from harness.world.scenario import Scenario

FOLDER = "calibrations"
COOLEST, HOTTEST = 0.05, 20.0  # temperatures
OFF = 2e-4  # of a prior's sum, for each action: the least prior and rounding
LEAST_PRIOR = 1e-4  # a prior below counts as that: less would let one answer in 10 000 decide all
OF_MODEL = ("name", "engine", "weights", "file", "revision", "sha256", "quantisation", "adapter")
OF_QUESTION = ("answer", "letters", "image", "sums", "thinking")
Level = Literal["L0", "L1", "L0+L1"]
ONLY_TUNE = "calibration is fitted on tune seeds"


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


@dataclass(frozen=True)
class Calibration:
    """Hold a file of `calibrations/`: corrections of one model's stated probabilities.

    They hold for one model, prompt and answer mode (`question`) and one scenario, and were fitted
    on start situations (layouts) that are drawn by the layout seeds `first_seed` to `last_seed`.
    """

    level: Level  # L0 divides a prior out, L1 has a temperature, L0+L1 both
    command: str  # the command that made the file
    # in words: the run whose answers were used, and its layouts (start situations)
    fitted_on: str
    first_seed: int  # least layout seed that it was fitted on
    last_seed: int  # greatest layout seed
    scenario: str  # name of the scenario
    actions: tuple[str, ...]  # names of its meta-actions, in the order of answers
    question: dict[str, str]  # what answers: model, prompt and answer mode (`question_of`)
    ego: Correction  # of the ego's answers
    helper: Correction | None = None  # of helpers' answers; None where no helper answered
    # digests of the model's weights and what else tells them apart; a file before 0.4.0 has none
    weights: dict[str, str] = field(default_factory=dict)

    def obstacle(self, agent: Mapping[str, Any], scenario: Scenario) -> str | None:
        """Return in words why this calibration must not correct an agent's answers; None if it may.

        An agent is a model with its prompt and answer mode, as which the calibration was fitted;
        `agent` has its settings by name, as `run.json` states them. `scenario` is where it answers.
        """
        of_scenario = {"scenario": scenario.name, "actions": " ".join(scenario.actions)}
        now = {**question_of(agent), **of_scenario}
        then = {**self.question, "scenario": self.scenario, "actions": " ".join(self.actions)}
        # the model may have an adapter, or a pinned file, that it had not then
        for name in then | now:
            value, other = then.get(name), now.get(name)
            if value != other:
                return f"was fitted with {name} {printable(value, 40)}, not {printable(other, 40)}"
        return None

    def obstacle_of_models(self, identities: Iterable[Mapping[str, Any]]) -> str | None:
        """Return in words that these are other weights than it was fitted on; None if not.

        `identities` tell models apart, by what `Backend.identity` states of each.
        """
        for identity in identities if self.weights else ():
            now = weights_of(identity)
            for name in {**self.weights, **now}:
                value, other = self.weights.get(name), now.get(name)
                if value != other:
                    value, other = printable(value, 12), printable(other, 12)
                    return f"was fitted on other weights ({name} {value}, not {other})"
        return None

    def of(self, intents: Intents) -> Intents:
        """Return a copy of what vehicles intend, with the ego's and the helpers' answers corrected.

        An intent is the probabilities that a vehicle gives to the ego's actions; `intents` has
        arrays of them for the ego and its helpers. Those of helpers stay as they are if `helper` is
        None.
        """
        helpers = self.helper.of(intents.helpers) if self.helper else intents.helpers
        return replace(intents, own=self.ego.of(intents.own), helpers=helpers)


def question_of(agent: Mapping[str, Any]) -> dict[str, str]:
    """Return the settings of an agent for which a calibration is valid, as texts by dotted name.

    An agent is a model with its prompt and answer mode, and a calibration corrects its
    probabilities. `agent` has its settings as `run.json` states them: tables `model` and `prompt`,
    and values such as `answer`. A key of the result is, for example, `prompt.sha256`.
    """
    model, prompt = agent["model"], agent["prompt"]
    return {
        **{f"model.{key}": str(model[key]) for key in OF_MODEL if model.get(key) is not None},
        **{f"prompt.{key}": str(prompt[key]) for key in ("version", "sha256")},
        **{key: str(agent[key]) for key in OF_QUESTION},
    }


def weights_of(identity: Mapping[str, Any]) -> dict[str, str]:
    """Return what tells a model's weights apart, as texts by name, of its identity.

    They are digests of files, a commit on the hub, and what a server states of its model.
    """
    texts = {}
    for name, value in identity.items():
        if value and (name.endswith("sha256") or name == "revision"):
            texts[name] = str(value)
        elif value and name == "states":
            texts[name] = digest(value)
    return texts


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
    check_seeds(where, calibration.first_seed, calibration.last_seed)
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


def check_seeds(what: str, first: int, last: int) -> None:
    """Raise UserError unless the layout seeds `first` to `last` are all for tuning.

    A layout seed draws a start situation, and its range says what for: tuning, training or reports.
    `what` names in the message where the seeds stand, such as a file.
    """
    if not 0 <= first <= last or purposes(first, last - first + 1) != ["tune"]:
        raise UserError(
            f"{what}: {ONLY_TUNE}, and these are {seeds_text(first, max(last - first, 0) + 1)}"
        )
