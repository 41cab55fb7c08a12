"""`harness.environment`: an environment with exact rewards, from Python."""

from os import PathLike
from typing import TYPE_CHECKING, Literal

from harness.core.errors import UserError

if TYPE_CHECKING:
    from harness.extensions.learn.rewards.environment import Driving


def environment(
    scenario: str | None = None,
    *,
    seeds: str | int = "train",
    layouts: int = 32,
    dataset: str | PathLike[str] | None = None,
    driven: bool = False,
    then: str | None = None,
    observation: Literal["text", "arrays"] = "text",
    prompt: str | None = None,
    answer: str = "json",
    viewer: str | None = None,
    reward: Literal["regret", "success"] = "regret",
    distributions: bool = False,
    workers: int = 1,
    quiet: bool = False,
) -> "Driving":
    """Make a Gymnasium environment to learn to drive in: docs/learning-environment.md.

    Rewards are exact, since it is known how every course of an episode ends.

    Args:
        scenario: name of the scenario, such as `occluded-intersection`. Default: the usual one.
        seeds: `train` or `tune`, or the first layout seed, each of which draws a start situation;
            report seeds, on which results are measured, are refused.
        layouts: how many; their decision trees, all courses that actions can lead to, are built
            once, in seconds each, and kept in the cache folder.
        dataset: folder of a dataset of train or tune seeds, whose trees are taken instead.
        driven: whether episodes are driven in the simulator; then no tree is built.
        then: who decides after an action that is judged: a reference driver (a rule), and on trees
            also `best` (the default there) or `uniform`. Without one, driven episodes have no
            values.
        observation: `text`, a chat as a prompt version writes it, or `arrays`.
        prompt: prompt version. Default: the scenario's.
        answer: what the chat asks for: `json`, or a letter, `readout`.
        viewer: who is asked: a vehicle's id, or `any`. Default: the ego.
        reward: of a step. `regret`: by how much the decision is worth less than the best there,
            which is 0 or less. `success`: 1 at the end of an episode that succeeds.
        distributions: whether the action space has distributions; `step` takes both.
        workers: processes that build trees.
        quiet: whether progress is left out.

    Raises:
        UserError: a value is unknown or not allowed, or layouts are those that numbers are reported
            of.
    """
    from harness.core import extras
    from harness.core.parallel import workers_of

    extras.need("an environment", "highway_env")
    from harness.cli.progress import bar
    from harness.dataset import rebuilt
    from harness.evaluate.chats import Asking
    from harness.extensions.learn.rewards import layouts as allowed
    from harness.extensions.learn.rewards.environment import Driving
    from harness.extensions.learn.rewards.trips import Roads, Trees
    from harness.extensions.learn.rewards.values import BEST
    from harness.world import scenarios

    source: Roads | Trees
    if dataset is not None:
        if scenario or driven:
            raise UserError(
                "dataset: it has a scenario and trees of its own; leave out scenario and driven"
            )
        source = Trees(allowed.stored(str(dataset)), then or BEST)
    else:
        played = scenarios.get(scenario or scenarios.DEFAULT)
        of = allowed.seeds(seeds, layouts)
        rebuilt.refuse_drawn(played, of)
        if driven:
            source = Roads(played, of, then)
        else:
            with bar(f"freezing {played.name}", layouts, quiet) as progress:
                source = Trees(
                    allowed.trees(played, of, workers_of(str(workers)), progress), then or BEST
                )
    ask = Asking.of(source.scenario, prompt, answer)
    return Driving(
        source,
        ask,
        observation=observation,
        viewer=viewer,
        reward=reward,
        distributions=distributions,
    )
