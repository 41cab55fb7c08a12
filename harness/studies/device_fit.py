"""What fits the decision window on a declared computer,
and how near its rates are to a run's own times.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.statistics import Estimate, episode_interval, rate_interval
from harness.evaluate.device import tokens
from harness.runs import devices, percentiles
from harness.runs.devices import Device, DeviceRow
from harness.runs.folder import Run
from harness.runs.records import Answer

READOUT, WRITTEN, DECISION = "readout", "written", "decision"


@dataclass(frozen=True)
class Fit:
    """One answer of a model on a device, asked alone; NaN where a number of it is not known."""

    row: DeviceRow  # the model's
    answer: str  # `readout`, which is one token, `decision`, which is none, or how it is written
    prompt_tokens: float  # read; of a run, the median
    output_tokens: float  # written; of a run, the median
    seconds: float  # that it takes; of a run, the median
    # share of answers that are there within the window; of declared tokens 0 or 1, of one answer
    in_time: Estimate
    joules: Estimate  # that it takes; of a run, the mean


def fits(
    device: Device, rows: Sequence[DeviceRow], answers: "Answers", window_s: float
) -> list[Fit]:
    """Return each row with each kind of answer,
    of which `window_s` is the time from seeing to the answer.
    """
    return [
        _fit(device, row, kind, answers, window_s)
        for row in rows
        for kind in ([DECISION] if row.answer_ms else answers.output)
    ]


@dataclass(frozen=True)
class Answers:
    """Answers of which a fit is asked."""

    prompt: Floats  # tokens read, (n,)
    output: dict[str, Floats]  # tokens written by kind of answer, each (n,)
    episodes: Ints | None = None  # the episode of each, (n,); None for one declared answer
    who: str = ""  # the model that wrote them


def declared(prompt_tokens: int, answer_tokens: int) -> Answers:
    """Return one answer of so many tokens, read out or written."""
    output = {READOUT: np.array([1.0]), WRITTEN: np.array([float(answer_tokens)])}
    return Answers(np.array([float(prompt_tokens)]), output)


def answers_of(run: Run) -> Answers:
    """Return the ego's answers of a run, as given,
    and as if one letter of each prompt were read out.

    Raises:
        UserError: nobody counted their tokens.
    """
    egos = [answer for answer in run.answers if answer.role == "ego" and answer.error is None]
    counts = np.array([tokens(answer) for answer in egos], dtype=float).reshape(-1, 2)
    if not len(counts):
        raise UserError(f"{printable(run.path)} has no answer of its ego; give another run")
    mode, ones = run.manifest.answer, np.ones(len(counts))
    _, place = np.unique([answer.scene.partition("-")[0] for answer in egos], return_inverse=True)
    return Answers(
        counts[:, 0], {READOUT: ones, mode: counts[:, 1]}, place, run.manifest.model["name"]
    )


def _fit(device: Device, row: DeviceRow, kind: str, answers: Answers, window_s: float) -> Fit:
    speed, output = (
        devices.speed(device, row),
        answers.output.get(kind, np.zeros(len(answers.prompt))),
    )
    pairs = list(zip(answers.prompt.tolist(), output.tolist(), strict=True))
    seconds, joules = (
        np.array([of(speed, *pair) for pair in pairs]) for of in (devices.seconds, devices.joules)
    )
    hits = np.where(np.isnan(seconds), np.nan, (seconds <= window_s).astype(float))
    if answers.episodes is None:
        once = [Estimate(float(each[0]), np.nan, np.nan, 1, 0) for each in (hits, joules)]
    else:
        once = [rate_interval(hits, answers.episodes), episode_interval(joules, answers.episodes)]
    read, written, took = (float(np.median(each)) for each in (answers.prompt, output, seconds))
    return Fit(row, kind, read, written, took, *once)


@dataclass(frozen=True)
class Comparison:
    """A figure of a run's answers that were asked alone,
    beside what a device profile says of it.
    """

    what: str  # `seconds` of an answer, or a rate by its name in a profile
    role: str  # whose answers
    measured: Estimate  # median with its 95 % interval over episodes; n is how many answers
    stated: float  # what the profile says: of seconds the median over the same answers


def held(device: Device, row: DeviceRow, run: Run) -> list[Comparison]:
    """Compare a profile with a run's own times.
    Raises UserError if no answer of the run was asked alone.
    """
    alone = [a for a in run.answers if a.seconds is not None and a.error is None and not a.retries]
    alone = [
        a for a in alone if not a.first and a.prompt_tokens is not None and a.completion_tokens
    ]
    figures = [
        figure
        for role in dict.fromkeys(a.role for a in alone)
        for figure in _held(device, row, [a for a in alone if a.role == role])
    ]
    if not figures:
        raise UserError(
            f"{printable(run.path)} has no answer that was asked alone and timed; run it with "
            "--batch-size 1 --no-cache"
        )
    return figures


def _held(device: Device, row: DeviceRow, alone: Sequence[Answer]) -> Iterator[Comparison]:
    speed, role = devices.speed(device, row), alone[0].role
    stated = [devices.seconds(speed, *tokens(answer)) for answer in alone]
    yield Comparison(
        "seconds", role, _median([(a.seconds, a) for a in alone]), float(np.median(stated))
    )
    read = [
        (a.prompt_tokens / a.first_token_s, a) for a in alone if a.first_token_s and a.prompt_tokens
    ]
    written = [(1 / a.token_s, a) for a in alone if a.token_s]
    for name, pairs in zip(devices.RATES, (read, written), strict=True):
        if pairs:
            value = getattr(speed, name)
            yield Comparison(name, role, _median(pairs), np.nan if value is None else value)


def _median(pairs: Sequence[tuple[float | None, Answer]]) -> Estimate:
    values = np.array([value for value, _ in pairs], dtype=float)
    low, high = percentiles.intervals(values, [a.scene.partition("-")[0] for _, a in pairs])[50]
    return Estimate(float(np.median(values)), low, high, len(values), 0)
