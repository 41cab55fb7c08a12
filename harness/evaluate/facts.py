"""State what settings may ask of where they are used, where that is no run."""

from dataclasses import dataclass

from harness.evaluate.agent import Agent
from harness.world.scenario import Scenario


@dataclass(frozen=True)
class Facts:
    """Hold of a use of settings what a run would state (`RunFacts`): one ego, which asks freely.

    An agent is a model with its prompt and answer mode. Ties and temperature are None, which no run
    states here.
    """

    agents: tuple[Agent, ...]  # the ego's
    scenario: Scenario  # where it answers
    ego_alone: bool = False
    several_decide: bool = False
    frozen: bool = False
    ties: str | None = None
    temperature: float | None = None
