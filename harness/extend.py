"""Re-export what extensions build on.
A name that goes warns for a release first: docs/extend.md.
"""

from typing import Any

from harness.backends.base import Backend, Completion, Request
from harness.backends.card import Card
from harness.backends.registry import Capabilities, Registration
from harness.cli.show import finish as finish_study
from harness.coordination.consensus import Fused, Messages, Pool, Rule, linear_pool
from harness.coordination.contents import Call, Content
from harness.coordination.intents import Intents
from harness.coordination.parts import ActsOn, Kept, Part, RunFacts
from harness.coordination.scheduling import Formula, ScheduleInputs
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError
from harness.core.extensions import from_python
from harness.core.figures import PERCENT, Unit
from harness.core.plugins import Plugins
from harness.radio.channel import Broadcast, Channel, Delivery, Draws, Links, Physical
from harness.radio.constant import link_up
from harness.report.document import Section, Table
from harness.runs.folder import Run
from harness.runs.folder import read as read_run
from harness.runs.metric import Metric
from harness.studies.study import Study
from harness.world.parameters import Parameters
from harness.world.road import (
    Ground,
    Lane,
    Path,
    PathKey,
    Road,
    crossings,
    ground,
    straights,
    to_the_left,
)
from harness.world.scenario import Draws as LayoutDraws
from harness.world.scenario import Layout, Scenario, Spawn
from harness.world.state import Building


def __getattr__(name: str) -> Any:
    """Return what extensions give to others, such as `Attack`."""
    thing = from_python(name)
    if thing is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return thing


__all__ = [
    "PERCENT",
    "ActsOn",
    "Backend",
    "Bools",
    "Broadcast",
    "Building",
    "Call",
    "Capabilities",
    "Card",
    "Channel",
    "Completion",
    "Content",
    "Delivery",
    "Draws",
    "Floats",
    "Formula",
    "Fused",
    "Ground",
    "Intents",
    "Ints",
    "Kept",
    "Lane",
    "Layout",
    "LayoutDraws",
    "Links",
    "Messages",
    "Metric",
    "Parameters",
    "Part",
    "Path",
    "PathKey",
    "Physical",
    "Plugins",
    "Pool",
    "Registration",
    "Request",
    "Road",
    "Rule",
    "Run",
    "RunFacts",
    "Scenario",
    "ScheduleInputs",
    "Section",
    "Spawn",
    "Study",
    "Table",
    "Unit",
    "UserError",
    "crossings",
    "finish_study",
    "ground",
    "linear_pool",
    "link_up",
    "read_run",
    "straights",
    "to_the_left",
]
