"""Device profiles (`devices/*.toml`, shipped and a project's),
and the time and energy of an answer on one.

A file has one row for each model. A number without a source is left out,
and results from it are not known.
"""

import re
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from harness.core import resources
from harness.core.config import Count, between, convert, toml
from harness.core.errors import UserError, printable, sayable, unknown

Rate = Annotated[float, Meta(gt=0, description="a number above 0")]
Status = Literal["measured", "cited", "modelled", "assumed"]
RATES = ("prefill_tokens_per_s", "decode_tokens_per_s")
# Joules that a row lacks are derived from the power that the device draws, and the rate.
JOULES = {"joules_per_prompt_token": RATES[0], "joules_per_output_token": RATES[1]}
APART = ("answer_ms", "memory_gb")  # numbers of a row from which nothing is derived
MOST = {"amplifier_efficiency": 1.0, "transmit_dbm": 100.0}  # of a device
MOST_BILLIONS, MOST_LETTERS = 1e6, 100  # of a model's weights; of its name
_SIZE = re.compile(r"(\d{1,7}(?:\.\d{1,9})?)b", re.ASCII)


class Speed(Struct, frozen=True):
    """Hold how fast a computer answers one request with a model, and the energy for each token.

    `prefill_tokens_per_s` is for tokens read and `decode_tokens_per_s` for tokens written. In place
    of both, `answer_s` is the seconds of an answer of any length, as makers of decision models
    state it. None is unknown.
    """

    model: str  # the model of the row in the device profile
    prefill_tokens_per_s: Rate | None  # prompt tokens read in a second
    decode_tokens_per_s: Rate | None  # output tokens written in a second
    joules_per_prompt_token: Rate | None = None  # energy to read one token
    joules_per_output_token: Rate | None = None  # energy to write one token
    # seconds of an answer of any length, as makers of decision models state it
    answer_s: Rate | None = None


class Constant(Struct, frozen=True):
    """Hold a number of a device profile, in the unit that the name of its field says.

    `status` is how it was come by (`measured` here, `cited`, `modelled` from others, or `assumed`),
    and `source` a text that says where it comes from.
    """

    value: Annotated[float, between(1e-9, 1e9)]  # in the unit that the field which holds it says
    status: Status  # whether it was measured here, cited, modelled from others, or assumed
    # a text that says where it comes from
    source: Annotated[str, Meta(min_length=1, description="where the number comes from")]


class DeviceRow(Struct, frozen=True, kw_only=True):
    """Hold the speed, energy and memory of a device with one model; None where unknown.

    `billions` is the number of weights in 10^9, `precision` their number format, and `batch_size`
    how many requests went through the device together when it was timed. Rates are for tokens read
    (`prefill`) and written (`decode`); joules include the device's idle draw. `answer_ms` is the
    time of a decision model's answer, in place of rates. `memory_gb` is what the model takes, in
    10^9 bytes.
    """

    model: str  # the model's name; that of a card, if there is one
    # billions of weights
    billions: Annotated[float, between(1e-9, MOST_BILLIONS)]
    precision: str  # number format of the weights
    batch_size: Count  # requests that went through the device together when it was timed
    prefill_tokens_per_s: Constant | None = None  # prompt tokens read in a second
    decode_tokens_per_s: Constant | None = None  # output tokens written in a second for one request
    # energy to read one token, the device's idle draw included
    joules_per_prompt_token: Constant | None = None
    # energy to write one token, the device's idle draw included
    joules_per_output_token: Constant | None = None
    # one answer of a decision model, in ms; it stands in place of rates, since nobody says how long
    # the question was
    answer_ms: Constant | None = None
    memory_gb: Constant | None = None  # memory that the model takes, in 10^9 bytes

    def __post_init__(self) -> None:
        if not 0 < len(self.model) <= MOST_LETTERS:
            words = printable(self.model, 40)
            raise ValueError(f"model is {words!r}; give 1 to {MOST_LETTERS} characters")
        try:
            sayable("model", self.model)
        except UserError as error:
            raise ValueError(str(error)) from None


class Device(Struct, frozen=True, kw_only=True):
    """Hold a device profile, a file of `devices/`: an on-board computer, with a row for each model.

    `scaling` says how a model without a row is timed: `weights` scales the nearest row by the
    number of weights; None refuses it. `load_watts` is drawn while it infers, `idle_watts` while it
    waits. Of the radio, `transmit_dbm` is the power radiated, `amplifier_efficiency` its share of
    what is drawn, and `frame_ms` the least time on air of a message. `memory_gb` is the computer's,
    in 10^9 bytes. None is unknown.
    """

    name: str  # the file's name
    description: str  # one sentence for lists
    power_mode: str  # the power mode in which it was timed
    rows: tuple[DeviceRow, ...]  # one row for each model
    # how a model without a row is timed: `weights` scales the nearest row inversely to the number
    # of weights; None refuses the model
    scaling: Literal["weights"] | None = None
    # its draw while it infers; a row without joules per token gets them from this
    load_watts: Constant | None = None
    idle_watts: Constant | None = None  # its draw while it waits
    transmit_dbm: Constant | None = None  # radiated power of its radio, if the channel states none
    # the share of the radio amplifier's draw that is radiated
    amplifier_efficiency: Constant | None = None
    # least time on air of a message under a channel that states bits and bandwidth alone; None
    # counts only these
    frame_ms: Constant | None = None
    # the computer's memory, shared by its CPU and GPU where it has one
    memory_gb: Constant | None = None

    def __post_init__(self) -> None:
        names = [row.model for row in self.rows]
        if not names or len(set(names)) < len(names):
            raise ValueError("rows: give one or more, of different models")
        for name, most in MOST.items():
            constant: Constant | None = getattr(self, name)
            if constant and constant.value > most:
                raise ValueError(f"{name} is {constant.value:g}; give {most:g} at most")
        for row in self.rows:
            if row.answer_ms and (row.prefill_tokens_per_s or row.decode_tokens_per_s):
                raise ValueError(
                    f"row of {printable(row.model)}: give answer_ms or rates, not both"
                )


def names() -> list[str]:
    """Return the sorted names of all device profiles, those that ship and the project's.

    A device profile is a file of `devices/`, such as `agx-orin`: an on-board computer's speed and
    power with some models.
    """
    return resources.names("devices")


def load(name: str) -> Device:
    """Return the device profile of a name: an on-board computer's speeds with several models.

    Raises UserError if there is none, or its file is wrong.
    """
    if name not in names():
        raise unknown("device profile", name, names())
    path = resources.find("devices", f"{name}.toml")
    where = f"device profile {printable(path)}"
    table = toml(path, where)
    sources = table.pop("sources", {})
    if not isinstance(sources, dict) or not all(isinstance(text, str) for text in sources.values()):
        raise UserError(f"{where} [sources]: give each source a name and a text")
    return convert(_with_sources(table, sources), Device, where, name=name)


def _with_sources(value: Any, sources: dict[str, str]) -> Any:
    if isinstance(value, list):
        return [_with_sources(item, sources) for item in value]
    if not isinstance(value, dict):
        return value
    source = value.get("source")
    named = {"source": sources.get(source, source)} if isinstance(source, str) else {}
    return {key: _with_sources(inner, sources) for key, inner in value.items()} | named


def find_row(device: Device, model: str) -> DeviceRow:
    """Return a device profile's row for a model: the computer's speed, energy and memory with it.

    `device` is the profile, of an on-board computer. `model` is the name of a row, or a size such
    as `3b`, in billions of weights; if the profile allows scaling, the nearest row is then scaled
    by the number of weights. Raises UserError if the profile has no row for it.
    """
    by_name = {row.model: row for row in device.rows}
    if model in by_name:
        return by_name[model]
    size = _SIZE.fullmatch(model)
    if size and 0 < float(size[1]) <= MOST_BILLIONS and device.scaling:
        return _scaled(device, float(size[1]))
    hint = "; give one of them as --device-model"
    if device.scaling:
        hint += ", or a size such as 3b, which the nearest one is scaled to"
    raise unknown(f"model of device profile {device.name}", model, by_name, hint)


def _scaled(device: Device, billions: float) -> DeviceRow:
    """Scale the row with the nearest number of weights, by ratio;
    rates go down as the weights go up.
    """
    rated = [row for row in device.rows if not row.answer_ms]
    near = min(rated, key=lambda row: max(row.billions, billions) / min(row.billions, billions))
    ratio = billions / near.billions

    def scaled(constant: Constant | None, factor: float) -> Constant | None:
        source = f"{near.model} times {factor:.3g}, by the number of weights"
        return constant and Constant(constant.value * factor, "modelled", source)

    factors = {**dict.fromkeys(RATES, 1 / ratio), **dict.fromkeys((*JOULES, "memory_gb"), ratio)}
    values = {name: scaled(getattr(near, name), factor) for name, factor in factors.items()}
    return msgspec.structs.replace(
        near, model=f"{billions:g}b from {near.model}", billions=billions, **values
    )


def constants(device: Device, row: DeviceRow) -> Iterator[tuple[str, Constant | None]]:
    """Yield the names and values of a row's tokens a second and joules a token; None if unknown.

    A row is a device's speed and energy with one model. The figures are for tokens read and for
    tokens written. Joules that the row lacks are the power that the device draws while it infers
    (`load_watts`), divided by the rate.
    """
    for name in RATES:
        yield name, getattr(row, name)
    for name, rate in JOULES.items():
        joules, per_s = getattr(row, name), getattr(row, rate)
        if joules is None and per_s is not None and device.load_watts is not None:
            watts = device.load_watts
            source = f"{watts.value:g} W over {per_s.value:g} tokens/s; {watts.source}"
            joules = Constant(watts.value / per_s.value, "modelled", source)
        yield name, joules


def speed(device: Device, row: DeviceRow) -> Speed:
    """Return a row's tokens a second and joules a token as plain numbers, without their sources.

    A row is a device's speed and energy with one model. Joules that it lacks are the power that the
    device draws while it infers, divided by the rate. None is unknown.
    """
    answer_s = row.answer_ms.value / 1000 if row.answer_ms else None
    rates = {name: c.value if c else None for name, c in constants(device, row)}
    return Speed(row.model, **rates, answer_s=answer_s)


def seconds(speed: Speed, prompt_tokens: float, output_tokens: float) -> float:
    """Return the seconds of one answer: tokens read and tokens written, each divided by its rate.

    `speed` has the device's rates with the model. A model with a fixed answer time has that; NaN if
    unknown.
    """
    if speed.answer_s is not None:
        return speed.answer_s
    rates = _or_nan(speed.prefill_tokens_per_s), _or_nan(speed.decode_tokens_per_s)
    return prompt_tokens / rates[0] + output_tokens / rates[1]


def joules(speed: Speed, prompt_tokens: float, output_tokens: float) -> float:
    """Return the joules of one answer: tokens read and written, each times the joules of one.

    Idle power is included. `speed` has the device's joules with the model; NaN if unknown.
    """
    per_token = _or_nan(speed.joules_per_prompt_token), _or_nan(speed.joules_per_output_token)
    return prompt_tokens * per_token[0] + output_tokens * per_token[1]


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value
