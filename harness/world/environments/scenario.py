"""Make a scenario of an environment."""

from functools import lru_cache, partial
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.environments.place import place
from harness.world.environments.world import EnvironmentWorld
from harness.world.parameters import DIALS
from harness.world.road import Road
from harness.world.scenario import Layout, Scenario


@lru_cache(maxsize=16)
def scenario(name: str) -> Scenario:
    """Make a scenario of an environment. Raises UserError if there is none, or it lacks something."""
    here = place(name)
    where = here.road.ego[1].partition(" lane ")[0]
    return Scenario(
        name=name,
        description=f"Scenario {name}: {here.kind} of highway-env, with its own vehicles and traffic.\n",
        actions=here.actions,
        parameters=here.parameters,
        road=partial(_road, name),
        layout=_layout,
        cleared=_nobody,
        words={"task": f"follow your road, {where}, and keep up speed", "hiding": "other vehicles"},
        brake_lamps=True,
        dials=(*DIALS, "decisions", "helpers", "time_limit_s", "delay_allowance_s"),
        world=EnvironmentWorld,
    )


def _road(name: str) -> Road:
    return place(name).road


def _layout(seed: int, parameters: Any) -> Layout:
    """Return an empty layout: the harness does not know an environment's vehicles, nor a danger."""
    return Layout((), (), None, None)


def _nobody(xy_m: Floats, approaches: Texts, parameters: Any) -> Bools:
    """Return false: `EnvironmentWorld` itself decides whether the ego has reached its goal."""
    return np.zeros(xy_m.shape[:-2], dtype=bool)
