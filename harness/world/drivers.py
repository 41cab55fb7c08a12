"""Reference drivers: rule-based baselines to compare models with.

`cruise` keeps its speed, `brake` always brakes, `local-view` plans with what the ego's sensors know and
`full-view` plans with everything in view.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from harness.world.planner import plans
from harness.world.scenario import Scenario

DRIVERS = ("cruise", "brake", "local-view", "full-view")
ALWAYS = {"cruise": "IDLE", "brake": "SLOWER"}
PRIVILEGED = "full-view"  # the only one that may read the truth

Graph = Mapping[str, Any]


def choose(scenario: Scenario, driver: str, graph: Graph, truth: Graph | None) -> str:
    """Return a driver's meta-action for the ego's scene graph; only `full-view` reads `truth`."""
    [action] = choices(scenario, [(driver, graph, truth)])
    return action


def choices(scenario: Scenario, asked: Sequence[tuple[str, Graph, Graph | None]]) -> list[str]:
    """Return the meta-action of each driver for a scene graph of the ego, and the truth."""
    planned = iter(plans(scenario, [_read(*each) for each in asked if each[0] not in ALWAYS]))
    return [ALWAYS[driver] if driver in ALWAYS else next(planned) for driver, *_ in asked]


def _read(driver: str, graph: Graph, truth: Graph | None) -> Graph:
    """Return the graph that a driver plans with."""
    if driver == "local-view":
        return graph
    if truth is None:
        raise ValueError(f"driver {driver!r} reads the truth and was given none")
    return truth
