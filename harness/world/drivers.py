"""Reference drivers: rule-based baselines to compare models with.

`cruise` keeps its speed, `brake` always brakes, `local-view` plans with what the ego's sensors know and
`full-view` plans with everything in view.

Two references look at nothing at all. `uniform` holds every action for equally likely. `constant` always
takes the action that did best in a scenario's tune layouts: `constants.csv` has what each clears, and
`benchmarks/constants.py` writes it.
"""

import csv
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from harness.core.files import text_of
from harness.world.planner import plans
from harness.world.scenario import Scenario

DRIVERS = ("cruise", "brake", "local-view", "full-view")
ALWAYS = {"cruise": "IDLE", "brake": "SLOWER"}
PRIVILEGED = "full-view"  # the only one that may read the truth
UNIFORM, CONSTANT = "uniform", "constant"
BLIND = (*ALWAYS, UNIFORM, CONSTANT)  # look at nothing
CONSTANTS = Path(__file__).with_name("constants.csv")

Graph = Mapping[str, Any]


def choose(scenario: Scenario, driver: str, graph: Graph, truth: Graph | None) -> str:
    """Return a driver's meta-action for the ego's scene graph; only `full-view` reads `truth`."""
    [action] = choices(scenario, [(driver, graph, truth)])
    return action


def choices(scenario: Scenario, asked: Sequence[tuple[str, Graph, Graph | None]]) -> list[str]:
    """Return the meta-action of each driver for a scene graph of the ego, and the truth.

    A driver may also be an action, which is always taken.
    """
    always = {**{action: action for action in scenario.actions}, **ALWAYS}
    planned = iter(plans(scenario, [_read(*each) for each in asked if each[0] not in always]))
    return [always.get(driver) or next(planned) for driver, *_ in asked]


def constant(scenario: str) -> str | None:
    """Return the action of the driver `constant` in a scenario; None where nobody has measured it."""
    return _constants().get(scenario.partition(":")[0])


@cache
def _constants() -> Mapping[str, str]:
    """Return the best action of each scenario; of equally good ones the most careful."""
    best: dict[str, dict[str, str]] = {}
    for row in csv.DictReader(text_of(CONSTANTS).splitlines()):
        of = best.setdefault(row["scenario"], row)
        if int(row["cleared"]) > int(of["cleared"]):
            best[row["scenario"]] = row
    return {name: row["action"] for name, row in best.items()}


def _read(driver: str, graph: Graph, truth: Graph | None) -> Graph:
    """Return the graph that a driver plans with."""
    if driver == "local-view":
        return graph
    if truth is None:
        raise ValueError(f"driver {driver!r} reads the truth and was given none")
    return truth
