"""The content `plan`: messages hold what their senders are themselves going to do."""

from typing import TYPE_CHECKING

from harness.coordination.contents import PLANS, Content
from harness.coordination.intents import Intents
from harness.core.arrays import Ints
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint
    from harness.coordination.parts import RunFacts

NO_AGENTS = (
    "content plan needs several agents, and here one ego decides; give --agents all with `harness "
    "drive`, or content=intent"
)


class OfPlan(Content):
    """Describe a message that holds what its sender will do: the content `plan`.

    It is the probabilities of actions by which an agent, a vehicle that decides for itself, acts. A
    condition (settings of radio, asking and fusion) has it by its setting `content`; it needs a run
    in which several vehicles decide.
    """

    holds = frozenset((PLANS,))
    needs = (PLANS,)

    def obstacle(self, point: "OperatingPoint", run: "RunFacts") -> str | None:
        if not run.several_decide:
            return NO_AGENTS
        return self._unread(run) if point.has_fusion_call else None

    def _unread(self, run: "RunFacts") -> str | None:
        """Return why an agent cannot be asked again with the plans of others; None if all can."""
        for agent in run.agents:
            if not agent.can.language_model:
                name = printable(agent.card.name)
                return (
                    f"{name} is no language model and cannot read plans; use "
                    "consensus=yield-by-time"
                )
            if not agent.prompt.shows_plans:
                return f"prompt {agent.prompt.version} cannot show plans; use --prompt v13"
        return None

    def able(self, point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
        if intents.plans is None or senders is None:
            raise UserError(f"condition {printable(point.name)}: {NO_AGENTS}")
        return intents.planned(senders)


PLAN = OfPlan()
