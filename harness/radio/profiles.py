"""Channel profiles by name: files `channels/*.toml`, shipped and a project's,
and those that packages add.

A file names a model and its parameters, and states their source. A package adds a profile by an
entry point in the group `swarmdrive.channels`.
"""

import os
from dataclasses import MISSING, asdict, dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from harness.core import strangers
from harness.core.config import convert, settable, toml
from harness.core.errors import UserError, printable, unknown
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.files import read_once, state_of
from harness.core.plugins import FilesAndPlugins, Shipped
from harness.core.strangers import worded
from harness.radio.channel import Channel
from harness.radio.constant import Radio
from harness.radio.wrapped import Wrapped, is_ours

# Models by name: a class, or a function of a file's parameters, its folder and their name in
# messages. Beside the paper's, only extensions that ship have one.
MODELS = Shipped[Any]("swarmdrive.channel_models", object, {"constant": Radio})


@dataclass(frozen=True)
class Profile:
    """Hold the content of a channel profile, a file of `channels/`: model, parameters, source.

    A channel decides which messages over the radio arrive, and when.
    """

    model: str  # name of the channel model, one of `MODELS`
    description: str  # one sentence for lists
    source: str  # source of the model and its parameters
    # the source's kind: `measured` on radios, `cited` from a publication, `modelled`, or `assumed`
    status: Literal["measured", "cited", "modelled", "assumed"]
    parameters: dict[str, Any] = field(default_factory=dict)  # the model's parameters, by name
    # for some parameters, by name, the least and largest value for which the source validated the
    # model
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)


class Profiles(FilesAndPlugins[Channel]):
    """Hold the channels of all profiles by name, from files and from packages.

    A channel decides which messages over the radio arrive, and when. A profile states its model and
    parameters.
    """

    folder = "channels"

    def check(self, name: str, plugin: Channel) -> None:
        """Raise ValueError or UserError if a package's channel, `plugin`, may not be used.

        `name` is what it is called. Results of a package's own model are checked at each call, but
        those of the harness's models are not: a channel of one must have parameters that a
        profile's file could have.
        """
        if strangers.is_ours(plugin):
            if isinstance(plugin, Wrapped):
                raise ValueError("it changes a channel of the harness's; write one of your own")
            parameters = {each.name: getattr(plugin, each.name) for each in fields(plugin)}
            convert(parameters, type(plugin), self.of_package(name))

    def read(self, file: Path) -> Channel:
        return _read(file)[1]

    def profile(self, name: str) -> Profile:
        """Return what the file of the channel `name` says: its model, parameters and source.

        For a package's channel, which has no file, it is made of the channel's class.
        """
        if file := self.file(name):
            return _read(file)[0]
        kind = type(self[name])
        doc = (kind.__doc__ or "").strip().partition("\n")[0]
        return Profile(kind.__name__, doc, f"the package that has {kind.__module__}", "assumed")

    def files(self, name: str) -> dict[str, Path]:
        """Return the files that the channel `name` is made of, by their paths within `channels/`.

        They are its profile, and the table that it names, if any. There are none for a package's
        channel.
        """
        file = self.file(name)
        if file is None:
            return {}
        files, profile = {file.name: file}, self.profile(name)
        if table := _table(file, profile):  # it lies beside the profile, as reading it has checked
            files[Path(os.path.normpath(profile.parameters["file"])).as_posix()] = table
        return files

    def unchanged(self, name: str, recorded: Any) -> bool:
        """Return whether the channel `name` still does what a run recorded of it.

        `recorded` is what `record` returned then: model and parameters are compared. A parameter
        that it lacks, as it is newer than the run, counts as recorded with its default.
        """
        if name not in self:
            return False
        now, then = self.record(name), msgspec.to_builtins(recorded)
        defaults = {f.name: f.default for f in fields(self[name]) if f.default is not MISSING}
        before = {**msgspec.to_builtins(defaults), **then["parameters"]}
        return bool((now["model"], now["parameters"]) == (then["model"], before))

    def record(self, name: str) -> dict[str, Any]:
        """Return the profile of the channel `name` as plain values, for a run's manifest.

        The keys are the fields of `Profile`; `parameters` has all of the model's, defaults too.
        """
        parameters = asdict(self[name])
        plain = {**asdict(self.profile(name)), "parameters": parameters}
        with worded(f"channel profile {printable(name)}", built_in=is_ours(self[name])):
            record: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(plain))
        return record


def _read(path: Path) -> tuple[Profile, Channel]:
    """Return a profile and its channel, read again once a file of theirs is modified."""
    profile = _profile(path)
    table = _table(path, profile)
    return profile, _channel(path, state_of(path), state_of(table) if table else ())


def _table(path: Path, profile: Profile) -> Path | None:
    """Return the path of the table that a profile's file names; None if it names none."""
    table = profile.parameters.get("file")
    return path.parent / table if isinstance(table, str) else None


@read_once
def _profile(path: Path) -> Profile:
    where = f"channel file {printable(path)}"
    return convert(toml(path, where), Profile, where)


@lru_cache(maxsize=64)
def _channel(path: Path, state: tuple[int, ...], of_table: tuple[int, ...]) -> Channel:
    where, profile = f"channel file {printable(path)}", _profile(path)
    model = _model(profile.model, where)
    parameters = f"{where} [parameters]"
    if isinstance(model, type):
        channel: Channel = convert(profile.parameters, model, parameters)
    else:
        channel = model(profile.parameters, path.parent, parameters)
    for name, (least, most) in profile.limits.items():
        if name not in settable(channel):
            raise unknown(f"key in {where} [limits]", name, settable(channel))
        if least > most:
            raise UserError(
                f"{where} [limits]: {name} = [{least:g}, {most:g}]; allowed: the least value, then "
                "the largest"
            )
    return channel


def _model(name: str, where: str) -> Any:
    """Return the model that a file names.
    Raises UserError if it is unknown, or its extension is gone.
    """
    if name in MODELS:
        return MODELS[name]
    if owner := owner_of_plugin("channel_models", name):
        raise UserError(f"{where}: model {printable(name)} is {part_of(owner)}")
    raise unknown(f"model in {where}", name, MODELS)


CHANNELS = Profiles("swarmdrive.channels", Channel, {})

# A vehicle without a radio: comparisons with a NaN loss are false, so nothing is ever received.
NO_CHANNEL = Radio(
    latency_s=0.0, loss=np.nan, bandwidth_bps=np.inf, access="parallel", jitter_s=0.0
)
