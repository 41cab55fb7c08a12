"""The paper's study as panels: operating points, swarm size, packet loss, entropy threshold."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from harness.coordination.operating_point import POINTS, OperatingPoint
from harness.studies.axes import AXES, Value, grid
from harness.studies.setting import Setting

SEEDS = (0, 1, 2, 3, 4)
VEHICLES = 4  # the ego and the cooperative neighbourhood of three


@dataclass(frozen=True)
class Panel:
    """One panel of the study.

    Attributes:
        name: as in the paper's numbers.
        settings: its grid points.
        episodes: per seed.
    """

    name: str
    settings: tuple[Setting, ...]
    episodes: int


def panels(core: int = 1500, sweep: int = 300) -> list[Panel]:
    """The paper's four panels. Seeds times episodes is read as 5 x 1 500 and, at a grid point, 5 x 300."""
    # Helpers whose entropy is above tau open rounds of their own everywhere; at 0.7 nats none is.
    points = {name: replace(point, helper_rounds=True) for name, point in POINTS.items()}
    six = points["6g"]
    crowded = replace(six, helper_rounds=False, density_coupled=True)
    return [
        Panel("core", tuple(Setting(name, point, VEHICLES) for name, point in points.items()), core),
        Panel("size", tuple(
            Setting("6g", crowded, int(n), "size", n) for n in grid(AXES["size"], "1:8")
        ), sweep),
        Panel("loss", tuple(_along("loss", six, grid(AXES["loss"]))), sweep),
        Panel("tau", tuple(_along("tau", six, grid(AXES["tau"]))), sweep),
    ]  # fmt: skip


def _along(name: str, point: OperatingPoint, values: Sequence[Value]) -> Iterator[Setting]:
    for value in values:
        yield Setting("6g", AXES[name].at(point, value), VEHICLES, name, value)
