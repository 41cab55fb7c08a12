"""Meters of energy, by fake trees of /sys and a fake NVML:
no machine of ours has one that can be read.
"""

import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from harness.backends.counters import counters, metered


@pytest.fixture(autouse=True)
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", None)


def written(place: Path, **files: object) -> Path:
    place.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (place / name).write_text(f"{content}\n")
    return place


def test_a_machine_without_meters_has_none(tmp_path: Path):
    assert counters(tmp_path) == []


def test_rapl_counts_microjoules_and_begins_anew_at_its_end(tmp_path: Path):
    """Of 1000 µJ at most: from 900 to 100 are 200. A part of the package is left out."""
    tree = tmp_path / "class/powercap"
    package = written(
        tree / "intel-rapl:0", name="package-0", energy_uj=900, max_energy_range_uj=1000
    )
    written(tree / "intel-rapl:0:0", name="core", energy_uj=5, max_energy_range_uj=1000)
    [meter] = counters(tmp_path)
    assert meter.name == "rapl package-0"
    with metered([meter]) as spent:
        written(package, energy_uj=100)
    assert spent == {"rapl package-0": pytest.approx(200e-6)}


def test_a_counter_that_nobody_may_read_is_none(tmp_path: Path):
    written(tmp_path / "class/powercap/intel-rapl:0", name="package-0", max_energy_range_uj=1000)
    assert counters(tmp_path) == []


def test_a_jetsons_rails_state_power_which_is_summed_up(tmp_path: Path):
    """5 V and 2 A are 10 W: over 0.2 s some 2 J."""
    rails = tmp_path / "bus/i2c/drivers/ina3221/1-0040/hwmon/hwmon3"
    written(
        rails,
        in1_label="VDD_IN",
        in1_input=5000,
        curr1_input=2000,
        in2_label="VDD_CPU",
        in2_input="x",
    )
    [meter] = counters(tmp_path)
    assert meter.name == "jetson VDD_IN"
    begun = time.perf_counter()
    with metered([meter]) as spent:
        time.sleep(0.2)
    most = 10 * (time.perf_counter() - begun)
    assert most / 2 < spent["jetson VDD_IN"] <= most


def test_nvml_counts_millijoules_of_each_gpu_that_has_a_total(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    total = {0: 5000.0}

    def energy(device: int) -> float:
        if device == 1:
            raise RuntimeError("Not Supported")
        return total[device]

    fake = SimpleNamespace(
        nvmlInit=lambda: None, nvmlDeviceGetCount=lambda: 2, nvmlDeviceGetHandleByIndex=lambda n: n,
        nvmlDeviceGetTotalEnergyConsumption=energy,
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "pynvml", fake)
    [meter] = counters(tmp_path)
    with metered([meter]) as spent:
        total[0] += 1500
    assert spent == {"nvml 0": 1.5}
