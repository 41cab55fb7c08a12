"""What answers take on a declared computer, by their own tokens: seconds, and joules of each decision.

Who is in time follows from the seconds, never from how fast this machine is. A beginning that two prompts
share is read anew each time.
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
    """The row of a device profile by which each agent is timed: `model`'s, or its own card's.

    Raises:
        UserError: an agent counts no tokens, or the profile has no row for it, or no rates.
    """
    found, flag = [], f"--device-profile {printable(device.name)}"
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
        found.append(row)
    return found


def of_device(device: Device, model: str | None, agents: "Sequence[Agent]") -> Latency:
    """Each answer's own time on a declared computer; arguments as in `rows_of`."""
    rows, said = rows_of(device, model, agents), []
    for agent, row in zip(agents, rows, strict=True):
        own = agent.card.name.partition(":")[0] == row.model
        whose = agent.card.name + ("" if own else f"'s answers at the speed of {row.model}")
        rates = [cast("Constant", getattr(row, rate)) for rate in devices.RATES]
        origin = "; ".join(dict.fromkeys(f"{each.status}: {each.source}" for each in rates))
        joules = {c.status for name, c in devices.constants(device, row) if c and name in devices.JOULES}
        said.append(
            f"{whose} on {device.name} ({row.precision}, batch {row.batch_size}; joules "
            f"{' and '.join(sorted(joules)) or 'unknown'}; rates {origin})"
        )
    speeds = tuple(devices.speed(device, row) for row in rows)
    return Latency("device", "; ".join(dict.fromkeys(said)), speeds=speeds)


def answer_s(speed: Speed, answer: Answer) -> float:
    """Seconds of one answer by its own tokens, those of a repair turn included; NaN where the engine failed.

    Raises:
        UserError: nobody counted its tokens.
    """
    return devices.seconds(speed, *tokens(answer)) + answer.slow_s


def answer_j(speed: Speed, answer: Answer) -> float:
    """Joules of one answer, as `answer_s` has its seconds."""
    return devices.joules(speed, *tokens(answer))


def vehicles_j(latency: Latency, scenes: "Sequence[Scene]", answers: Mapping[str, Answer]) -> Floats:
    """Joules of each vehicle's own answer, (n, 1+H), the ego first; NaN where it has none.

    Args:
        latency: of a run with a device profile.
        scenes: decision points.
        answers: by request id.
    """
    taken = np.full((len(scenes), max(len(scene.viewers) for scene in scenes)), np.nan)
    for n, scene in enumerate(scenes):
        for place, viewer in enumerate(scene.viewers):
            if answer := answers.get(f"{scene.id}/{viewer}"):
                taken[n, place] = answer_j(latency.speed(place), answer)
    return taken


def tokens(answer: Answer) -> tuple[float, float]:
    """Tokens in and out, of both turns where there were two; NaN where the engine failed.

    Raises:
        UserError: nobody counted them.
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
    """What each decision takes, columns (n,) by name; NaN where a number of it is not known.

    Args:
        device: what every vehicle has.
        latency: of the run.
        points: its conditions.
        decisions: its decisions.
        answers: all of its answers.

    Returns:
        `inference_j`, of the ego, the helpers asked, and a fusion call; `helpers_j`, the helpers' part of it;
        `radio_mj`, to send the request and the replies; `waiting_j`, of the ego's computer while it waits for
        messages and does not infer.
    """
    ego_j, ego_s, helpers_j, call_j = _inferred(latency, points, decisions, answers)
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
    """What a radio draws while it sends, by the channel's power or else the profile's; NaN if unknown."""
    if device.transmit_dbm is None or device.amplifier_efficiency is None:
        return math.nan
    dbm = float(getattr(innermost(point.channel), "power_dbm", device.transmit_dbm.value))
    return 10 ** ((dbm - 30) / 10) / device.amplifier_efficiency.value


def _inferred(
    latency: Latency, points: "Sequence[OperatingPoint]", decisions: Decisions, answers: Iterable[Answer]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Joules and seconds of the ego's inference, joules of the helpers' and of fusion calls, each (n,)."""
    by_id = {answer.id: answer for answer in answers}
    egos = {answer.scene: answer for answer in by_id.values() if answer.role == "ego"}
    calls = {(a.scene, a.heard): a for a in by_id.values() if a.role == "merge"}
    n, condition = len(decisions), decisions.codes("condition", [point.name for point in points])
    fusing = {place: point.rewrites for place, point in enumerate(points) if point.asks_again}
    senders = [decisions.labels(f"helper_{place}") for place in range(1, decisions.helpers + 1)]
    on_time, attacks = (decisions.of_messages(name) == 1.0 for name in ("on_time", "attacker"))
    ego_j, ego_s, helpers_j, call_j = np.zeros((4, n))
    for scene, rows in decisions.scenes.items():
        ego_j[rows.start : rows.stop] = answer_j(latency.speeds[0], egos[scene])
        ego_s[rows.start : rows.stop] = answer_s(latency.speeds[0], egos[scene])
        of_helpers: dict[str, float] = {}
        for row in rows:
            asked = [(place, who) for place, column in enumerate(senders) if (who := column[row])]
            for place, who in asked:
                if who not in of_helpers:  # a further voice of an attacker thinks nothing of its own
                    answer = by_id.get(f"{scene}/{who}")
                    of_helpers[who] = answer_j(latency.speed(1 + place), answer) if answer else 0.0
                helpers_j[row] += of_helpers[who]
            if rewrites := fusing.get(int(condition[row])):
                heard = tuple(
                    key_of(who, rewrites, attacks[row, at]) for at, who in asked if on_time[row, at]
                )
                call_j[row] = answer_j(latency.speeds[0], calls[scene, heard]) if heard else 0.0
    return ego_j, ego_s, helpers_j, call_j
