"""Read the energy counters of a machine: NVML, RAPL, and the power rails of a Jetson.

NVML (GPUs since Volta) and RAPL count energy themselves; RAPL's counter wraps around, and on Linux
only root may read it. A Jetson reports power, which is sampled and integrated here. All are too
coarse for one answer: on some GPUs NVML samples the power only a quarter of the time (Yang et al.,
SC24, arXiv 2312.02741), so a measurement lasts seconds and is repeated.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Event, Thread
from typing import Any

SYS = Path("/sys")
SAMPLED_S = 0.02  # time between two samples of a power


@dataclass(frozen=True)
class Counter:
    """Describe one energy meter (`joules`) or power meter (`watts`) of this machine.

    `name` is such as `nvml 0`. One of the functions is set: `joules()` returns the joules counted
    so far, from any start, and `watts()` the present power.
    """

    name: str  # such as `nvml 0`, `rapl package-0` or `jetson VDD_IN`
    joules: Callable[[], float] | None = None  # reads the joules counted so far, from any start
    watts: Callable[[], float] | None = None  # reads the present watts, where nothing counts joules


def counters(sys: Path = SYS) -> list[Counter]:
    """Return the energy and power meters that can be read on this machine: NVML, RAPL, Jetson.

    `sys` is the folder in which the kernel shows its own meters, `/sys`.
    """
    return [*_nvml(), *_rapl(sys), *_jetson(sys)]


@contextmanager
def metered(meters: Sequence[Counter]) -> Iterator[dict[str, float]]:
    """Enter a context that measures energy; it yields a dict, which is empty until the end.

    The dict then has, by the name of each of the `meters`, the joules used in between.
    """
    spent: dict[str, float] = {}
    sums = {meter.name: 0.0 for meter in meters if meter.watts}
    ended = Event()

    def sample() -> None:
        before = time.perf_counter()
        while not ended.wait(SAMPLED_S):
            now = time.perf_counter()
            for meter in meters:
                if meter.watts:
                    sums[meter.name] += meter.watts() * (now - before)
            before = now

    sampling = Thread(target=sample, daemon=True)
    joules_before = {meter.name: meter.joules() for meter in meters if meter.joules}
    sampling.start()
    try:
        yield spent
    finally:
        ended.set()
        sampling.join()
        spent |= sums | {m.name: m.joules() - joules_before[m.name] for m in meters if m.joules}


def _nvml() -> Iterator[Counter]:
    try:
        nvml: Any = import_module("pynvml")
        nvml.nvmlInit()
        devices = [nvml.nvmlDeviceGetHandleByIndex(n) for n in range(nvml.nvmlDeviceGetCount())]
    except Exception:  # no package, no driver, no GPU: each has an error of its own
        return
    for n, device in enumerate(devices):

        def joules(device: Any = device) -> float:
            return float(nvml.nvmlDeviceGetTotalEnergyConsumption(device)) / 1e3

        with suppress(Exception):  # a GPU before Volta has no total
            joules()
            yield Counter(f"nvml {n}", joules)


def _rapl(sys: Path) -> Iterator[Counter]:
    for folder in sorted((sys / "class/powercap").glob("*-rapl:*")):
        # a part of a package, whose energy the package's counter includes
        if folder.name.count(":") > 1:
            continue
        with suppress(OSError, ValueError):
            name = (folder / "name").read_text().strip()
            most = _number(folder / "max_energy_range_uj")
            yield Counter(f"rapl {name}", _Wrapping(folder / "energy_uj", most))


class _Wrapping:
    """Reads joules from a counter of microjoules that wraps around at `most`."""

    def __init__(self, path: Path, most: float) -> None:
        self._path, self._most = path, most
        self._last, self._total = _number(path), 0.0

    def __call__(self) -> float:
        now = _number(self._path)
        self._total += now - self._last + (self._most if now < self._last else 0.0)
        self._last = now
        return self._total / 1e6


def _jetson(sys: Path) -> Iterator[Counter]:
    for label in sorted((sys / "bus/i2c/drivers/ina3221").glob("*/hwmon/hwmon*/in[1-3]_label")):
        n, folder = label.name[2], label.parent

        def watts(folder: Path = folder, n: str = n) -> float:
            return _number(folder / f"in{n}_input") * _number(folder / f"curr{n}_input") / 1e6

        with suppress(OSError, ValueError):
            watts()
            yield Counter(f"jetson {label.read_text().strip()}", watts=watts)


def _number(path: Path) -> float:
    return float(path.read_text())
