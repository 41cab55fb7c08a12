"""One grid point of a study."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from harness.coordination.operating_point import OperatingPoint
from harness.studies.axes import Value

CORE = "core"  # the panel that compares operating points


@dataclass(frozen=True)
class Setting:
    """One grid point of a panel.

    Attributes:
        condition: name of the operating point that it is a change of.
        point: the operating point.
        vehicles: how many, the ego included.
        variable: what varies in the panel; empty where conditions are compared.
        value: its value there.
    """

    condition: str
    point: OperatingPoint
    vehicles: int
    variable: str = ""
    value: Value | None = None


def described(panels: Mapping[str, Sequence[Setting]]) -> dict[str, list[dict[str, Any]]]:
    """The grid points, complete, for a manifest."""
    return {
        name: [{"value": s.value, "vehicles": s.vehicles, **asdict(s.point)} for s in settings]
        for name, settings in panels.items()
    }
