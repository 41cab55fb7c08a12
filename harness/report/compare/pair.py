"""Two finished runs on the same scenes with the same luck, read and laid out alike."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError, printable
from harness.core.memory import uncollected
from harness.evaluate.live_spec import FORMAT as DRIVEN
from harness.report.compare.table import tables
from harness.report.words import facts
from harness.runs.driven_folder import LIVE
from harness.runs.folder import FROZEN, Run, answers_of, read

if TYPE_CHECKING:
    import pandas as pd

SETTINGS = ("model", "prompt", "answer", "thinking", "dtype", "latency", "identity", "versions")


@dataclass(frozen=True)
class Side:
    """One of the two runs.

    Attributes:
        run: as it was read.
        scenes: what pins its scenes: the dataset's digest, or the scenario and the first layout seed.
        on: its scenes, for people.
        seeds: of the channel's luck, ascending.
        settings: what may make a difference, by dotted name; None is left out.
        table: its numbers by condition, seed and episode: see `tables`.
        latency_ms: of every decision.
        answers: role and verdict of each answer, by request id.
    """

    run: Run
    scenes: Any
    on: str
    seeds: tuple[int, ...]
    settings: Mapping[str, str]
    table: "pd.DataFrame"
    latency_ms: "pd.Series[float]"
    answers: Mapping[str, tuple[str, str]]

    @property
    def episodes(self) -> frozenset[int]:
        """Numbers of its episodes."""
        return frozenset(self.table.index.get_level_values("episode"))


@dataclass(frozen=True)
class Pair:
    """Two runs that can be compared.

    Attributes:
        a: the one that is the base.
        b: the one that is compared with it.
        conditions: names that both have, in the order of `a`.
        seeds: seeds of the channel's luck, the same in both.
        episodes: numbers of the episodes that both have.
    """

    a: Side
    b: Side
    conditions: tuple[str, ...]
    seeds: tuple[int, ...]
    episodes: tuple[int, ...]


@uncollected()
def pair(a: Path, b: Path) -> Pair:
    """Read two runs.

    Raises:
        UserError: a folder is no finished run, or the two have not the same scenes and seeds, or no condition
            or episode in common.
    """
    one, other = _side(a), _side(b)
    shown = f"{printable(a)} and {printable(b)}"
    if one.run.config["format"] != other.run.config["format"]:
        raise UserError(
            f"{shown}: one was made by `harness eval` and one by `harness drive`; give two of a kind, or "
            "see `harness fidelity`"
        )
    if one.scenes != other.scenes:
        raise UserError(
            f"{shown} are not of the same scenes ({printable(one.on, 60)} and {printable(other.on, 60)}); "
            "make both on the same"
        )
    if one.seeds != other.seeds:
        seeds = " and ".join(printable(list(side.seeds), 40) for side in (one, other))
        raise UserError(f"{shown} have different seeds ({seeds}); make both with the same --seeds")
    conditions = tuple(name for name in one.run.conditions if name in other.run.conditions)
    if not conditions:
        names = " and ".join(printable(", ".join(side.run.conditions), 60) for side in (one, other))
        raise UserError(f"{shown} have no condition in common ({names}); make both with the same --condition")
    episodes = one.episodes & other.episodes
    if not episodes:
        raise UserError(f"{shown} have no episode in common; make both on the same episodes")
    return Pair(one, other, conditions, one.seeds, tuple(sorted(episodes)))


def _side(path: Path) -> Side:
    run = read(path, FROZEN, LIVE)
    config = run.config
    try:
        if config["format"] == DRIVEN:
            scenes = [config["scenario"], config["first_seed"]]
            on = f"{config['scenario']['name']} from layout seed {config['first_seed']}"
        else:
            scenes = config["dataset"]["sha256"]
            on = f"{config['dataset']['name']} {config['dataset']['sha256'][:12]}"
        seeds = tuple(sorted(int(seed) for seed in config["seeds"]))
        table, latency_ms = tables(run)
        return Side(run, scenes, on, seeds, _settings(run), table, latency_ms, dict(_answers(run)))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{printable(path)} is no finished run ({printable(error)}); make the run again"
        ) from None


def _settings(run: Run) -> dict[str, str]:
    config = {"answer": run.answer, **run.config}
    told = {key: config[key] for key in SETTINGS if key in config}
    # Through the class, so that a setting which an older run does not know has the value it had then.
    points = [asdict(OperatingPoint.from_dict(c)) for c in config["conditions"]]
    told["condition"] = {point["name"]: point for point in points}
    return {name: str(value) for name, value in facts(told) if value is not None}


def _answers(run: Run) -> Iterator[tuple[str, tuple[str, str]]]:
    for row in run.rows:
        for viewer, answer in answers_of(row).items():
            yield f"{row['scene']}/{viewer}", (answer["role"], answer["verdict"])
