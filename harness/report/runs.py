"""The runs that one report holds side by side."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.core.errors import UserError, printable
from harness.dataset.load import Dataset
from harness.runs.driven_folder import LIVE, Driven, driven
from harness.runs.folder import FROZEN, Run, answers_of, dataset_of, read
from harness.world import scenarios
from harness.world.scenario import Scenario

# What a page reads of each decision, of each of its messages, and of each answer.
DECISION = ("entropy_nats", "triggered", "own_weight", "own_failed", "latency_ms", "deadline_missed")
MESSAGE = ("from", "delivered", "on_time", "arrival_ms", "weight")
ANSWER = ("role", "raw", "status", "verdict", "repairs", "detail", "intent")


@dataclass(frozen=True)
class Runs:
    """Finished runs on the same scenes, all frozen or all live.

    Attributes:
        runs: in the order given.
        names: what to call each: model, prompt and, where that is no name yet, more. No two are the same.
        dataset: where the scenes of frozen runs are from; None for live runs.
    """

    runs: tuple[Run, ...]
    names: tuple[str, ...]
    dataset: Dataset | None

    @property
    def live(self) -> bool:
        """Whether they were driven live."""
        return self.dataset is None

    @property
    def actions(self) -> tuple[str, ...]:
        """Meta-actions, in the order of every distribution."""
        return tuple(self.runs[0].config["actions"])

    @property
    def scenario(self) -> Scenario:
        """What they decided in."""
        if self.dataset is not None:
            return self.dataset.scenario
        return scenarios.get(self.runs[0].config["scenario"]["name"])

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of all operating points."""
        return tuple(dict.fromkeys(name for run in self.runs for name in run.conditions))


def gather(paths: Sequence[Path]) -> Runs:
    """Read runs to be reported together.

    Raises:
        UserError: a folder is no run, its dataset is gone or has changed, or two are not of the same scenes.
    """
    found = []
    for path in dict.fromkeys(paths):
        run = read(path, FROZEN, LIVE)
        _check(run)
        found.append(driven(run) if run.config["format"] == LIVE.format else run)
    first, *others = found
    for other in others:
        one, two = _scenes(first), _scenes(other)
        if one != two:
            raise UserError(
                f"{printable(first.path)} and {printable(other.path)} are not of the same scenes "
                f"({_shown(first)} and {_shown(other)}); report them apart"
            )
    dataset = None if isinstance(first, Driven) else dataset_of(first)
    return Runs(tuple(found), _names(found), dataset)


def _check(run: Run) -> None:
    """Raises UserError for a row that says less, or something else, than its run's manifest lets it."""
    actions, conditions, seeds = run.config["actions"], run.conditions, run.config["seeds"]
    for n, row in enumerate(run.rows, 1):
        try:
            for d in row["decisions"]:
                known = d["action"] in actions and d["condition"] in conditions and d["seed"] in seeds
                if not known or len(d["fused"]) != len(actions):
                    raise ValueError(f"a decision of {d['condition']!r} with seed {d['seed']!r}")
                missing = {key for key in DECISION if key not in d}
                missing |= {key for m in d["messages"] for key in MESSAGE if key not in m}
                _need(missing)
            _need({key for a in answers_of(row).values() for key in ANSWER if key not in a})
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            where = f"{printable(run.path / 'rows.jsonl')} line {n}"
            raise UserError(f"{where} is broken ({printable(error)}); make the run again") from None


def _need(missing: set[str]) -> None:
    if missing:
        raise ValueError(f"{', '.join(sorted(missing))} missing")


def _scenes(run: Run) -> Any:
    """What pins a run's scenes."""
    if isinstance(run, Driven):
        return [run.config["actions"], run.config["scenario"], run.config["first_seed"]]
    return [run.config["actions"], run.config["dataset"]["sha256"]]


def _shown(run: Run) -> str:
    if isinstance(run, Driven):
        return f"driven live from layout seed {printable(run.config['first_seed'], 20)}"
    return f"{printable(run.source, 40)} {printable(run.config['dataset']['sha256'], 12)}"


def _names(runs: Sequence[Run]) -> tuple[str, ...]:
    parts = [
        (
            str(run.config["model"].get("name")),
            str(run.config["prompt"]["version"]),
            run.answer,
            run.path.name,
        )
        for run in runs
    ]
    for many in (2, 3, 4):
        names = [" · ".join(part[:many]) for part in parts]
        if len(set(names)) == len(names):
            return tuple(names)
    total, turn = Counter(names), Counter[str]()
    for n, name in enumerate(names):
        turn[name] += 1
        names[n] += f" ({turn[name]})" if total[name] > 1 else ""
    return tuple(names)
