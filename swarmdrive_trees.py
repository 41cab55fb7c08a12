"""Decisions in driving with exact rewards, as a taskset of verifiers: `eval swarmdrive-trees`.

A module of its own beside the package, since verifiers finds a taskset by the name of a module. A
task is one decision: the chat of a viewer, and the worth of every action, which the model never
sees.
"""

from collections.abc import Iterator
from typing import Any

import verifiers.v1 as vf

import harness
from harness.extensions.learn.rewards.asking import READ_BY, earned, intent

__all__ = ["SwarmdriveTrees"]


class DecisionsConfig(vf.TasksetConfig):  # type: ignore[misc] # verifiers counts as untyped
    """Which decisions; the fields are arguments of `harness.environment`,
    and `per_level` of `rows`.
    """

    scenario: str | None = None
    seeds: str | int = "train"
    layouts: int = 32
    dataset: str | None = None
    then: str | None = None
    prompt: str | None = None
    answer: str = "json"
    viewer: str | None = None
    workers: int = 1
    per_level: int = 6


class DecisionData(vf.TaskData):  # type: ignore[misc]
    """A decision: a row of `rows` without its chat, which is the task's prompt."""

    scenario: str
    scene: str
    viewer: str
    layout_seed: int
    purpose: str
    danger: bool
    values: list[float]
    optimal: list[bool]
    constant: int
    answer: str
    role: str
    actions: list[str]
    form: str | None
    extension: str
    reasons_first: bool

    def read_by(self) -> dict[str, Any]:
        """Return how its answer is read."""
        return {name: getattr(self, name) for name in READ_BY}


class DecisionTask(vf.Task[DecisionData, vf.State, vf.TaskConfig]):  # type: ignore[misc]
    """Rewards the worth of the action that an answer drives,
    less that of one that is always taken.
    """

    @vf.reward  # type: ignore[untyped-decorator]
    async def advantage(self, trace: vf.Trace) -> float:
        data = self.data
        return earned(trace.last_reply, data.values, data.constant, **data.read_by())

    @vf.metric  # type: ignore[untyped-decorator]
    async def readable(self, trace: vf.Trace) -> float:
        return float(intent(trace.last_reply, **self.data.read_by()) is not None)


class SwarmdriveTrees(vf.Taskset[DecisionTask, DecisionsConfig]):  # type: ignore[misc]
    """The decisions of layouts that may be learnt from."""

    def load(self) -> Iterator[DecisionTask]:
        options = self.config.model_dump(
            include=DecisionsConfig.__annotations__.keys() - {"per_level"}
        )
        for n, row in enumerate(harness.environment(**options).rows(self.config.per_level)):
            system, *asked = row.pop("prompt")
            # Of a level that has few decisions some are there several times.
            data = DecisionData(
                id=f"{row['scene']}-{n}", prompt=asked, system_prompt=system["content"], **row
            )
            yield DecisionTask(data, self.config.task)
