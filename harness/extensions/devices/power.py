"""What a model's answers take in joules, by the meters of this machine."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from harness.backends.base import Backend, Request
from harness.backends.counters import Counter, metered
from harness.backends.registry import open_backend
from harness.core.errors import Unanswered, printable
from harness.core.resources import DATASET
from harness.core.statistics import Estimate, seed_interval
from harness.dataset import load
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.runs.settings import Settings

WINDOWS = 5  # of asking; the intervals are over them


@dataclass(frozen=True)
class Power:
    """Hold the power and energy that one meter of this machine counted while a model answered.

    Power is in watts: `idle_watts` while nothing was asked, `watts` while it answered one question
    after the other. `answer_j` is the joules of an answer, of all that the meter counts, and
    `more_j` what of it is above idle power. Estimates are means with 95 % intervals over windows of
    time.
    """

    meter: str  # the meter's name
    idle_watts: float  # power before, while nothing is asked
    watts: Estimate  # power while answers are asked one by one
    answer_j: Estimate  # joules of an answer, all that the meter counts
    more_j: Estimate  # the joules of that above idle power


def measure(
    backend: Backend,
    requests: Sequence[Request],
    meters: Sequence[Counter],
    window_s: float,
    progress: Callable[[int], None],
    sleep: Callable[[float], None] = time.sleep,
) -> tuple[list[Power], int]:
    """Measure the energy of a model's answers, asked one at a time, in `WINDOWS` windows of time.

    Args:
        backend: runs the model; its first answer, which includes warming up, is not counted.
        requests: the questions, asked in turn and from the first again.
        meters: one energy meter or more.
        window_s: least seconds of a window; meters are coarse, so 2 or more.
        progress: called with 1 after each window.
        sleep: waits so many seconds, to measure idle power.

    Returns:
        What each meter counted, and the number of answers.

    Raises:
        Unanswered: a request got no answer.
    """
    _ask(backend, requests[0])
    start_s = time.perf_counter()
    with metered(meters) as idle:
        sleep(window_s)
    idled_s = time.perf_counter() - start_s
    seconds, answers = np.zeros(WINDOWS), np.zeros(WINDOWS, dtype=int)
    joules = {meter.name: np.zeros(WINDOWS) for meter in meters}
    for n in range(WINDOWS):
        start_s = time.perf_counter()
        with metered(meters) as spent:
            while (took := time.perf_counter() - start_s) < window_s or not answers[n]:
                _ask(backend, requests[answers.sum() % len(requests)])
                answers[n] += 1
            seconds[n] = took
        for name, total in spent.items():
            joules[name][n] = total
        progress(1)
    powers = []
    for name, spent_j in joules.items():
        idle_watts = idle[name] / idled_s
        more = spent_j - idle_watts * seconds
        estimates = (
            seed_interval(each) for each in (spent_j / seconds, spent_j / answers, more / answers)
        )
        powers.append(Power(name, idle_watts, *estimates))
    return powers, int(answers.sum())


def measure_agent(
    agent: Agent,
    meters: Sequence[Counter],
    window_s: float,
    device: str | None,
    progress: Callable[[int], None],
) -> tuple[list[Power], int]:
    """Load a model and measure the energy of its answers to scenes of the default dataset.

    Scenes are asked one at a time, in `WINDOWS` windows of `window_s` seconds at least. `agent` is
    the model with a prompt and an answer mode, and `device` where it is loaded, such as `cuda`;
    None lets the engine choose. `meters` are one or more energy or power meters of this machine,
    and `progress` is called with 1 after each window. Returns what each meter counted (watts, and
    joules of an answer), and the number of answers. Raises Unanswered if a question got no answer.
    """
    data = load.load(load.find(DATASET), 10)
    spec = Spec(agent, FrozenSource(data), (), (0,), settings=Settings(batch_size=1, device=device))
    sample = list(requests(spec, data.scenes(data.forest.ids[:10])))
    backend = open_backend(agent.card, device=device, dtype=None, batch_size=1)
    return measure(backend, sample, meters, window_s, progress)


def _ask(backend: Backend, request: Request) -> None:
    """Ask one question. Raises Unanswered if it gets no answer,
    whose joules would be those of a failure.
    """
    [completion] = backend.complete([request])
    if completion.error is not None:
        raise Unanswered(
            f"{printable(completion.error, 300)}: no answer, so that nothing is measured"
        )
