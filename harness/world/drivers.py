"""Reference drivers: rule-based baselines to compare models with.

`cruise` keeps its speed, `brake` always brakes, `local-view` plans with what the ego's sensors know and
`full-view` plans with everything in view.
"""

from collections.abc import Mapping
from typing import Any

from harness.world.planner import plan
from harness.world.scenario import Scenario

DRIVERS = ("cruise", "brake", "local-view", "full-view")
PRIVILEGED = "full-view"  # the only one that may read the truth

Graph = Mapping[str, Any]


def choose(scenario: Scenario, driver: str, graph: Graph, truth: Graph | None) -> str:
    """Return a driver's meta-action for the ego's scene graph; only `full-view` reads `truth`."""
    if driver == "cruise":
        return "IDLE"
    if driver == "brake":
        return "SLOWER"
    if driver == "local-view":
        return plan(scenario, graph)
    if truth is None:
        raise ValueError(f"driver {driver!r} reads the truth and was given none")
    return plan(scenario, truth)
