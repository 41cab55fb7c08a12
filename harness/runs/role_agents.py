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
    """Say which models answer for the vehicles of a role in place of the ego's; a base class.

    With its prompt and its way of answering such a model is an agent
    (`harness.evaluate.agent.Agent`); a role is what a vehicle is asked as, such as `helper`.
    `chosen_by` names the settings that choose them. Objects do not change.
    """

    chosen_by: ClassVar[tuple[str, ...]]  # names of the settings of its extension that choose them

    @abstractmethod
    def opened(self, settings: Any, ego: Any) -> tuple[Any, ...]:
        """Return the models that answer for the role, which its vehicles take in turn.

        Each is an `Agent`, with its prompt and its way of answering. There are none if the ego's
        answers for all. `settings` are the run's, a `harness.runs.settings.Settings`, and `ego` is
        the ego's `Agent`. Raises UserError for agents that do not exist, or do not go together.
        """

    @abstractmethod
    def settings(self, ego: Any, agents: Sequence[Any]) -> dict[str, Any]:
        """Return the settings that open these models again, values by name, for a run's record.

        They are those in `chosen_by`. `ego` is the ego's `Agent`, and `agents` are the role's. An
        agent is a model, its prompt and how it answers.
        """

    @abstractmethod
    def recorded(self, agents: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Return the settings, values by name, that open the agents which a run states.

        `agents` are the run's records of them, as in `Manifest.helpers`. It may raise KeyError,
        TypeError, AttributeError or IndexError for what is no record. An agent is a model, its
        prompt and how it answers.
        """

    @abstractmethod
    def check(self, run: Any) -> None:
        """Raise UserError if the models that a run has for this role cannot answer for it.

        `run` is a `harness.evaluate.spec.Spec`: a run that is about to begin, its settings opened.
        """

    @abstractmethod
    def unlike(self, run: Any) -> str | None:
        """Return why the ego's prompt cannot show messages of helpers' models, or None if it can.

        `run` is a `harness.evaluate.spec.Spec`: a run that is about to begin, its settings opened.
        The models of its helpers, with prompt and way of answering, may give answers of another
        form than the prompt takes.
        """


AGENTS = Shipped[RoleAgents]("swarmdrive.agents", RoleAgents, {})


def of_helpers() -> RoleAgents:
    """Return what says which models answer for helpers in place of the ego's.

    It is an object of the extension that adds such models, each with its prompt and its way of
    answering. Raises UserError if no installed extension adds one.
    """
    if HELPER in AGENTS:
        return AGENTS[HELPER]
    owner = owner_of_plugin("agents", HELPER) or HELPER
    raise UserError(f"helpers that the ego's agent does not answer for are {part_of(owner)}")


def opened(settings: Any, ego: Any) -> tuple[Any, ...]:
    """Return the helpers' agents, which helpers take in turn; none if the ego's answers for all.

    An agent is a `harness.evaluate.agent.Agent`: a model, its prompt and how it answers. `settings`
    are the run's, a `harness.runs.settings.Settings`, and `ego` is the ego's agent. Raises
    UserError for agents that do not exist, or do not go together.
    """
    return AGENTS[HELPER].opened(settings, ego) if HELPER in AGENTS else ()


def settings() -> tuple[str, ...]:
    """Return the names of the settings that give helpers models of their own.

    Extensions add them; without any, the ego's model answers for helpers.
    """
    return AGENTS[HELPER].chosen_by if HELPER in AGENTS else ()


def recorded(helpers: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the settings of extensions, values by name, that open a run's agents of helpers.

    `helpers` are the run's records of these agents (`Manifest.helpers`); there are no settings
    without any. An agent is a model, its prompt and how it answers. Raises UserError if the
    extension is gone, and may raise KeyError, TypeError, AttributeError or IndexError for what is
    no record.
    """
    return of_helpers().recorded(helpers) if helpers else {}
