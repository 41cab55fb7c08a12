"""The decision answer mode: a typed question about a state, with what each option means.

A decision model reads a state and a question, and gives each option a probability without writing
text. Any chat model answers the same question by a read-out of letters (`harness.prompts.readout`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from harness.prompts import readout

if TYPE_CHECKING:
    from harness.world.scene_graph import SceneGraph

# `choice` between options; `score`, of levels named by their place from 0, the lowest first;
# `noul`, how probable `true` is and how probable `false`.
Kind = Literal["choice", "score", "noul"]

# What actions mean; the words of a scenario go before it, under the action's name.
MEANINGS = {
    "SLOWER": "go one speed level down, of {speeds} m/s",
    "IDLE": "keep the speed",
    "FASTER": "go one speed level up, of {speeds} m/s",
    "LANE_LEFT": "change to the lane on the left",
    "LANE_RIGHT": "change to the lane on the right",
}

# What counts, by who is asked.
CARE = {
    "ego": "Never collide, and lose no time where nothing is in your way.",
    "helper": "It must never collide, and should lose no time where nothing is in its way.",
}


@dataclass(frozen=True)
class Question:
    """State a choice between actions, or other options.

    A decision model gives each option a probability.
    """

    state: str  # what the prompt says of the scene
    instructions: str  # what is asked, in the scenario's words
    # what each action, or other option, means, by its name; None where nobody says
    meanings: Mapping[str, str | None]
    kind: Kind = "choice"  # the question's type in the API of servers of such models

    def reworded(self, change: Callable[[str], str]) -> "Question":
        """Return the question with `change` applied to all of its texts."""
        meanings = {action: text and change(text) for action, text in self.meanings.items()}
        return replace(
            self,
            state=change(self.state),
            instructions=change(self.instructions),
            meanings=meanings,
        )


def question(
    messages: Sequence[Mapping[str, str]],
    graph: "SceneGraph",
    actions: Sequence[str],
    words: Mapping[str, str],
) -> Question:
    """Return the question that a decision model is asked about what one vehicle sees.

    A decision model gives each of the actions a probability, and writes no text.

    Args:
        messages: the prompt's chat about the scene; the text of the last is the question's state.
        graph: the scene graph of the vehicle that is asked: what it sees.
        actions: names of the meta-actions, which are the options.
        words: texts by which the scenario describes itself, by name, such as `task`.
    """
    ego, task, hiding = graph.ego.id, words.get("task", "drive on"), words.get("hiding")
    care = CARE[graph.role]
    if graph.role == "ego":
        hidden = f" Other cars may be hidden by {hiding}." if hiding else ""
        instructions = (
            f"You drive car {ego}. Your task: {task}.{hidden} {care} What do you do in the next "
            "second?"
        )
    else:
        instructions = (
            f"You help car {ego}, which does not see all that you see. Its task: {task}. {care} "
            f"What should {ego} do in the next second?"
        )
    return Question(messages[-1]["content"], instructions, {a: _meaning(a, words) for a in actions})


def _meaning(action: str, words: Mapping[str, str]) -> str | None:
    text = words.get(action, MEANINGS.get(action))
    return text and text.replace("{speeds}", words.get("speeds", "those there are"))


def letter_chat(
    question: Question, messages: Sequence[Mapping[str, str]], order: Sequence[str]
) -> tuple[Mapping[str, str], ...]:
    """Return the chat messages that put a typed question to a chat model, which answers one letter.

    The options are listed by letter in `order`, after the question's state, which all orders share.
    `messages` are the prompt's chat about the same scene; a picture stays with the last of them.
    """
    meant = (question.meanings[action] for action in order)
    options = [
        f"{action}: {text}" if text else action for action, text in zip(order, meant, strict=True)
    ]
    user = {**messages[-1], "content": "\n".join([question.state, *options])}
    return readout.letter_chat(({"role": "system", "content": question.instructions}, user), order)
