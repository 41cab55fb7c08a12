"""Time answers on a declared computer by their own tokens, and say what they cost:
seconds, and joules of a decision.

Which helpers are in time follows from these seconds, never from the speed of this machine. A prefix
that two prompts share is counted as read each time.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import msgspec
import numpy as np

from harness.core import resources
from harness.core.arrays import Bools, Floats
from harness.core.errors import UserError, printable
from harness.evaluate.fusion import key_of
from harness.extensions.devices import profiles
from harness.extensions.devices.profiles import Constant, Device, DeviceRow, Speed
from harness.radio.wrapped import innermost
from harness.runs.records import Answer, Latency, Manifest
from harness.runs.timers import Timer

if TYPE_CHECKING:
    from harness.coordination.exchange import Exchange
    from harness.coordination.operating_point import OperatingPoint
    from harness.dataset.load import Scene
    from harness.evaluate.agent import Agent
    from harness.evaluate.spec import Spec
    from harness.evaluate.walk import Decided

Answers = Mapping[str, Answer]  # by request id
SOURCE = "device"  # of a latency
PROFILE, MODEL = "device_profile", "device_model"  # settings of a run


@dataclass(frozen=True)
class Computer(Timer):
    """Time each answer by its tokens, as a computer in every vehicle would take for it.

    It is the timer that the option `--device-profile` chooses. `device` states how many tokens a
    second the computer reads and writes with a model, and how many joules a token takes; it is None
    where none is chosen. `model` names the one whose speed holds for all answers; if empty, that of
    the model which gave the answer does. `adds` has the columns of energy that it adds to the table
    of decisions, each with the one behind which it stands; `how` says in words where times come
    from.
    """

    option: ClassVar[str] = "--device-profile"
    chosen_by: ClassVar[tuple[str, ...]] = (PROFILE, MODEL)
    how: ClassVar[str] = "computed for each answer from its tokens, on a declared device"
    adds: ClassVar[Mapping[str, str]] = {
        # joules of inference: the ego's, of helpers that infer, and of a fusion call
        "inference_j": "busy_ratio",
        "helpers_j": "busy_ratio",  # the helpers' part of it
        "radio_mj": "busy_ratio",  # millijoules to send all messages, those unasked too
        # joules of the ego's computer while it waits for messages and does not infer
        "waiting_j": "busy_ratio",
    }

    device: Device | None = None  # its profile; None where nothing is open
    model: str = ""  # whose row times all answers; empty for the one that gave each

    @property
    def profile(self) -> Device:
        assert self.device is not None
        return self.device

    def opened(self, settings: Mapping[str, Any]) -> "Computer | None":
        name, model = settings.get(PROFILE), settings.get(MODEL, "")
        if name:
            return Computer(profiles.load(name), model)
        if model:
            raise UserError(
                f"--device-model {printable(model)} is a device's row; give {self.option} as well"
            )
        return None

    def recorded(self, manifest: Manifest) -> "Computer | None":
        if (profile := manifest.beside.get(PROFILE)) is None:
            return None
        model = msgspec.convert(manifest.settings.extensions.get(MODEL, ""), str)
        return Computer(msgspec.convert(profile, Device), model)

    def speed(self, stated_speed: Any) -> Speed:
        if isinstance(stated_speed, Speed):
            return stated_speed
        return msgspec.convert(stated_speed, Speed)

    def speeds(self, models: Sequence[str]) -> tuple[Speed, ...]:
        return tuple(profiles.speed(self.profile, self._row_of(model)) for model in models)

    def changed(self) -> str | None:
        name = self.profile.name
        if name in profiles.names() and profiles.load(name) == self.profile:
            return None
        return f"run.json has device profile {printable(name)} otherwise than it is here"

    def answer_s(self, speed: Speed, answer: Answer) -> float:
        return answer_s(speed, answer)

    def check(self, run: "Spec") -> None:
        if run.settings.latency is not None:
            raise UserError(
                f"{self._typed} says how long answers take, as --latency "
                f"{printable(run.settings.latency)} does; give one of the two"
            )
        self.rows_of(run.agents)

    def obstacle(self, point: "OperatingPoint") -> str | None:
        if point.content.of_agents:
            return f"no energy is known of answers to plans; leave {self.option} out"
        if point.has_fusion_call and point.elsewhere:
            return (
                "energy is known of messages of the ego's own layout alone; leave "
                f"{self.option} out, or the control"
            )
        return None

    def latency(self, agents: "Sequence[Agent]") -> Latency:
        device, rows, descriptions = self.profile, self.rows_of(agents), []
        for agent, row in zip(agents, rows, strict=True):
            own_row = agent.card.name.partition(":")[0] == row.model
            answerer = agent.card.name
            if not own_row:
                answerer += f"'s answers at the speed of {row.model}"
            timed = ["answer_ms"] if row.answer_ms else profiles.RATES
            rates = [cast("Constant", getattr(row, name)) for name in timed]
            origin = "; ".join(dict.fromkeys(f"{rate.status}: {rate.source}" for rate in rates))
            joules = set()
            for name, constant in profiles.constants(device, row):
                if constant and name in profiles.JOULES:
                    joules.add(constant.status)
            descriptions.append(
                f"{answerer} on {device.name} ({row.precision}, batch {row.batch_size}; joules "
                f"{' and '.join(sorted(joules)) or 'unknown'}; rates {origin})"
            )
        speeds = self.speeds([agent.card.name for agent in agents])
        return Latency(SOURCE, "; ".join(dict.fromkeys(descriptions)), speeds=speeds)

    def rows_of(self, agents: "Sequence[Agent]") -> list[DeviceRow]:
        """Return for each agent, a model with its prompt, the device's row that times its answers.

        That is the row of `model`, or if empty that of the agent's own model. Raises UserError if
        an agent's model counts no tokens, or the profile has no such row or no rates in it.
        """
        rows = []
        for agent in agents:
            name = printable(agent.card.name)
            if not agent.can.language_model:
                raise UserError(
                    f"{self._typed}: {name} is no language model and counts no tokens; leave it out"
                )
            rows.append(self._row_of(agent.card.name))
        return rows

    def _row_of(self, model: str) -> DeviceRow:
        """Return the row that times the answers of a model, by its card's name."""
        row = profiles.find_row(self.profile, self.model or model.partition(":")[0])
        for rate in profiles.RATES if row.answer_ms is None else ():
            if getattr(row, rate) is None:
                raise UserError(
                    f"{self._typed} states no {rate} of {printable(row.model)}, so it cannot "
                    "time answers; give another device, or another --device-model"
                )
        return row

    @property
    def _typed(self) -> str:
        return f"{self.option} {printable(self.profile.name)}"

    def settings(self) -> dict[str, Any]:
        named = {PROFILE: self.profile.name, MODEL: self.model}
        return {name: value for name, value in named.items() if value}

    def record(self) -> dict[str, Any]:
        return {**self.settings(), PROFILE: msgspec.to_builtins(self.profile)}

    def files(self) -> Mapping[str, Path]:
        name = self.profile.name
        if name not in profiles.names() or profiles.load(name) != self.profile:
            return {}
        return {f"devices/{name}.toml": resources.find("devices", f"{name}.toml")}

    def columns(
        self, latency: Latency, decided: "Sequence[Decided[Scene]]", answers: Answers
    ) -> dict[str, Floats]:
        """Return the energy of each of n decisions, (n,), by column of the table of decisions.

        `inference_j` has joules of the ego, of the helpers that infer, and of a fusion call (a
        second question to the ego's model), and `helpers_j` the helpers' alone; `radio_mj`
        millijoules to send all messages, those unasked too; `waiting_j` joules of the ego's
        computer while it waits for messages and does not infer. NaN where one of these is unknown.

        Args:
            latency: how long answers take, with each agent's speed on the device. An agent is a
                model with its prompt.
            decided: the decisions of each step and condition (settings of radio, asking and
                fusion).
            answers: the models' answers by request id.
        """
        parts = [self._columns_of(latency, part, answers) for part in decided]
        columns = {}
        for name in parts[0]:
            columns[name] = np.concatenate([part[name] for part in parts])
        return columns

    def _columns_of(
        self, latency: Latency, part: "Decided[Scene]", answers: Answers
    ) -> dict[str, Floats]:
        point, result, at = part.point, part.result, part.due.at
        vehicles_j = self.joules(latency, point, part.decision_points, answers)[at]
        of_helpers_j = helpers_j(result.infers, vehicles_j)
        ego_s = _egos_s(latency, part.decision_points, answers)[at]
        if _in_cloud(point):
            ego_s = np.zeros(len(at))
        sent, airtime_s = _asked_for(result)
        if part.streamed:
            sent, airtime_s = sent + part.streamed.messages, airtime_s + part.streamed.airtime_s
        # as the table of decisions has them, in milliseconds
        airtime_ms, decided_ms = airtime_s * 1000, result.latency_s * 1000
        waits_s = (decided_ms - result.fusion_s * 1000) / 1000 - ego_s
        idle = self.profile.idle_watts
        idle_watts = idle.value if idle else math.nan
        calls_j = _calls_j(latency, part, answers)
        return {
            "inference_j": vehicles_j[:, 0] + of_helpers_j + calls_j,
            "helpers_j": of_helpers_j,
            "radio_mj": 1000 * self._radio_j(point, sent, airtime_ms / 1000),
            "waiting_j": idle_watts * np.maximum(waits_s, 0.0),
        }

    def joules(
        self,
        latency: Latency,
        point: "OperatingPoint",
        scenes: "Sequence[Scene]",
        answers: Answers,
    ) -> Floats:
        """Return the joules of each vehicle's answer in n scenes, (n, 1+H), the ego first.

        The H helpers follow. `latency` has the device's speed with each agent's model, `point` is
        the settings of radio, asking and fusion, and `answers` are by request id. NaN for an answer
        that is missing, has no known tokens, or came from a cloud; 0 where there is no vehicle.
        """
        joules = np.zeros((len(scenes), max(len(scene.viewers) for scene in scenes)))
        for n, scene in enumerate(scenes):
            for place, viewer in enumerate(scene.viewers):
                answer = answers.get(f"{scene.id}/{viewer}")
                joules[n, place] = answer_j(latency.speed(place), answer) if answer else np.nan
        if _in_cloud(point):
            joules[:, 0] = np.nan
        return joules

    def energy_j(self, point: "OperatingPoint", heard: "Exchange", joules: Floats) -> Floats:
        radio_j = self._radio_j(point, *_asked_for(heard))
        return np.asarray(joules[:, 0] + helpers_j(heard.infers, joules) + radio_j)

    def _radio_j(self, point: "OperatingPoint", sent: Floats, airtime_s: Floats) -> Floats:
        """Return the joules to send the `sent` messages of n decisions, `(n,)`, by time on air.

        Where the channel has only bits and a bandwidth, each message takes at least one frame of
        the device profile. A physical radio counts its own frames, with headers.
        """
        frame_ms = self.profile.frame_ms
        if frame_ms is not None and not point.physical:
            airtime_s = np.maximum(airtime_s, sent * frame_ms.value / 1000)
        return transmit_watts(self.profile, point) * airtime_s


def _asked_for(heard: "Exchange") -> tuple[Floats, Floats]:
    """Return how many messages each of n decisions asked for, requests too, and their airtime, s,
    `(n,)` each.
    """
    return (heard.requests + heard.messages).astype(float), heard.airtime_s


TIMER = Computer()


def answer_s(speed: Speed, answer: Answer) -> float:
    """Return the seconds that an answer takes on a computer; NaN if it failed.

    `speed` has the computer's rates with the model, tokens a second. Seconds go by the answer's
    tokens, or are the same for all answers if `speed` says so. A repair turn, a second question
    after an answer that cannot be parsed, is included. Raises UserError if the answer has no token
    counts and `speed` needs them.
    """
    if speed.answer_s is not None:
        if answer.error is not None:
            return math.nan
        return speed.answer_s * answer.turns + answer.slow_s
    return profiles.seconds(speed, *tokens(answer)) + answer.slow_s


def answer_j(speed: Speed, answer: Answer) -> float:
    """Return the joules that an answer takes on a computer, by its tokens.

    `speed` is the computer's with the model, and has the joules of a token. NaN if the answer
    failed, or if `speed` has seconds for an answer of any length and no energy a token. Raises
    UserError if the answer has no token counts and `speed` needs them.
    """
    return math.nan if speed.answer_s is not None else profiles.joules(speed, *tokens(answer))


def helpers_j(infers: Bools, vehicles: Floats) -> Floats:
    """Return the joules of all helpers that infer for each of n decisions, `(n,)`.

    `infers`, `(n, H)`, says which of H helpers do; columns beyond the vehicles, further names under
    which an attacker sends, run no model. `vehicles`, `(n, 1+H)`, has the joules of each vehicle's
    answer, the ego first.
    """
    count = min(infers.shape[1], vehicles.shape[1] - 1)
    joules = vehicles[:, 1 : 1 + count]
    return np.asarray(np.sum(np.where(infers[:, :count], joules, 0.0), axis=1))


def tokens(answer: Answer) -> tuple[float, float]:
    """Return how many tokens an answer reads and how many it writes.

    A model is asked again, once, if its answer cannot be parsed and the run has repair turns; then
    both turns are counted. Both are NaN if the engine failed. Raises UserError if the answer has no
    token counts otherwise.
    """
    if answer.prompt_tokens is not None and answer.completion_tokens is not None:
        return answer.prompt_tokens, answer.completion_tokens
    if answer.error is None:
        raise UserError(
            f"answer {printable(answer.id)} has no token counts, so no device profile can time it; "
            "use --latency"
        )
    return math.nan, math.nan


def transmit_watts(device: Device, point: "OperatingPoint") -> float:
    """Return the electric power of a radio while it sends, in W; NaN if the profile does not say.

    It is the transmit power over the amplifier's efficiency. `point` is the settings of radio,
    asking and fusion; the power is that of its channel, if it has one, else the device profile's.
    """
    if device.transmit_dbm is None or device.amplifier_efficiency is None:
        return math.nan
    dbm = float(getattr(innermost(point.channel), "power_dbm", device.transmit_dbm.value))
    return 10 ** ((dbm - 30) / 10) / device.amplifier_efficiency.value


def _in_cloud(point: "OperatingPoint") -> bool:
    """Return whether the ego's model is in a cloud, whose computer nobody declares."""
    return point.cloud.round_trip_s is not None or bool(point.cloud.round_trip)


def _egos_s(latency: Latency, scenes: "Sequence[Scene]", answers: Answers) -> Floats:
    """Return the seconds of the ego's own answer in each scene, (n,)."""
    egos = [answers[f"{scene.id}/{scene.viewers[0]}"] for scene in scenes]
    return np.array([answer_s(latency.speeds[0], ego) for ego in egos])


def _calls_j(latency: Latency, part: "Decided[Scene]", answers: Answers) -> Floats:
    """Return the joules of each decision's fusion call, (n,); 0 without one."""
    point, heard = part.point, part.result.asked & part.result.on_time
    joules = np.zeros(len(heard))
    if not point.has_fusion_call:
        return joules
    for row in np.flatnonzero(heard.any(axis=1)).tolist():
        scene = part.decision_points[part.due.at[row]]
        senders = []
        for place in np.flatnonzero(heard[row]).tolist():
            attacks = bool(part.said.attackers[row, place])
            senders.append(key_of(scene.viewers[1 + place], point.rewrites, attacks))
        call = answers["/".join((scene.id, "+".join((scene.viewers[0], *senders))))]
        joules[row] = answer_j(latency.speeds[0], call)
    return joules
