"""What may stop a run before its last layout, after interim looks at what it has so far.

An extension that ships adds a rule by `adds={"stopping_rules": {LOOKS: "module:RULE"}}`.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

from harness.core.errors import UserError
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.plugins import ShippedChoices
from harness.runs.formats import LOOKS

if TYPE_CHECKING:
    from harness.core.arrays import Floats
    from harness.core.statistics import Estimate
    from harness.runs.grid import Grid
    from harness.runs.records import Episode, Score
    from harness.runs.success import Success


@dataclass(frozen=True)
class InterimLooks:
    """Hold after how many of its layouts a run was looked at, and whether it stopped by that.

    A layout is one start situation of a scenario, with one episode; a look tests whether those
    evaluated so far are enough. `layouts` is how many there were to evaluate, `at` after how many
    it was looked at, ascending, and `is_enough` whether the last look said so.
    """

    layouts: int  # number of layouts that there were to evaluate
    # numbers of layouts after which it was looked at, ascending; empty while the run goes on
    at: tuple[int, ...] = ()
    is_enough: bool = False  # whether the last look was enough


class StoppingRule(ABC):
    """Say when a run has enough layouts, so that it may stop; a base class.

    A layout is one start situation of a scenario, with one episode; layouts come in a fixed order.
    At an interim look, after some of them, the rule says whether these are enough. `chosen_by`
    names the settings that choose it, and `interval` says in words what the intervals of its
    differences are. Objects do not change. The one that is registered has opened no files: it makes
    those that have (`opened`), and reads what runs state.
    """

    chosen_by: ClassVar[tuple[str, ...]]  # the settings of its extension that choose it
    interval: ClassVar[str]  # what the intervals of `difference` are, for people

    @property
    def options(self) -> str:
        """Return what a user types to choose this rule, for messages."""
        return " and ".join(f"--{name.replace('_', '-')}" for name in self.settings())

    @abstractmethod
    def opened(self, settings: Mapping[str, Any]) -> "StoppingRule | None":
        """Return this rule as a run's settings choose it; None if they choose none.

        `settings` has those of extensions, values by name, such as the level of confidence. Raises
        UserError for a value that is not allowed.
        """

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Return the settings that choose this rule, values by name, as a run states them."""

    @abstractmethod
    def check(self, run: Any) -> None:
        """Raise UserError if this rule cannot stop a run.

        `run` is a `harness.evaluate.spec.Spec`: a run that is about to begin, its settings opened.
        """

    @abstractmethod
    def planned_looks(self, layouts: int) -> Sequence[int]:
        """Return after how many of a run's layouts this rule tests whether these are enough.

        The numbers ascend; the last is `layouts`, all of them. A layout is one start situation,
        with one episode.
        """

    @abstractmethod
    def enough(self, grid: "Grid", episodes: "Sequence[Episode]") -> bool:
        """Return whether a run may stop, by its episodes so far.

        `grid` has the conditions, seeds and layouts so far; `episodes` are in its order: by
        condition, seed and layout. A condition is a named set of settings of the radio, of asking
        helpers and of fusing their messages. A layout is one start situation of a scenario.
        """

    @abstractmethod
    def record(self, looks: InterimLooks) -> dict[str, Any]:
        """Return what a run's manifest states of this rule and of when it tested, values by name.

        At a look, after some of the run's layouts (start situations), the rule tests whether these
        are enough.
        """

    @abstractmethod
    def looks(self, record: Mapping[str, Any]) -> InterimLooks:
        """Return when a run that has ended was tested for being enough, as its manifest states it.

        At a look, after some of its layouts (start situations), the rule said whether these were
        enough. `record` is what the manifest states. Raises ValueError if it states no looks that
        can be.
        """

    @abstractmethod
    def contradictions(
        self, record: Mapping[str, Any], grid: "Grid", episodes: "Sequence[Episode]"
    ) -> Iterator[str]:
        """Yield a sentence for each statement of a run's last look that its episodes contradict.

        At a look, after some of its layouts (start situations), a rule says whether these are
        enough. `record` is what the run's manifest states of looks; `episodes` are all of the run,
        in the order of the grid: by condition, seed and layout.
        """

    def unchecked(self, record: Mapping[str, Any]) -> str | None:
        """Return a sentence on what nobody can check of the looks that a run states, or None.

        At a look, after some of a run's layouts (start situations), a rule says whether these are
        enough. `record` is what the run's manifest states.
        """
        return None

    @abstractmethod
    def sentence(self, record: Mapping[str, Any]) -> str:
        """Return a sentence for a report on when a run was tested for being enough.

        It also says which of the run's intervals hold in spite of that. The rule tests after some
        of the layouts (start situations) whether these are enough; `record` is what the run's
        manifest states of it.
        """

    @abstractmethod
    def scores(self, grid: "Grid", episodes: "Sequence[Episode]") -> "Iterator[Score]":
        """Yield the further scores of a run that may stop, by intervals that hold at every look.

        `grid` has the run's conditions, seeds and layouts; `episodes` are in its order: by
        condition, seed and layout. A condition is a named set of settings of the radio, of asking
        helpers and of fusing their messages. A layout is one start situation of a scenario. At a
        look, after some of its layouts, a rule says whether these are enough.
        """

    @abstractmethod
    def difference(self, success: "Success", a: "Floats", b: "Floats") -> "Estimate":
        """Return the difference in success a - b, with an interval that holds at every look.

        `a` and `b` are the success of the same episodes, 0 or 1, (S, E), by S seeds of the
        channel's random draws and E episodes, and are paired by episode. `success` says how
        episodes are averaged. At a look, after some of its layouts, a rule says whether these are
        enough.
        """


def looked_otherwise(
    rule: StoppingRule, looks: InterimLooks, grid: "Grid", episodes: "Sequence[Episode]"
) -> Iterator[str]:
    """Yield a sentence for each way in which a run was looked at otherwise than its rule says.

    At a look, after some of its layouts (start situations), a stopping `rule` says whether these
    are enough. `looks` are what the run states: after how many layouts it was looked at, and
    whether it stopped. `episodes` are all of the run, in the order of the grid: by condition, seed
    and layout.
    """
    planned = tuple(rule.planned_looks(looks.layouts)[: len(looks.at)])
    if looks.at != planned:
        yield f"run.json has looks after {list(looks.at)} layouts, and its rule after {planned}"
        return
    for count in looks.at:
        part = replace(grid, episodes=grid.episodes[:count])
        numbers = frozenset(part.episodes)
        seen = [episode for episode in episodes if episode.episode in numbers]
        is_last = count == looks.at[-1]
        was_enough = is_last and looks.is_enough
        if rule.enough(part, part.ordered(seen)) != was_enough:
            is_enough = "not " * was_enough + "enough"
            yield f"by its episodes {count} layouts were {is_enough}, and run.json says otherwise"
            return


STOPPING_RULES = ShippedChoices[StoppingRule]("swarmdrive.stopping_rules", StoppingRule, {})


def rule_of(record: Any) -> StoppingRule | None:
    """Return the stopping rule by which a run was looked at; None for a run without looks.

    At a look, after some of its layouts (start situations), a rule says whether these are enough.
    `record` is what the run's manifest states of them. Raises UserError if the rule's extension is
    not installed.
    """
    if record is None:
        return None
    if LOOKS in STOPPING_RULES:
        return STOPPING_RULES[LOOKS]
    owner = owner_of_plugin("stopping_rules", LOOKS) or LOOKS
    raise UserError(f"what may stop a run, {LOOKS} in its run.json, is {part_of(owner)}")
