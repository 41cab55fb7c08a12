"""Render every prompt that scenes can give, and count its tokens against the version's budget."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from harness.dataset.load import Dataset, Scene
from harness.prompts.densest import densest_messages, densest_plans, densest_repair
from harness.prompts.versions import ROLES, Prompt

FUSION = "fusion"  # the ego's call with messages
REPAIR = "repair"  # any call with the turn that follows an answer that cannot be read


class Outside(NamedTuple):
    """Describe a rendered prompt that has more or fewer tokens than its prompt version allows.

    `scene` is the scene's id and `viewer` that of the vehicle that is asked. `messages` counts the
    helpers' messages in the prompt, and `tokens` is its size. `call` says what it asks: `ego` or
    `helper` for their own views, `FUSION` for the ego with messages, `REPAIR` to answer again.
    """

    scene: str  # its id
    viewer: str  # id of the vehicle that is asked
    messages: int  # how many helpers' messages it has
    call: str  # a role, `FUSION` or `REPAIR`
    tokens: int  # its size


@dataclass(frozen=True)
class Sizes:
    """Hold the token counts of all rendered prompts, and the prompts outside the version's budget.

    The budget is the least and the most tokens that the version allows. A kind of call is `ego`,
    `helper`, `fusion` (the ego with helpers' messages) or `repair` (one that asks again after an
    answer that could not be parsed). `tokens` lists the counts by kind of call, and `outside` has
    the prompts that are outside.
    """

    # by call: a role, `FUSION` or `REPAIR`
    tokens: dict[str, list[int]] = field(default_factory=dict)
    outside: list[Outside] = field(default_factory=list)  # the prompts outside the budget


def measure(
    prompt: Prompt,
    data: Dataset,
    scenes: Sequence[Scene],
    count: Callable[[Sequence[Any]], int] | None,
    picture: int,
    progress: Callable[[int], None],
) -> Sizes:
    """Render every prompt that some scenes can give, and return their sizes in tokens.

    These are the prompt of every vehicle that is asked, and that of the ego with the longest
    possible messages of one helper, of two, and so on.

    Args:
        prompt: the prompt version: its templates and settings.
        data: the dataset of the scenes.
        scenes: the scenes whose prompts are rendered.
        count: returns the number of tokens of a chat's messages; None renders and counts nothing.
        picture: tokens that a picture beside a text costs.
        progress: called with 1 after each scene.
    """
    words, (least, most) = data.scenario.prompt_words, prompt.token_budget
    turns = {role: densest_repair(prompt, role, data.actions, words) for role in prompt.repair_turn}
    added = {role: count(turn) for role, turn in turns.items()} if count else {}
    sizes = Sizes({call: [] for call in (*ROLES, FUSION, REPAIR)})

    def render(scene: Scene, viewer: str, messages: Sequence[Mapping[str, Any]] = ()) -> None:
        graph, scenario = scene.graphs[viewer], scene.seat or data.scenario
        rendered = prompt.render(graph, data.actions, messages, scenario.prompt_words)
        if not count:
            return
        tokens = {FUSION if messages else graph.role: count(rendered) + picture}
        if graph.role in added:
            tokens[REPAIR] = sum(tokens.values()) + added[graph.role]
        for call, n in tokens.items():
            sizes.tokens[call].append(n)
            if not least <= n <= most:
                sizes.outside.append(Outside(scene.id, viewer, len(messages), call, n))

    for scene in scenes:
        ego, *helpers = scene.viewers
        for viewer in scene.viewers:
            render(scene, viewer)
        dense = [densest_messages(helpers, data.actions)]
        dense += [densest_plans(helpers, data.actions)] if prompt.shows_plans else []
        for messages in dense:
            for n in range(1, len(messages) + 1):
                render(scene, ego, messages[:n])
        progress(1)
    return sizes
