"""Device profiles: files `devices/*.toml`, shipped and a project's, and how fast a model answers on one.

A file has a row a model. A number that nobody states is left out, and what follows from it is not known.
"""

import re
from collections.abc import Iterator
from typing import Any

import msgspec

from harness.core import resources
from harness.core.config import convert, toml
from harness.core.errors import UserError, printable, unknown
from harness.runs.records import Constant, Device, DeviceRow, Speed

RATES = ("prefill_tokens_per_s", "decode_tokens_per_s")
# Joules that a row does not have follow from the power that the device draws, and from the rate.
JOULES = {"joules_per_prompt_token": RATES[0], "joules_per_output_token": RATES[1]}
_SIZE = re.compile(r"(\d+(?:\.\d+)?)b")


def names() -> list[str]:
    """Names of all device profiles, sorted."""
    return resources.names("devices")


def load(name: str) -> Device:
    """The profile of a name.

    Raises:
        UserError: there is none, or its file has a mistake.
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
    """The same, with the text of each source in place of its name."""
    if isinstance(value, list):
        return [_with_sources(each, sources) for each in value]
    if not isinstance(value, dict):
        return value
    return {
        key: sources.get(inner, inner) if key == "source" and isinstance(inner, str)
        else _with_sources(inner, sources)
        for key, inner in value.items()
    }  # fmt: skip


def row_of(device: Device, model: str) -> DeviceRow:
    """The row of a model: its own, or, where the profile says how, the nearest one scaled.

    Args:
        device: the profile.
        model: name of a row, of a card, or a size such as `3b`, in billions of weights.

    Raises:
        UserError: the profile says nothing of it.
    """
    by_name = {row.model: row for row in device.rows}
    if model in by_name:
        return by_name[model]
    size = _SIZE.fullmatch(model)
    if size and float(size[1]) and device.scaling:
        return _scaled(device, float(size[1]))
    hint = "; give one of them as --device-model"
    if device.scaling:
        hint += ", or a size such as 3b, which the nearest one is scaled to"
    raise unknown(f"model of device profile {device.name}", model, by_name, hint)


def _scaled(device: Device, billions: float) -> DeviceRow:
    """The row whose number of weights is nearest by its ratio, with rates in inverse proportion."""
    near = min(device.rows, key=lambda row: max(row.billions, billions) / min(row.billions, billions))
    times = billions / near.billions

    def moved(constant: Constant | None, factor: float) -> Constant | None:
        source = f"{near.model} times {factor:.3g}, by the number of weights"
        return constant and Constant(constant.value * factor, "modelled", source)

    return msgspec.structs.replace(
        near, model=f"{billions:g}b from {near.model}", billions=billions,
        **{name: moved(getattr(near, name), 1 / times) for name in RATES},
        **{name: moved(getattr(near, name), times) for name in JOULES},
    )  # fmt: skip


def constants(device: Device, row: DeviceRow) -> Iterator[tuple[str, Constant | None]]:
    """Rates and joules of a row, each by its name; joules that the row does not have from `load_watts`."""
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
    """What follows for an answer, in plain numbers."""
    return Speed(row.model, **{name: c.value if c else None for name, c in constants(device, row)})


def seconds(speed: Speed, prompt_tokens: float, output_tokens: float) -> float:
    """Of one answer: tokens in over the rate of prefill, tokens out over that of decoding; NaN if unknown."""
    rates = _known(speed.prefill_tokens_per_s), _known(speed.decode_tokens_per_s)
    return prompt_tokens / rates[0] + output_tokens / rates[1]


def joules(speed: Speed, prompt_tokens: float, output_tokens: float) -> float:
    """Of one answer, the device's idling meanwhile included; NaN if unknown."""
    each = _known(speed.joules_per_prompt_token), _known(speed.joules_per_output_token)
    return prompt_tokens * each[0] + output_tokens * each[1]


def _known(value: float | None) -> float:
    return float("nan") if value is None else value
