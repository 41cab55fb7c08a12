"""What fits the decision window on a declared computer,
and how near its rates are to a run's own times.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.statistics import Estimate, episode_interval, rate_interval
from harness.extensions.devices import profiles
from harness.extensions.devices.profiles import Device, DeviceRow
from harness.extensions.devices.timer import tokens
from harness.runs import percentiles
from harness.runs.answer_times import clusters_by_text, unit
from harness.runs.folder import Run
from harness.runs.records import Answer

READOUT, WRITTEN, DECISION = "readout", "written", "decision"


@dataclass(frozen=True)
class Fit:
    """Hold the time and energy of a model's answers, one by one, on a device; NaN if unknown.

    They are one assumed answer, or the answers of a run: then tokens read and written and `seconds`
    are medians, and `joules` of an answer a mean. `row` has the device's speed with the model.
    `answer` says how it answers: `readout` (one token), `decision` (no token), or in writing.
    `in_time` is the share of answers that are there within the decision window, from 0 to 1.
    """

    row: DeviceRow  # the device's speed, energy and memory with the model
    answer: str  # `readout`, which is one token, `decision`, which is none, or how it is written
    prompt_tokens: float  # number of tokens read; of a run, the median
    output_tokens: float  # number of tokens written; of a run, the median
    seconds: float  # how long it takes; of a run, the median
    # share of answers that are there within the decision window; of one assumed answer 0 or 1
    in_time: Estimate
    joules: Estimate  # energy of an answer; of a run, the mean


def fits(
    device: Device, rows: Sequence[DeviceRow], answers: "Answers", window_s: float
) -> list[Fit]:
    """Return the time and energy of answers on a device, for each row and each kind of answer.

    A device is an on-board computer, and a row of its profile has its speed with one model.
    `answers` has the token counts, by kind of answer: one letter, or in writing. `window_s` is the
    longest time, s, from seeing to the answer that counts as in time.
    """
    results = []
    for row in rows:
        kinds = [DECISION] if row.answer_ms else answers.output
        results += [_fit(device, row, kind, answers, window_s) for kind in kinds]
    return results


@dataclass(frozen=True)
class Answers:
    """Hold the token counts of n answers whose time and energy on a device are asked for.

    `prompt`, (n,), is the number of tokens read, and `output` that written, (n,) by kind of answer
    (`readout`, one token, or in writing). `units`, (n,), has the number of what each answer is
    counted under, its episode or the cluster of that; None for one assumed answer. `who` is the
    model that wrote them.
    """

    prompt: Floats  # number of tokens read for each answer, (n,)
    output: dict[str, Floats]  # number of tokens written, by kind of answer, (n,) each
    # number of each answer's episode, or its cluster, (n,); None for one assumed answer
    units: Ints | None = None
    who: str = ""  # the model that wrote them


def declared(prompt_tokens: int, answer_tokens: int) -> Answers:
    """Return the token counts of one answer that is assumed: as a read-out, and in writing.

    They are used where no run is at hand. `prompt_tokens` are read; a read-out (one letter) writes
    one token, and an answer in writing `answer_tokens`.
    """
    output = {READOUT: np.array([1.0]), WRITTEN: np.array([float(answer_tokens)])}
    return Answers(np.array([float(prompt_tokens)]), output)


def answers_of(run: Run) -> Answers:
    """Return the token counts of the ego's answers in a run: as they are, and as read-outs.

    A read-out, the probabilities of one letter an action, takes one output token. Raises UserError
    if the run's ego has no answer with counted tokens.
    """
    egos = [answer for answer in run.answers if answer.role == "ego" and answer.error is None]
    counts = np.array([tokens(answer) for answer in egos], dtype=float).reshape(-1, 2)
    if not len(counts):
        raise UserError(f"{printable(run.path)} has no answer of its ego; give another run")
    cluster_of = clusters_by_text(run.grid.episodes, run.clusters)
    _, place = np.unique([unit(answer, cluster_of) for answer in egos], return_inverse=True)
    output = {READOUT: np.ones(len(counts)), run.manifest.answer: counts[:, 1]}
    return Answers(counts[:, 0], output, place, run.manifest.model["name"])


def _fit(device: Device, row: DeviceRow, kind: str, answers: Answers, window_s: float) -> Fit:
    speed = profiles.speed(device, row)
    output = answers.output.get(kind, np.zeros(len(answers.prompt)))
    pairs = list(zip(answers.prompt.tolist(), output.tolist(), strict=True))
    seconds = np.array([profiles.seconds(speed, *pair) for pair in pairs])
    joules = np.array([profiles.joules(speed, *pair) for pair in pairs])
    hits = np.where(np.isnan(seconds), np.nan, (seconds <= window_s).astype(float))
    if answers.units is None:
        in_time = Estimate(float(hits[0]), np.nan, np.nan, 1, 0)
        energy = Estimate(float(joules[0]), np.nan, np.nan, 1, 0)
    else:
        in_time = rate_interval(hits, answers.units)
        energy = episode_interval(joules, answers.units)
    return Fit(
        row=row,
        answer=kind,
        prompt_tokens=float(np.median(answers.prompt)),
        output_tokens=float(np.median(output)),
        seconds=float(np.median(seconds)),
        in_time=in_time,
        joules=energy,
    )


@dataclass(frozen=True)
class Comparison:
    """Hold a time or token rate that a run measured beside what a device profile states for it.

    A device profile is a file with an on-board computer's speed and power. `stated` is NaN if it
    has none.
    """

    # `seconds` of an answer, or a rate in tokens a second, by its name in a profile
    what: str
    role: str  # whose answers were measured, the ego's or a helper's
    measured: Estimate  # median with its 95 % interval over episodes; n is how many answers
    stated: float  # what the profile says: of seconds the median over the same answers


def held(device: Device, row: DeviceRow, run: Run) -> list[Comparison]:
    """Return what a run measured beside what a device profile states, for each role and figure.

    A device profile has an on-board computer's speed and power with some models; `row` is that with
    one model. The role is whose answers they are, `ego` or `helper`. The figures are seconds of an
    answer, and tokens a second read and written. Only answers that were asked one at a time count.
    Raises UserError if there are none.
    """
    alone: dict[str, list[Answer]] = {}  # by role
    for answer in run.answers:
        timed = answer.seconds is not None and answer.error is None and not answer.retries
        counted = answer.prompt_tokens is not None and answer.completion_tokens
        if timed and counted and not answer.first:
            alone.setdefault(answer.role, []).append(answer)
    cluster_of = clusters_by_text(run.grid.episodes, run.clusters)
    figures = list[Comparison]()
    for answers in alone.values():
        figures += _held(device, row, answers, cluster_of)
    if not figures:
        raise UserError(
            f"{printable(run.path)} has no answer that was asked alone and timed; run it with "
            "--batch-size 1 --no-cache"
        )
    return figures


def _held(
    device: Device, row: DeviceRow, alone: Sequence[Answer], cluster_of: Mapping[str, str]
) -> Iterator[Comparison]:
    speed, role = profiles.speed(device, row), alone[0].role
    seconds = [profiles.seconds(speed, *tokens(answer)) for answer in alone]
    measured = _median([(answer.seconds, answer) for answer in alone], cluster_of)
    yield Comparison("seconds", role, measured, float(np.median(seconds)))
    read, written = list[tuple[float, Answer]](), list[tuple[float, Answer]]()
    for answer in alone:
        if answer.first_token_s and answer.prompt_tokens:
            read.append((answer.prompt_tokens / answer.first_token_s, answer))
        if answer.token_s:
            written.append((1 / answer.token_s, answer))
    for name, pairs in zip(profiles.RATES, (read, written), strict=True):
        if pairs:
            value = getattr(speed, name)
            yield Comparison(
                name, role, _median(pairs, cluster_of), np.nan if value is None else value
            )


def _median(
    pairs: Sequence[tuple[float | None, Answer]], cluster_of: Mapping[str, str]
) -> Estimate:
    """Return the median of answers' values, with its interval over their episodes or clusters."""
    values = np.array([value for value, _ in pairs], dtype=float)
    units = [unit(answer, cluster_of) for _, answer in pairs]
    low, high = percentiles.intervals(values, units, is_clustered=bool(cluster_of))[50]
    return Estimate(float(np.median(values)), low, high, len(values), 0)
