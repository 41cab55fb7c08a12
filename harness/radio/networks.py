"""Measured distributions of round trips from a car to a cloud: files `networks/*.toml`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from harness.core import resources
from harness.core.arrays import Floats
from harness.core.config import LONGEST_S, between, convert, toml
from harness.core.errors import UserError, printable, unknown
from harness.core.files import read_once

Milliseconds = Annotated[float, between(0, 1000 * LONGEST_S)]


@dataclass(frozen=True)
class Network:
    """Hold how long round trips from a car to a cloud take, without the time of the answer there.

    It is the content of a file of `networks/`. A round trip is drawn from the distribution that
    `quantiles_ms` states.
    """

    description: str  # one sentence for lists
    source: str  # who measured the round trips, where and how many
    # `cited` from a publication or its data, `measured` by oneself, or `assumed`
    status: Literal["cited", "measured", "assumed"]
    # milliseconds that so many percent of the round trips stay below, by the percentage as a text,
    # from `0` to `100`
    quantiles_ms: dict[str, Milliseconds]

    def round_trip_s(self, uniforms: Floats) -> Floats:
        shares = [float(percent) / 100 for percent in self.quantiles_ms]
        return np.interp(uniforms, shares, [ms / 1000 for ms in self.quantiles_ms.values()])


def names() -> list[str]:
    """Return the names of all networks between cars and a cloud, a project's own included.

    A network is a file of a folder `networks/` that states how long round trips take.
    """
    return resources.names("networks")


def network(name: str) -> Network:
    """Return the network with a name that `names` lists, from its file.

    Raises UserError if it is unknown or its file is wrong.
    """
    if name not in names():
        raise unknown("round_trip", name, names())
    return _read(resources.find("networks", f"{name}.toml"))


@read_once
def _read(path: Path) -> Network:
    where = f"network file {printable(path)}"
    network = convert(toml(path, where), Network, where)
    try:
        percents = [float(percent) for percent in network.quantiles_ms]
    except ValueError:
        percents = []
    times_ms = list(network.quantiles_ms.values())
    ends = percents[:1] == [0.0] and percents[-1:] == [100.0]
    if not (ends and np.all(np.diff(percents) > 0) and np.all(np.diff(times_ms) >= 0)):
        raise UserError(
            f"{where}: quantiles_ms must go from 0 to 100, percentages and milliseconds growing"
        )
    return network
