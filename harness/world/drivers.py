"""Reference drivers: rule-based baselines to compare models with.

`cruise` keeps its speed, `brake` always brakes, `local-view` plans with what the ego's sensors know
and `full-view` plans with everything in view. `right-hand` and `first-come` know what `local-view`
knows, and keep a rule of the road with those who keep it, too (`precedence`).

Worlds may have drivers of their own (`OwnWorld.drivers`), who read no more than what `local-view`
knows.

Three references look at nothing at all. `uniform` holds every action for equally likely. `constant`
always takes the action that did best in a scenario's tune layouts: `constants.csv` has what each
clears, and `benchmarks/constants.py` writes it. Where `limits` is 2, best is success balanced over
dangerous and harmless layouts. `open-loop` takes the fixed sequence of actions that did best there,
by their trees: `open_loop.csv`, which `benchmarks/open_loop.py` writes. After its end the last
action is taken again.
"""

import csv
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from harness.core.files import text_of
from harness.world.planner import plans
from harness.world.precedence import RULES, under
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

DRIVERS = ("cruise", "brake", "local-view", "full-view")
ALWAYS = {"cruise": "IDLE", "brake": "SLOWER"}
PRIVILEGED = "full-view"  # the only one that may read the truth
LOOKING = ("local-view", PRIVILEGED, *RULES)  # decide by a scene graph
UNIFORM, CONSTANT, OPEN_LOOP = "uniform", "constant", "open-loop"
BLIND = (*ALWAYS, UNIFORM, CONSTANT, OPEN_LOOP)  # look at nothing
CONSTANTS = Path(__file__).with_name("constants.csv")
OPEN_LOOPS = Path(__file__).with_name("open_loop.csv")


def choose(
    scenario: Scenario, driver: str, graph: SceneGraph | None, truth: SceneGraph | None
) -> str:
    """Return the meta-action, such as `SLOWER`, that a reference driver takes for the ego.

    A reference driver is a rule that needs no model. `driver` is `cruise`, `brake`, `local-view` or
    `full-view`, a rule of the road (`right-hand`, `first-come`), or an action that is always taken.
    `graph` is the ego's scene graph, what its sensors and beacons tell; `truth` is the graph with
    everything in view and no noise, which only `full-view` reads. Drivers that do not read one
    accept None for it. `scenario` has the actions and the road. Raises ValueError if the driver's
    graph is missing.
    """
    [action] = choices(scenario, [(driver, graph, truth)])
    return action


def choices(
    scenario: Scenario, requests: Sequence[tuple[str, SceneGraph | None, SceneGraph | None]]
) -> list[str]:
    """Return the meta-action that the driver of each request takes for its ego.

    Each of `requests` is a driver's name, or that of an action that is always taken; the ego's
    scene graph, what its sensors and beacons tell; and the graph with everything in view, which
    only `full-view` reads. A graph that the driver does not read may be None. All are of one
    `scenario`. Raises ValueError if a driver was not given the graph that it reads.
    """
    always = {**{action: action for action in scenario.actions}, **ALWAYS}
    of_world = scenario.world.drivers() if scenario.world else {}
    looking = [each for each in requests if each[0] not in always and each[0] not in of_world]
    planned = iter(plans(scenario, [_read(scenario, *each) for each in looking]))
    actions = []
    for driver, graph, _ in requests:
        if driver in of_world and driver not in always:
            if graph is None:
                raise ValueError(f"driver {driver!r} was not given the graph that it reads")
            actions.append(of_world[driver](scenario, graph))
        else:
            actions.append(always.get(driver) or next(planned))
    return actions


def drivers_of(scenario: Scenario) -> tuple[str, ...]:
    """Return the reference drivers whose actions the decision trees of a scenario have.

    They are those of `DRIVERS`, and those that only its worlds have (`OwnWorld.drivers`).
    """
    return (*DRIVERS, *(scenario.world.drivers() if scenario.world else ()))


def constant(scenario: Scenario) -> str | None:
    """Return the action that driver `constant` always takes in a scenario, or None if not measured.

    It is the single action that succeeds most on tune layouts (`constants.csv`): start situations
    on which settings are chosen, while results are reported on others.
    """
    return _constants().get((scenario.name.partition(":")[0], scenario.parameters.limits))


def open_loop(scenario: Scenario) -> tuple[str, ...] | None:
    """Return the fixed actions of driver `open-loop` in a scenario, or None if not measured.

    There is one for each decision. It is the sequence that succeeds most on tune layouts
    (`open_loop.csv`): start situations on which settings are chosen, while results are reported on
    others.
    """
    return _open_loops().get((scenario.name.partition(":")[0], scenario.parameters.limits))


@cache
def _open_loops() -> Mapping[tuple[str, int], tuple[str, ...]]:
    rows = csv.DictReader(text_of(OPEN_LOOPS).splitlines())
    return {(row["scenario"], int(row["limits"])): tuple(row["actions"].split()) for row in rows}


@cache
def _constants() -> Mapping[tuple[str, int], str]:
    """Return the best action of each scenario and version of limits; of equals the most careful."""
    best: dict[tuple[str, int], dict[str, str]] = {}
    for row in csv.DictReader(text_of(CONSTANTS).splitlines()):
        before = best.setdefault((row["scenario"], int(row["limits"])), row)
        if _score(row) > _score(before):
            best[row["scenario"], int(row["limits"])] = row
    return {key: row["action"] for key, row in best.items()}


def _score(row: Mapping[str, str]) -> int:
    """Return a number that grows with success, or with balanced success where `limits` is 2."""
    cleared, layouts, harmless_cleared, harmless = (
        int(row[name]) for name in ("cleared", "layouts", "harmless_cleared", "harmless")
    )
    if row["limits"] == "1":
        return cleared
    return (cleared - harmless_cleared) * harmless + harmless_cleared * (layouts - harmless)


def _read(
    scenario: Scenario, driver: str, graph: SceneGraph | None, truth: SceneGraph | None
) -> SceneGraph:
    """Return the graph that a driver plans with."""
    read = truth if driver == PRIVILEGED else graph
    if read is None:
        raise ValueError(f"driver {driver!r} was not given the graph that it reads")
    return under(driver, scenario, read) if driver in RULES else read
