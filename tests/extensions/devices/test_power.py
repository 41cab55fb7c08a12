"""What a model's answers take in joules, by a meter that is played."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from harness.backends import counters as readers
from harness.backends.base import Completion
from harness.backends.counters import Counter, counters
from harness.extensions.devices.power import WINDOWS, measure


class Meter:
    """20 W while something is asked and 5 W else, on a clock of its own."""

    def __init__(self) -> None:
        self.now, self.joules = 0.0, 0.0

    def passes(self, seconds: float, watts: float) -> None:
        self.now += seconds
        self.joules += watts * seconds


class Slow:
    """Answers in 0.1 s."""

    def __init__(self, meter: Meter) -> None:
        self.meter, self.asked = meter, list[str]()

    def complete(self, requests: Any) -> list[Completion]:
        self.meter.passes(0.1 * len(requests), 20.0)
        self.asked += [r.id for r in requests]
        return [Completion(r.id, "", None, None, "stop", None, 1) for r in requests]

    def identity(self) -> dict[str, Any]:
        return {}


def test_an_answers_joules_are_those_of_asking_with_idling_apart(monkeypatch: pytest.MonkeyPatch):
    """0.1 s at 20 W are 2 J, of which 0.5 are idling.
    One answer warms up and counts for nothing.
    """
    meter = Meter()
    monkeypatch.setattr(
        "harness.extensions.devices.power.time", SimpleNamespace(perf_counter=lambda: meter.now)
    )
    backend, done = Slow(meter), list[int]()
    requests: Any = [SimpleNamespace(id=name) for name in "abc"]
    [drawn], n = measure(
        backend, requests, [Counter("wall", lambda: meter.joules)], 0.95, done.append,
        lambda seconds: meter.passes(seconds, 5.0),
    )  # fmt: skip
    assert n == 10 * WINDOWS
    assert len(backend.asked) == n + 1
    assert backend.asked[1:5] == ["a", "b", "c", "a"]
    assert drawn.idle_watts == pytest.approx(5.0)
    assert drawn.watts.value == pytest.approx(20.0)
    assert drawn.answer_j.value == pytest.approx(2.0)
    assert drawn.more_j.value == pytest.approx(1.5)
    assert done == [1] * WINDOWS


def test_without_a_meter_it_says_what_is_missing(
    harness: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setitem(sys.modules, "pynvml", None)
    monkeypatch.setattr(readers, "SYS", tmp_path)
    monkeypatch.setattr(counters, "__defaults__", (tmp_path,))
    code, _, err = harness("model", "device", "measure")
    assert code == 2
    assert "no meter can be read here" in err
    assert len(err.splitlines()) == 1
