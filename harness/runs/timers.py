"""What times each answer of a run by itself, in place of `--latency`.

An extension that ships adds one by `adds={"timers": {NAME: "module:TIMER"}}`; NAME is the source of
the latency of the runs that it times.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.plugins import Plugins

if TYPE_CHECKING:
    from harness.coordination.exchange import Exchange
    from harness.coordination.operating_point import OperatingPoint
    from harness.runs.records import Answer, Latency, Manifest


class Timer(ABC):
    """Times each answer of a run, and says what its decisions cost; frozen.

    The one that is registered has nothing open: it opens others, and knows speeds.
    """

    option: ClassVar[str]  # what is typed to choose it
    chosen_by: ClassVar[tuple[str, ...]]  # the settings of its extension that choose it
    how: ClassVar[str]  # where its times come from, for people
    # the columns that it adds to a decision, each with the one behind which it stands: numbers,
    # null where unknown, in a file only where some are known
    adds: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def opened(self, settings: Mapping[str, Any]) -> "Timer | None":
        """Return the one that a run's settings of extensions choose; None if they choose none."""

    @abstractmethod
    def recorded(self, manifest: "Manifest") -> "Timer | None":
        """Return the one that a run states; None if it has another's answers, and their times.

        Raises ValueError if it states none that can be read.
        """

    @abstractmethod
    def speed(self, stated_speed: Any) -> Any:
        """Return how fast an agent answers, as a run states it. Raises ValueError for no speed."""

    @abstractmethod
    def speeds(self, models: Sequence[str]) -> tuple[Any, ...]:
        """Return how fast the models of a run's agents answer, by name, the ego's first.

        Raises UserError for a model that it cannot time.
        """

    @abstractmethod
    def changed(self) -> str | None:
        """Return what of it, as a run states it, is otherwise here; None if nothing is."""

    @abstractmethod
    def answer_s(self, speed: Any, answer: "Answer") -> float:
        """Return the seconds of one answer, a repair turn included; NaN if the engine failed.

        Raises UserError if the answer does not say enough.
        """

    @abstractmethod
    def check(self, run: Any) -> None:
        """Raise UserError for what of a run, a `Spec`, it does not go with."""

    @abstractmethod
    def obstacle(self, point: "OperatingPoint") -> str | None:
        """Return why a condition cannot be played with it, and what to do; None if it can."""

    @abstractmethod
    def latency(self, agents: Sequence[Any]) -> "Latency":
        """Return the latency of a run with these agents, the ego's first."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Return those of `chosen_by` that choose it, by name."""

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return what a run states of it beside its settings: by setting, what that opened, as
        plain values, or its value.
        """

    @abstractmethod
    def files(self) -> Mapping[str, Path]:
        """Return the files that it is made of by their path in a project."""

    @abstractmethod
    def columns(
        self, latency: "Latency", decided: Sequence[Any], answers: Mapping[str, "Answer"]
    ) -> dict[str, Floats]:
        """Return what it `adds` to decisions (`Decided`) in their order, (n,) each."""

    @abstractmethod
    def joules(
        self,
        latency: "Latency",
        point: "OperatingPoint",
        scenes: Sequence[Any],
        answers: Mapping[str, "Answer"],
    ) -> Floats:
        """Return the joules of each vehicle's answer, (n, 1+H), the ego first; NaN if unknown."""

    @abstractmethod
    def energy_j(self, point: "OperatingPoint", heard: "Exchange", joules: Floats) -> Floats:
        """Return the joules of decisions, (n,), without those of a fusion call, by these answers'
        (n, 1+H).
        """


TIMERS = Plugins[Timer]("swarmdrive.timers", Timer, {})


def timer(source: str) -> Timer:
    """Return what times answers, by the source of a latency.

    Raises ValueError if there is none of this name, and UserError if its extension is gone.
    """
    if TIMERS.is_ours(source):
        return TIMERS[source]
    if owner := owner_of_plugin("timers", source):
        raise UserError(f"what timed the answers of a run, {source}, is {part_of(owner)}")
    raise ValueError(f"nothing of the name {printable(source)} times answers")


def chosen(settings: Mapping[str, Any]) -> Timer | None:
    """Return what a run's settings of extensions choose to time answers; None for `--latency`."""
    for each in _timers():
        if opened := each.opened(settings):
            return opened
    return None


def options() -> list[str]:
    """Return what is typed to choose each timer."""
    return [each.option for each in _timers()]


def without(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of extensions without those that choose a timer."""
    choosing = {name for each in _timers() for name in each.chosen_by}
    return {name: value for name, value in settings.items() if name not in choosing}


def added_columns() -> dict[str, str]:
    """Return the columns that timers add to decisions, each with the one behind which it stands."""
    columns: dict[str, str] = {}
    for each in _timers():
        columns |= each.adds
    return columns


def _timers() -> list[Timer]:
    return [TIMERS[name] for name in TIMERS if TIMERS.is_ours(name)]
