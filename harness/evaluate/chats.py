"""The chat that asks a viewer outside of a run: alone, without messages of others."""

from dataclasses import dataclass
from typing import Literal, get_args

from harness.core.errors import UserError, printable, unknown
from harness.evaluate.agent import in_mode
from harness.prompts.versions import Prompt, load, unfit
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

Form = Literal["json", "readout"]


@dataclass(frozen=True)
class Asking:
    """Describe how single vehicles are asked outside of a run, without messages of others.

    `scenario` is that of the scenes to ask about, `prompt` the prompt version, and `answer` is
    `json`, or `readout`: one letter. Raises UserError if the prompt shows pictures or does not fit
    the scenario.
    """

    scenario: Scenario  # the scenario of the scenes, whose actions and words the chats have
    prompt: Prompt  # the prompt version
    answer: Form = "json"  # `json`, or `readout`: one letter

    def __post_init__(self) -> None:
        version = printable(self.prompt.version)
        if self.answer not in get_args(Form):
            raise unknown("answer", str(self.answer), get_args(Form))
        if self.prompt.image:
            raise UserError(
                f"prompt {version} shows pictures, and here are texts alone; give another"
            )
        if reason := unfit(self.prompt, self.scenario):
            raise UserError(
                f"prompt {version} {reason}; give another, such as {self.scenario.prompt}"
            )

    @classmethod
    def of(cls, scenario: Scenario, prompt: str | None, answer: str) -> "Asking":
        """Return how vehicles in scenes of a scenario are asked, given a prompt version by name.

        None is the scenario's own version. `answer` is `json` or `readout`, one letter. Raises
        UserError if there is no such version, or it cannot be used.
        """
        return cls(scenario, load(prompt or scenario.prompt), answer)  # type: ignore[arg-type]

    def chat(self, graph: SceneGraph, seat: Scenario | None = None) -> list[dict[str, str]]:
        """Return the chat messages that ask one vehicle about a scene, with `role` and `content`.

        `graph` is the vehicle's scene graph, what it knows of the scene. `seat` is the scenario as
        the scene has it (`Scene.seat`), with a goal of its own; None if all scenes have one.
        """
        actions, words = self.scenario.actions, (seat or self.scenario).prompt_words
        sent = self.prompt.render(graph, actions, (), words, letter=self.answer == "readout")
        return [{**m} for m in in_mode(self.answer, self.prompt, sent, graph, actions, words)]
