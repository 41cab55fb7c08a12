"""What is driven, resolved and complete: enough to drive it again."""

import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from harness.backends.cards import Card
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError, printable
from harness.dataset.load import Dataset
from harness.evaluate.spec import Spec, model_argument
from harness.prompts.versions import Prompt
from harness.world import scenarios

FORMAT = "swarmdrive-drive/1"


@dataclass(frozen=True)
class Drive(Spec):
    """One live run: every condition and seed drives every episode. Raises UserError for what it cannot be.

    Attributes:
        first_seed: layout seed of the first episode; episode e has layout seed `first_seed` + e.
        episodes: how many layouts are driven.
    """

    first_seed: int = 0
    episodes: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.card.engine == "replay":
            raise UserError(
                f"--model {printable(self.card.name)}: a replay has answers to frozen scenes alone; "
                "give the model that it replays"
            )

    def settings(self) -> dict[str, Any]:
        """What a resumed run must have in common with the one it continues."""
        of_frozen = super().settings()
        return {
            **{k: v for k, v in of_frozen.items() if k not in ("dataset", "limit")},
            "scenario": {
                "name": self.dataset.scenario.name,
                "parameters": asdict(self.dataset.scenario.parameters),
            },
            "first_seed": self.first_seed,
            "episodes": self.episodes,
        }

    def command(self, out: Path) -> str:
        """A command line that drives this again, quoted for a shell."""
        options = [
            ("--model", model_argument(self.card)), ("--prompt", self.prompt.version),
            ("--episodes", self.episodes), ("--first-seed", self.first_seed),
            ("--seeds", ",".join(map(str, self.seeds))),
            *(("--condition", point.name) for point in self.points), ("--answer", self.answer),
            ("--batch-size", self.batch_size), ("--device", self.device), ("--dtype", self.dtype),
            ("--latency", self.latency), *(("--tag", tag) for tag in self.tags), ("--out", out),
        ]  # fmt: skip
        parts = [part for flag, value in options if value is not None for part in (flag, str(value))]
        return shlex.join(["harness", "drive", *parts, *(["--thinking"] if self.thinking else [])])


def spec_of(
    card: Card, prompt: Prompt, points: tuple[OperatingPoint, ...], seeds: tuple[int, ...], **options: Any
) -> Drive:
    """A live run. It has the scenario's name and actions in the place of a dataset, and no frozen scenes."""
    scenario = scenarios.get(scenarios.DEFAULT)
    named = {"name": scenario.name, "scenario": scenario.name, "actions": list(scenario.actions)}
    live = Dataset(Path(scenario.name), named, "", ())
    return Drive(card, prompt, live, points, seeds, **options)
