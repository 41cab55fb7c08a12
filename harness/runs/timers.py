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
from harness.core.plugins import ShippedChoices

if TYPE_CHECKING:
    from harness.coordination.exchange import Exchange
    from harness.coordination.operating_point import OperatingPoint
    from harness.runs.records import Answer, Latency, Manifest


class Timer(ABC):
    """Time each answer of a run by itself, as from a device's tokens a second; a base class.

    Without a timer all answers of a role take one time, which `--latency` states. A timer also says
    how many joules decisions take. `option` is what is typed to choose it, `chosen_by` names the
    settings that do, and `how` says in words where times come from. `adds` has the columns that it
    adds to the table of decisions, each with the one behind which it stands. Objects do not change.
    The one that is registered has opened no files: it makes those that have (`opened`, `recorded`),
    and reads speeds. A speed is how fast an agent, a model with its prompt, answers: an object of
    the timer's own.
    """

    option: ClassVar[str]  # what is typed to choose it, such as the name of an option
    chosen_by: ClassVar[tuple[str, ...]]  # names of the settings of its extension that choose it
    how: ClassVar[str]  # where its times come from, for people
    # the columns that it adds to a decision, each with the one behind which it stands: numbers,
    # null where unknown, in a file only where some are known
    adds: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def opened(self, settings: Mapping[str, Any]) -> "Timer | None":
        """Return the timer that a run's settings choose; None for none.

        `settings` are those of extensions, values by name. Raises UserError for a value that is not
        allowed.
        """

    @abstractmethod
    def recorded(self, manifest: "Manifest") -> "Timer | None":
        """Return the timer that a run's manifest states; None if it took over another run's times.

        It has the files' content as the run states it. Raises ValueError if the manifest states
        none that can be read.
        """

    @abstractmethod
    def speed(self, stated_speed: Any) -> Any:
        """Return how fast a model answers, from the plain values that a run's record states of it.

        They are `stated_speed`; the result is an object of the timer's own. Raises ValueError if
        they are no speed.
        """

    @abstractmethod
    def speeds(self, models: Sequence[str]) -> tuple[Any, ...]:
        """Return how fast each of a run's models answers, given the models' names, the ego's first.

        An entry is an object of the timer's own, such as a device's token rates, which `answer_s`
        takes. Raises UserError for a model that it cannot time.
        """

    @abstractmethod
    def changed(self) -> str | None:
        """Return a phrase on what differs here from what a run stated of its timer, or None.

        Such is a file of rates that has changed since.
        """

    @abstractmethod
    def answer_s(self, speed: Any, answer: "Answer") -> float:
        """Return the seconds that an answer takes, given how fast its model answers.

        `speed` is that, an object of the timer's own. A repair turn, a second question after a
        failed answer, is included. NaN if the engine, which runs the model, failed. Raises
        UserError if the answer does not say enough, such as its number of tokens.
        """

    @abstractmethod
    def check(self, run: Any) -> None:
        """Raise UserError if a run has settings that do not go with this timer.

        `run` is a `harness.evaluate.spec.Spec`: a run that is about to begin, its settings opened.
        """

    @abstractmethod
    def obstacle(self, point: "OperatingPoint") -> str | None:
        """Return why a condition cannot be played with this timer, as a phrase; None if it can.

        `point` is the condition: its settings of the radio, of asking helpers and of fusing their
        messages.
        """

    @abstractmethod
    def latency(self, agents: Sequence[Any]) -> "Latency":
        """Return the record of a run's latency: that this timer times it, and each agent's speed.

        `agents` are those of the run, each a `harness.evaluate.agent.Agent`: a model, its prompt
        and how it answers. The ego's is first.
        """

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Return the settings of a run that choose this timer, values by name.

        They are those that `chosen_by` names.
        """

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return what a run's record states of this timer: what its settings name, by setting.

        A value is the content of the file that the setting names, or else the setting's own value.
        """

    @abstractmethod
    def files(self) -> Mapping[str, Path]:
        """Return the files that state the times, such as a device's, by their path in a project."""

    @abstractmethod
    def columns(
        self, latency: "Latency", decided: Sequence[Any], answers: Mapping[str, "Answer"]
    ) -> dict[str, Floats]:
        """Return the columns that this timer adds to n decisions, by name, (n,) each.

        An agent is a model, its prompt and how it answers. A condition is a named set of settings
        of the radio, of asking helpers and of fusing their messages.

        Args:
            latency: the run's record of times, with each agent's speed.
            decided: the decisions, in order, in parts of one condition each
                (`harness.evaluate.walk.Decided`).
            answers: the run's answers by id of their request.
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

        The ego comes first, then the H helpers. `latency` is the run's and `point` the condition,
        its settings of the radio, of asking helpers and of fusing their messages; `scenes` are
        `harness.dataset.load.Scene`, and `answers` has the run's answers by id of their request.
        """

    @abstractmethod
    def energy_j(self, point: "OperatingPoint", heard: "Exchange", joules: Floats) -> Floats:
        """Return the joules of n decisions, (n,): of the answers that were made, and of the radio.

        Those of a fusion call, a second question to the ego's model, are left out. `point` is the
        condition, its settings of the radio, of asking helpers and of fusing their messages;
        `joules` are of each vehicle's answer, (n, 1+H), the ego's first, then those of H helpers;
        `heard` says which helpers answered, and what was sent.
        """


TIMERS = ShippedChoices[Timer]("swarmdrive.timers", Timer, {})


def timer(source: str) -> Timer:
    """Return what times answers under a name: the `source` that a run's latency states.

    Raises ValueError if there is none of this name, and UserError if the extension that added it is
    not installed.
    """
    if source in TIMERS:
        return TIMERS[source]
    if owner := owner_of_plugin("timers", source):
        raise UserError(f"what timed the answers of a run, {source}, is {part_of(owner)}")
    raise ValueError(f"nothing of the name {printable(source)} times answers")


def options() -> list[str]:
    """Return what is typed on the command line to choose each timer, such as an option's name.

    A timer computes how long each answer takes by itself.
    """
    return [each.option for each in TIMERS.values()]


def added_columns() -> dict[str, str]:
    """Return the columns that timers add to the table of decisions, each with the one it follows.

    A timer computes how long each answer takes by itself.
    """
    columns: dict[str, str] = {}
    for each in TIMERS.values():
        columns |= each.adds
    return columns
