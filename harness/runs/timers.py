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
from harness.core.plugins import Shipped

if TYPE_CHECKING:
    from harness.coordination.exchange import Exchange
    from harness.coordination.operating_point import OperatingPoint
    from harness.runs.records import Answer, Latency, Manifest


class Timer(ABC):
    """Times each answer of a run, and says what its decisions cost; frozen.

    The object that is registered has opened no files: it makes those that have (`opened`,
    `recorded`), and reads speeds.
    """

    option: ClassVar[str]  # what is typed to choose it
    chosen_by: ClassVar[tuple[str, ...]]  # the settings of its extension that choose it
    how: ClassVar[str]  # where its times come from, for people
    # the columns that it adds to a decision, each with the one behind which it stands: numbers,
    # null where unknown, in a file only where some are known
    adds: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def opened(self, settings: Mapping[str, Any]) -> "Timer | None":
        """Return the timer that a run's settings of extensions, by name, choose; None for none."""

    @abstractmethod
    def recorded(self, manifest: "Manifest") -> "Timer | None":
        """Return the timer that a run's manifest states; None if it took over another run's times.

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
        """Raise UserError if a run, a `Spec`, has other settings that do not go with this timer."""

    @abstractmethod
    def obstacle(self, point: "OperatingPoint") -> str | None:
        """Return why a condition cannot be played with this timer; None if it can."""

    @abstractmethod
    def latency(self, agents: Sequence[Any]) -> "Latency":
        """Return the latency of a run with these agents, the ego's first."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Return the settings of `chosen_by` that choose this timer, values by name."""

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return what a run states of this timer beside its settings, as plain values.

        It has by setting the content of what the setting opened, or else its value.
        """

    @abstractmethod
    def files(self) -> Mapping[str, Path]:
        """Return the files that this timer is made of, by their path in a project."""

    @abstractmethod
    def columns(
        self, latency: "Latency", decided: Sequence[Any], answers: Mapping[str, "Answer"]
    ) -> dict[str, Floats]:
        """Return the columns that this timer `adds` to n decisions, in their order, (n,) each.

        `decided` has the decisions in parts, `answers` the answers by request id, and `latency` is
        the run's.
        """

    @abstractmethod
    def joules(
        self,
        latency: "Latency",
        point: "OperatingPoint",
        scenes: Sequence[Any],
        answers: Mapping[str, "Answer"],
    ) -> Floats:
        """Return the joules of each vehicle's answer in n scenes, (n, 1+H), NaN if unknown.

        The ego comes first, then the H helpers. `answers` has the run's by request id.
        """

    @abstractmethod
    def energy_j(self, point: "OperatingPoint", heard: "Exchange", joules: Floats) -> Floats:
        """Return the joules of n decisions, (n,), without those of a fusion call.

        `joules` are those of the answers, (n, 1+H), the ego's and H helpers'; `heard` is what was
        sent.
        """


TIMERS = Shipped[Timer]("swarmdrive.timers", Timer, {})


def timer(source: str) -> Timer:
    """Return what times answers, by the source of a latency.

    Raises ValueError if there is none of this name, and UserError if its extension is gone.
    """
    if source in TIMERS:
        return TIMERS[source]
    if owner := owner_of_plugin("timers", source):
        raise UserError(f"what timed the answers of a run, {source}, is {part_of(owner)}")
    raise ValueError(f"nothing of the name {printable(source)} times answers")


def chosen(settings: Mapping[str, Any]) -> Timer | None:
    """Return what a run's settings of extensions choose to time answers; None for `--latency`."""
    for each in TIMERS.values():
        if opened := each.opened(settings):
            return opened
    return None


def options() -> list[str]:
    """Return what is typed to choose each timer."""
    return [each.option for each in TIMERS.values()]


def without(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of extensions without those that choose a timer."""
    choosing = {name for each in TIMERS.values() for name in each.chosen_by}
    return {name: value for name, value in settings.items() if name not in choosing}


def added_columns() -> dict[str, str]:
    """Return the columns that timers add to decisions, each with the one that it follows."""
    columns: dict[str, str] = {}
    for each in TIMERS.values():
        columns |= each.adds
    return columns
