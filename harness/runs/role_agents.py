"""Which agents answer for the vehicles of a role, where it is not the ego's.

An agent is a model, its prompt, and how it is asked. An extension that ships adds one by
`adds={"agents": {ROLE: "module:AGENTS"}}`; the role that there is beside the ego's is `helper`.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from harness.core.errors import UserError
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.plugins import Shipped

HELPER = "helper"


class RoleAgents(ABC):
    """Says by which settings of its extension a role has agents of its own, and which; frozen."""

    chosen_by: ClassVar[tuple[str, ...]]  # these settings

    @abstractmethod
    def opened(self, settings: Any, ego: Any) -> tuple[Any, ...]:
        """Return the role's agents by a run's `Settings`; none if the ego's `Agent` answers.

        Vehicles of the role take them in turn. Raises UserError for those that cannot be.
        """

    @abstractmethod
    def settings(self, ego: Any, agents: Sequence[Any]) -> dict[str, Any]:
        """Return the settings of `chosen_by` that open these agents beside the ego's, by name."""

    @abstractmethod
    def recorded(self, agents: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Return the settings that a run's records of agents state, values by name.

        It may raise KeyError, TypeError, AttributeError or IndexError for what is no record.
        """

    @abstractmethod
    def check(self, run: Any) -> None:
        """Raise UserError if a run, a `Spec`, has agents that cannot answer for the role."""

    @abstractmethod
    def unlike(self, run: Any) -> str | None:
        """Return why the messages of a run's agents are none that its ego's prompt can show.

        None if it can show them.
        """


AGENTS = Shipped[RoleAgents]("swarmdrive.agents", RoleAgents, {})


def of_helpers() -> RoleAgents:
    """Return who says which agents answer for the helpers. Raises UserError if it is gone."""
    if HELPER in AGENTS:
        return AGENTS[HELPER]
    owner = owner_of_plugin("agents", HELPER) or HELPER
    raise UserError(f"helpers that the ego's agent does not answer for are {part_of(owner)}")


def opened(settings: Any, ego: Any) -> tuple[Any, ...]:
    """Return the helpers' agents by a run's `Settings`; none if the ego's `Agent` answers.

    Raises UserError for those that cannot be.
    """
    return AGENTS[HELPER].opened(settings, ego) if HELPER in AGENTS else ()


def settings() -> tuple[str, ...]:
    """Return the settings of extensions by which helpers have agents of their own, by name."""
    return AGENTS[HELPER].chosen_by if HELPER in AGENTS else ()


def recorded(helpers: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the settings of extensions that a run's records of helpers' agents state, by name.

    There are none without records. Raises UserError if the extension is gone, and what
    `RoleAgents.recorded` does.
    """
    return of_helpers().recorded(helpers) if helpers else {}
