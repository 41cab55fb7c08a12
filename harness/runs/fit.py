"""Say for what a fit holds: the model, prompt and scenario on whose tune layouts it was made."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from harness.core.config import loads
from harness.core.errors import UserError, printable
from harness.core.files import canonical_json, digest, write_whole
from harness.core.seeds import purposes, seeds_text
from harness.runs.folder import Run
from harness.world.scenario import Scenario

OF_MODEL = ("name", "engine", "weights", "file", "revision", "sha256", "quantisation", "adapter")
WORDS = ("command", "fitted_on")  # of a fit, which decide nothing
OF_QUESTION = ("answer", "letters", "image", "sums", "thinking")


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Hold what a file states that was fitted on a model's answers; a base class.

    It holds for one model, prompt and answer mode (`question`) and one scenario, and was fitted on
    start situations (layouts) that are drawn by the layout seeds `first_seed` to `last_seed`.
    """

    command: str  # the command that made the file
    # in words: the run whose answers were used, and its layouts (start situations)
    fitted_on: str
    first_seed: int  # least layout seed that it was fitted on
    last_seed: int  # greatest layout seed
    scenario: str  # name of the scenario
    actions: tuple[str, ...]  # names of its meta-actions, in the order of answers
    question: dict[str, str]  # what answers: model, prompt and answer mode (`question_of`)
    # digests of the model's weights and what else tells them apart; a file before 0.4.0 has none
    weights: dict[str, str] = field(default_factory=dict)

    def obstacle(self, agent: Mapping[str, Any], scenario: Scenario) -> str | None:
        """Return in words why this fit must not be used on an agent's answers; None if it may.

        An agent is a model with its prompt and answer mode, as which the fit was made; `agent` has
        its settings by name, as `run.json` states them. `scenario` is where it answers.
        """
        of_scenario = {"scenario": scenario.name, "actions": " ".join(scenario.actions)}
        now = {**question_of(agent), **of_scenario}
        then = {**self.question, "scenario": self.scenario, "actions": " ".join(self.actions)}
        if unlike := first_unlike(then, now):
            name, value, other = unlike
            return f"was fitted with {name} {printable(value, 40)}, not {printable(other, 40)}"
        return None

    def obstacle_of_models(self, identities: Iterable[Mapping[str, Any]]) -> str | None:
        """Return in words that these are other weights than it was fitted on; None if not.

        `identities` tell models apart, by what `Backend.identity` states of each.
        """
        for identity in identities if self.weights else ():
            if unlike := first_unlike(self.weights, weights_of(identity)):
                name, value, other = unlike
                value, other = printable(value, 12), printable(other, 12)
                return f"was fitted on other weights ({name} {value}, not {other})"
        return None


def is_alike(one: bytes, other: bytes) -> bool:
    """Return whether two files of fits are the same, but for words that decide nothing."""
    if one == other:
        return True
    try:
        tables = [loads(data.decode("utf-8-sig"), "") for data in (one, other)]
    except (UserError, UnicodeDecodeError):
        return False
    for table in tables:
        for name in WORDS:
            table.pop(name, None)
    return canonical_json(tables[0]) == canonical_json(tables[1])


def first_unlike(
    then: Mapping[str, Any], now: Mapping[str, Any]
) -> tuple[str, object, object] | None:
    """Return the first name whose value is another now, with both values; None if all are alike.

    What a mapping lacks, such as an adapter that the model had not then, is None.
    """
    for name in {**then, **now}:
        if then.get(name) != now.get(name):
            return name, then.get(name), now.get(name)
    return None


def question_of(agent: Mapping[str, Any]) -> dict[str, str]:
    """Return the settings of an agent for which a fit is valid, as texts by dotted name.

    An agent is a model with its prompt and answer mode. `agent` has its settings as `run.json`
    states them: tables `model` and `prompt`, and values such as `answer`. A key of the result is,
    for example, `prompt.sha256`.
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


def check_seeds(where: str, what: str, first: int, last: int) -> None:
    """Raise UserError unless the layout seeds `first` to `last` are all for tuning.

    A layout seed draws a start situation, and its range says what for: tuning, training or reports.
    `where` names in the message where the seeds stand, such as a file, and `what` is fitted on
    them, such as `calibration`.
    """
    if not 0 <= first <= last or purposes(first, last - first + 1) != ["tune"]:
        raise UserError(
            f"{where}: {what} is fitted on tune seeds, and these are "
            f"{seeds_text(first, max(last - first, 0) + 1)}"
        )


def check_answerers(run: Run) -> None:
    """Raise UserError unless one model gave all answers of a run, and each is its likeliest."""
    name, answerers = printable(run.path), run.manifest.answerers
    if answerers.helpers is None or answerers.temperature is None:
        raise UserError(
            f"{name}: it replays another run's answers, and does not state how they were asked; "
            "give that run"
        )
    if answerers.helpers or answerers.temperature:
        of_others = "its helpers have a model of their own"
        reason = of_others if answerers.helpers else "its answers are sampled"
        raise UserError(f"{name}: {reason}; give a run with one model, whose answers are greedy")


def write(fit: Fit, out: Path) -> None:
    """Write what a file of a fit states to the TOML file `out`, tables last."""
    members = {name: value for name, value in asdict(fit).items() if value is not None}
    tables = {name: value for name, value in members.items() if isinstance(value, dict) and value}
    lines = [f"{k} = {json.dumps(v)}" for k, v in members.items() if not isinstance(v, dict)]
    for name, table in tables.items():
        values = [f"{json.dumps(k)} = {json.dumps(v)}" for k, v in table.items()]
        lines += ["", f"[{name}]", *values]
    write_whole(out, "\n".join([*lines, ""]))
