"""Compute what answers cost on a declared computer, from their own tokens: seconds, and joules of a decision.

Which helpers are in time follows from these seconds, never from the speed of this machine. A prefix that two
prompts share is counted as read each time.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from harness.backends import devices
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.evaluate.fusion import key_of
from harness.radio.wrapped import innermost
from harness.runs.decisions import Decisions
from harness.runs.records import Answer, Constant, Device, DeviceRow, Latency, Speed

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint
    from harness.dataset.load import Scene
    from harness.evaluate.agent import Agent


def rows_of(device: Device, model: str | None, agents: "Sequence[Agent]") -> list[DeviceRow]:
    """Return the row of a device profile that times each agent: `model`'s, or that of its own card.

    Raises:
        UserError: an agent counts no tokens, or the profile has no row or no rates for it.
    """
    rows, flag = [], f"--device-profile {printable(device.name)}"
    for agent in agents:
        name = printable(agent.card.name)
        if not agent.can.language_model:
            raise UserError(f"{flag}: {name} is no language model and counts no tokens; leave it out")
        row = devices.row_of(device, model or agent.card.name.partition(":")[0])
        for rate in devices.RATES:
            if getattr(row, rate) is None:
                raise UserError(
                    f"{flag} states no {rate} of {printable(row.model)}, so it cannot time answers; "
                    "give another device, or another --device-model"
                )
        rows.append(row)
    return rows


def of_device(device: Device, model: str | None, agents: "Sequence[Agent]") -> Latency:
    """Return the latency of answers timed by their own tokens on a device; arguments as in `rows_of`."""
    rows, descriptions = rows_of(device, model, agents), []
    for agent, row in zip(agents, rows, strict=True):
        own_row = agent.card.name.partition(":")[0] == row.model
        answerer = agent.card.name + ("" if own_row else f"'s answers at the speed of {row.model}")
        rates = [cast("Constant", getattr(row, rate)) for rate in devices.RATES]
        origin = "; ".join(dict.fromkeys(f"{rate.status}: {rate.source}" for rate in rates))
        joules = {c.status for name, c in devices.constants(device, row) if c and name in devices.JOULES}
        descriptions.append(
            f"{answerer} on {device.name} ({row.precision}, batch {row.batch_size}; joules "
            f"{' and '.join(sorted(joules)) or 'unknown'}; rates {origin})"
        )
    speeds = tuple(devices.speed(device, row) for row in rows)
    return Latency("device", "; ".join(dict.fromkeys(descriptions)), speeds=speeds)


def answer_s(speed: Speed, answer: Answer) -> float:
    """Return the seconds of one answer by its tokens, its repair turn included; NaN if the engine failed.

    Raises:
        UserError: the answer has no token counts.
    """
    return devices.seconds(speed, *tokens(answer)) + answer.slow_s


def answer_j(speed: Speed, answer: Answer) -> float:
    """Return the joules of one answer; NaN and errors as in `answer_s`."""
    return devices.joules(speed, *tokens(answer))


def vehicles_j(latency: Latency, scenes: "Sequence[Scene]", answers: Mapping[str, Answer]) -> Floats:
    """Return the joules of each vehicle's own answer, (n, 1+H), the ego first; NaN without an answer.

    Args:
        latency: the latency of a run with a device profile.
        scenes: decision points.
        answers: answers by request id.
    """
    joules = np.full((len(scenes), max(len(scene.viewers) for scene in scenes)), np.nan)
    for n, scene in enumerate(scenes):
        for place, viewer in enumerate(scene.viewers):
            if answer := answers.get(f"{scene.id}/{viewer}"):
                joules[n, place] = answer_j(latency.speed(place), answer)
    return joules


def tokens(answer: Answer) -> tuple[float, float]:
    """Return an answer's tokens in and out, of both turns if there were two; NaN if the engine failed.

    Raises:
        UserError: the answer has no token counts.
    """
    if answer.prompt_tokens is not None and answer.completion_tokens is not None:
        return answer.prompt_tokens, answer.completion_tokens
    if answer.error is None:
        raise UserError(
            f"answer {printable(answer.id)} has no token counts, so no device profile can time it; "
            "use --latency"
        )
    return math.nan, math.nan


def energy(
    device: Device, latency: Latency, points: "Sequence[OperatingPoint]", decisions: Decisions,
    answers: Iterable[Answer],
) -> dict[str, Floats]:  # fmt: skip
    """Return the energy of each decision as columns (n,) by name; NaN where a part of it is unknown.

    Args:
        device: the computer that every vehicle has.
        latency: the run's latency.
        points: the run's conditions.
        decisions: the run's decisions.
        answers: all answers of the run.

    Returns:
        `inference_j`, joules of the ego, the helpers asked, and a fusion call; `helpers_j`, the helpers' part
        of it; `radio_mj`, millijoules to send the request and the replies; `waiting_j`, joules of the ego's
        computer while it waits for messages and does not infer.
    """
    ego_j, ego_s, helpers_j, call_j = _inference(latency, points, decisions, answers)
    watts, idle_watts = np.full(len(decisions), np.nan), np.nan
    condition = decisions.codes("condition", [point.name for point in points])
    for place, point in enumerate(points):
        watts[condition == place] = transmit_watts(device, point)
        if point.round_trip_s is not None or point.round_trip:  # the ego's model is in a cloud
            ego_j[condition == place], ego_s[condition == place] = np.nan, 0.0
    if device.idle_watts:
        idle_watts = device.idle_watts.value
    waits_s = (decisions["latency_ms"] - decisions["fusion_ms"]) / 1000 - ego_s
    return {
        "inference_j": ego_j + helpers_j + call_j,
        "helpers_j": helpers_j,
        "radio_mj": watts * decisions["airtime_ms"],
        "waiting_j": idle_watts * np.maximum(waits_s, 0.0),
    }


def transmit_watts(device: Device, point: "OperatingPoint") -> float:
    """Return the watts of a sending radio, by the channel's power or else the profile's; NaN if unknown."""
    if device.transmit_dbm is None or device.amplifier_efficiency is None:
        return math.nan
    dbm = float(getattr(innermost(point.channel), "power_dbm", device.transmit_dbm.value))
    return 10 ** ((dbm - 30) / 10) / device.amplifier_efficiency.value


def _inference(
    latency: Latency, points: "Sequence[OperatingPoint]", decisions: Decisions, answers: Iterable[Answer]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the ego's joules and seconds, the helpers' joules and those of fusion calls, (n,) each."""
    by_id = {answer.id: answer for answer in answers}
    egos = {answer.scene: answer for answer in by_id.values() if answer.role == "ego"}
    calls = {(a.scene, a.heard): a for a in by_id.values() if a.role == "merge"}
    n, condition = len(decisions), decisions.codes("condition", [point.name for point in points])
    fusing = {place: point.rewrites for place, point in enumerate(points) if point.asks_again}
    senders = [decisions.labels(f"helper_{place}") for place in range(1, decisions.helpers + 1)]
    on_time, attackers = (decisions.of_messages(name) == 1.0 for name in ("on_time", "attacker"))
    ego_j, ego_s, helpers_j, call_j = np.zeros((4, n))
    for scene, rows in decisions.scenes.items():
        ego_j[rows.start : rows.stop] = answer_j(latency.speeds[0], egos[scene])
        ego_s[rows.start : rows.stop] = answer_s(latency.speeds[0], egos[scene])
        joules_of: dict[str, float] = {}
        for row in rows:
            asked = [(place, helper) for place, column in enumerate(senders) if (helper := column[row])]
            for place, helper in asked:
                if helper not in joules_of:  # an attacker's further voices run no model
                    answer = by_id.get(f"{scene}/{helper}")
                    joules_of[helper] = answer_j(latency.speed(1 + place), answer) if answer else 0.0
                helpers_j[row] += joules_of[helper]
            if rewrites := fusing.get(int(condition[row])):
                heard = tuple(
                    key_of(helper, rewrites, attackers[row, index])
                    for index, helper in asked
                    if on_time[row, index]
                )
                call_j[row] = answer_j(latency.speeds[0], calls[scene, heard]) if heard else 0.0
    return ego_j, ego_s, helpers_j, call_j
