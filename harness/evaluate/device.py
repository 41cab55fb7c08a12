"""Compute what answers cost on a declared computer, from their own tokens:
seconds, and joules of a decision.

Which helpers are in time follows from these seconds, never from the speed of this machine. A prefix
that two prompts share is counted as read each time.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.core.errors import UserError, printable
from harness.evaluate.fusion import key_of
from harness.radio.wrapped import innermost
from harness.runs import devices
from harness.runs.decisions import Decisions
from harness.runs.devices import Constant, Device, DeviceRow, Speed
from harness.runs.records import Answer, Latency

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint
    from harness.dataset.load import Scene
    from harness.evaluate.agent import Agent
    from harness.evaluate.walk import Decided


def rows_of(device: Device, model: str | None, agents: "Sequence[Agent]") -> list[DeviceRow]:
    """Return for each agent the row of a device profile that times its answers.

    That is the row of `model`, or if None that of the agent's own model. Raises UserError if an
    agent counts no tokens, or the profile has no such row or no rates in it.
    """
    rows, flag = [], f"--device-profile {printable(device.name)}"
    for agent in agents:
        name = printable(agent.card.name)
        if not agent.can.language_model:
            raise UserError(
                f"{flag}: {name} is no language model and counts no tokens; leave it out"
            )
        row = devices.find_row(device, model or agent.card.name.partition(":")[0])
        for rate in devices.RATES if row.answer_ms is None else ():
            if getattr(row, rate) is None:
                raise UserError(
                    f"{flag} states no {rate} of {printable(row.model)}, so it cannot time "
                    "answers; give another device, or another --device-model"
                )
        rows.append(row)
    return rows


def of_device(device: Device, model: str | None, agents: "Sequence[Agent]") -> Latency:
    """Return a latency by which answers take time by their own tokens on a device.

    Arguments and errors as in `rows_of`.
    """
    rows, descriptions = rows_of(device, model, agents), []
    for agent, row in zip(agents, rows, strict=True):
        own_row = agent.card.name.partition(":")[0] == row.model
        answerer = agent.card.name + ("" if own_row else f"'s answers at the speed of {row.model}")
        timed = ["answer_ms"] if row.answer_ms else devices.RATES
        rates = [cast("Constant", getattr(row, name)) for name in timed]
        origin = "; ".join(dict.fromkeys(f"{rate.status}: {rate.source}" for rate in rates))
        joules = {
            c.status for name, c in devices.constants(device, row) if c and name in devices.JOULES
        }
        descriptions.append(
            f"{answerer} on {device.name} ({row.precision}, batch {row.batch_size}; joules "
            f"{' and '.join(sorted(joules)) or 'unknown'}; rates {origin})"
        )
    speeds = tuple(devices.speed(device, row) for row in rows)
    return Latency("device", "; ".join(dict.fromkeys(descriptions)), speeds=speeds)


def answer_s(speed: Speed, answer: Answer) -> float:
    """Return the seconds of one answer by its tokens, with its repair turn; NaN if it failed.

    Raises UserError if the answer has no token counts and `speed` needs them.
    """
    if speed.answer_s is not None:
        return (
            math.nan if answer.error is not None else speed.answer_s * answer.turns + answer.slow_s
        )
    return devices.seconds(speed, *tokens(answer)) + answer.slow_s


def answer_j(speed: Speed, answer: Answer) -> float:
    """Return the joules of one answer; NaN if it failed, or its time does not go by tokens.

    Raises UserError if the answer has no token counts and `speed` needs them.
    """
    return math.nan if speed.answer_s is not None else devices.joules(speed, *tokens(answer))


def vehicles_j(
    latency: Latency, scenes: "Sequence[Scene]", answers: Mapping[str, Answer]
) -> Floats:
    """Return the joules of each vehicle's answer in n scenes, `(n, 1+H)`, the ego first.

    `answers` are by request id. NaN for an answer that is missing or has no known tokens, 0 where
    there is no vehicle.
    """
    joules = np.zeros((len(scenes), max(len(scene.viewers) for scene in scenes)))
    for n, scene in enumerate(scenes):
        for place, viewer in enumerate(scene.viewers):
            answer = answers.get(f"{scene.id}/{viewer}")
            joules[n, place] = answer_j(latency.speed(place), answer) if answer else np.nan
    return joules


def helpers_j(infers: Bools, vehicles: Floats) -> Floats:
    """Return the joules of all helpers that infer for each decision, `(n,)`.

    `infers`, `(n, H)`, says who does; columns beyond the vehicles (an attacker's further voices)
    run no model. `vehicles`, `(n, 1+H)`, has the joules of each vehicle's answer, the ego first.
    """
    count = min(infers.shape[1], vehicles.shape[1] - 1)
    own = vehicles[:, 1 : 1 + count]
    return np.asarray(np.sum(np.where(infers[:, :count], own, 0.0), axis=1))


def decided_helpers_j(
    latency: Latency, decided: "Sequence[Decided[Scene]]", answers: Mapping[str, Answer]
) -> Floats:
    """Return the joules of all helpers that infer for each decision, `(n,)`, in given order.

    `answers` are by request id.
    """
    of: dict[int, Floats] = {}
    parts = []
    for part in decided:
        if id(part.decision_points) not in of:
            of[id(part.decision_points)] = vehicles_j(latency, part.decision_points, answers)
        parts.append(helpers_j(part.result.infers, of[id(part.decision_points)][part.due.at]))
    return np.concatenate(parts)


def tokens(answer: Answer) -> tuple[float, float]:
    """Return an answer's prompt and completion tokens, of both turns if it has a repair turn.

    NaN if the engine failed. Raises UserError if the answer has no token counts otherwise.
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
    device: Device,
    latency: Latency,
    points: "Sequence[OperatingPoint]",
    decisions: Decisions,
    answers: Mapping[str, Answer],
) -> dict[str, Floats]:
    """Return the energy of n decisions as columns `(n,)` by name; NaN where a part is unknown.

    `inference_j` has joules of the ego, of the helpers that infer, and of a fusion call; `radio_mj`
    millijoules to send the request and the replies; `waiting_j` joules of the ego's computer while
    it waits for messages and does not infer. `decisions` must have the column `helpers_j`;
    `answers` are by request id.
    """
    ego_j, ego_s, call_j = _inference(latency, points, decisions, answers)
    sent_mj, idle_watts = np.full(len(decisions), np.nan), np.nan
    condition = decisions.codes("condition", [point.name for point in points])
    sent = decisions["requests"] + decisions["messages"]
    for place, point in enumerate(points):
        here = condition == place
        sent_mj[here] = 1000 * radio_j(
            device, point, decisions["airtime_ms"][here] / 1000, sent[here]
        )
        # the ego's model is in a cloud
        if point.cloud.round_trip_s is not None or point.cloud.round_trip:
            ego_j[condition == place], ego_s[condition == place] = np.nan, 0.0
    if device.idle_watts:
        idle_watts = device.idle_watts.value
    waits_s = (decisions["latency_ms"] - decisions["fusion_ms"]) / 1000 - ego_s
    return {
        "inference_j": ego_j + decisions["helpers_j"] + call_j,
        "radio_mj": sent_mj,
        "waiting_j": idle_watts * np.maximum(waits_s, 0.0),
    }


def radio_j(device: Device, point: "OperatingPoint", airtime_s: Floats, messages: Floats) -> Floats:
    """Return the joules to send messages, `(n,)`, from their number and total time on air.

    Where the channel has only bits and a bandwidth, each message takes at least one frame of the
    device profile. A physical radio counts its own frames, with headers.
    """
    if device.frame_ms is not None and not point.physical:
        airtime_s = np.maximum(airtime_s, messages * device.frame_ms.value / 1000)
    return transmit_watts(device, point) * airtime_s


def transmit_watts(device: Device, point: "OperatingPoint") -> float:
    """Return the electric watts of a sending radio; NaN if the device profile states no power.

    From the channel's transmit power in dBm if it has one, else the profile's, and the amplifier's
    efficiency.
    """
    if device.transmit_dbm is None or device.amplifier_efficiency is None:
        return math.nan
    dbm = float(getattr(innermost(point.channel), "power_dbm", device.transmit_dbm.value))
    return 10 ** ((dbm - 30) / 10) / device.amplifier_efficiency.value


def _inference(
    latency: Latency,
    points: "Sequence[OperatingPoint]",
    decisions: Decisions,
    answers: Mapping[str, Answer],
) -> tuple[Floats, Floats, Floats]:
    """Return the ego's joules and seconds, and the joules of fusion calls, (n,) each."""
    egos = {answer.scene: answer for answer in answers.values() if answer.role == "ego"}
    calls = {(a.scene, a.heard): a for a in answers.values() if a.role == "merge"}
    n, condition = len(decisions), decisions.codes("condition", [point.name for point in points])
    fusing = {place: point.rewrites for place, point in enumerate(points) if point.has_fusion_call}
    senders = [decisions.labels(f"helper_{place}") for place in range(1, decisions.helpers + 1)]
    on_time, attackers = (decisions.of_messages(name) == 1.0 for name in ("on_time", "attacker"))
    ego_j, ego_s, call_j = np.zeros((3, n))
    for scene, rows in decisions.scenes.items():
        ego_j[rows.start : rows.stop] = answer_j(latency.speeds[0], egos[scene])
        ego_s[rows.start : rows.stop] = answer_s(latency.speeds[0], egos[scene])
        for row in rows:
            rewrites = fusing.get(int(condition[row]))
            if rewrites is None:
                continue
            heard = []
            for place, column in enumerate(senders):
                helper = column[row]
                if helper and on_time[row, place]:
                    heard.append(key_of(helper, rewrites, attackers[row, place]))
            if heard:
                call_j[row] = answer_j(latency.speeds[0], calls[scene, tuple(heard)])
    return ego_j, ego_s, call_j
