"""A run as trackers take it: flat settings, figures by name, and the files that go with them."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.evaluate.lifecycle import Evaluated

PROJECT = "swarmdrive-harness"
_FILES = ("run.json", "summary.csv", "report.html")
_TABLES = ("channels", "networks", "schedules", "kept")  # of which a condition has the names


def params(settings: Mapping[str, Any]) -> dict[str, str | int | float | bool]:
    """Return a run's settings as flat values by dotted name, for a tracker of experiments.

    `settings` are nested dicts of plain values, as `run.json` has them; a name in the result is,
    for example, `world.limit`. Settings without a value are left out, lists become JSON texts, and
    of conditions (settings of radio, asking and fusion) only the names are kept.
    """
    conditions = [point["name"] for point in settings["conditions"]]
    some = {name: value for name, value in settings.items() if name not in _TABLES}
    return dict(_leaves({**some, "conditions": conditions}, ""))


def _leaves(table: Mapping[str, Any], above: str) -> Iterator[tuple[str, str | int | float | bool]]:
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{above}{name}.")
        elif isinstance(value, list | tuple):
            yield f"{above}{name}", json.dumps(value)
        elif value is not None:
            yield f"{above}{name}", value


def figures(done: "Evaluated") -> dict[str, float]:
    """Return a finished run's figures by name, for a tracker of experiments, as far as known.

    `CONDITION/METRIC` is a score under a named set of settings of radio, asking and fusion, with
    the ends of its 95 % interval in `.low` and `.high` and the number of its units in `.n`;
    `cost/MODEL/CURRENCY` is what a model's answers cost.
    """
    named: dict[str, float | None] = {}
    for score in (score for score in done.scores if score.interval != "seed means"):
        name = f"{score.condition}/{score.metric}"
        named |= {
            name: score.value,
            f"{name}.low": score.low,
            f"{name}.high": score.high,
            f"{name}.n": score.n,
        }
    for model, cost in (done.manifest.cost or {}).items():
        named[f"cost/{model}/{cost.currency}"] = cost.amount
    return {name: value for name, value in named.items() if value is not None}


def files(done: "Evaluated") -> list[Path]:
    """Return the paths of a finished run's files that a tracker keeps, as far as they are there.

    They have its settings (`run.json`), its figures (`summary.csv`) and its page.
    """
    return [file for file in map(done.out.joinpath, _FILES) if file.is_file()]
