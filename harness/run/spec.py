"""What is evaluated, resolved and complete: enough to run it again."""

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from harness import __version__
from harness.cards import Card, names
from harness.dataset.load import Dataset
from harness.errors import UserError
from harness.operating_point import OperatingPoint
from harness.prompts import Prompt

FORMAT = "swarmdrive-run/1"


@dataclass(frozen=True)
class Spec:
    """One evaluation.

    Attributes:
        card: the model.
        prompt: the prompt version.
        dataset: the scenes, already limited.
        points: conditions, each an operating point.
        seeds: seeds of the channel's luck.
        limit: how many episodes of the dataset were taken; None for all.
        thinking: whether the model is asked to think first.
        batch_size: most requests that go through the engine together.
        device: engine's device, or None for its choice.
        dtype: number format, or None for the card's.
    """

    card: Card
    prompt: Prompt
    dataset: Dataset
    points: tuple[OperatingPoint, ...]
    seeds: tuple[int, ...]
    limit: int | None = None
    thinking: bool = False
    batch_size: int = 8
    device: str | None = None
    dtype: str | None = None

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise UserError(
                f"--seeds {list(self.seeds)}: give one or more different whole numbers, such as 0:5"
            )
        if self.batch_size < 1:
            raise UserError(f"--batch-size {self.batch_size}: give 1 or more")
        if self.thinking and self.card.thinking == "none" and self.card.engine != "transformers":
            raise UserError(f"--thinking: {self.card.name} cannot think; leave it out")

    def settings(self) -> dict[str, Any]:
        """What a resumed run must have in common with the one it continues."""
        return {
            "model": asdict(self.card),
            "prompt": {k: getattr(self.prompt, k) for k in ("version", "sha256", "released")},
            "dataset": {
                "name": self.dataset.name, "sha256": self.dataset.sha256, "scenes": len(self.dataset.scenes),
                "episodes": len({s.record["episode"] for s in self.dataset.scenes}),
            },
            "actions": list(self.dataset.actions),
            "conditions": [asdict(point) for point in self.points],
            "seeds": list(self.seeds),
            "limit": self.limit,
            "thinking": self.thinking,
            "batch_size": self.batch_size,
            "dtype": self.dtype,
        }  # fmt: skip

    def command(self, out: Path) -> str:
        """A command line that runs this again."""
        parts = [
            "harness eval", f"--model {model_argument(self.card)}", f"--prompt {self.prompt.version}",
            f"--dataset {self.dataset.path}", f"--seeds {','.join(map(str, self.seeds))}",
            *(f"--condition {point.name}" for point in self.points), f"--batch-size {self.batch_size}",
        ]  # fmt: skip
        optional = {"--limit": self.limit, "--device": self.device, "--dtype": self.dtype}
        parts += [f"{flag} {value}" for flag, value in optional.items() if value is not None]
        parts += ["--thinking"] if self.thinking else []
        return " ".join([*parts, f"--out {out}"])


def model_argument(card: Card) -> str:
    """What `--model` was given, or anything that resolves to the same card."""
    if card.name in names():
        return card.name
    return f"replay:{card.weights}" if card.engine == "replay" else str(card.weights)


def versions(
    packages: Sequence[str] = ("numpy", "scipy", "jinja2", "highway-env", "torch", "transformers"),
) -> Any:
    """Versions of what a result may depend on, as far as it is installed."""
    found = {"harness": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
