"""An evaluation's settings, complete: enough to run it again."""

import platform
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol, get_args

import msgspec

from harness import __version__
from harness.backends.base import AnswerMode
from harness.backends.cards import Card, argument
from harness.backends.registry import capabilities, registrations
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError, printable, unknown
from harness.dataset.load import Scene
from harness.evaluate.latency import MEASURED, NAMES, declared
from harness.prompts.versions import Prompt, fits
from harness.runs.metrics import World
from harness.runs.records import ClosedLoop, FrozenScenes
from harness.world.scenario import Scenario

TAG_CHARACTERS = 40


class Source(Protocol):
    """Which world is walked."""

    @property
    def kind(self) -> World:
        """Its kind in a run's manifest."""
        ...

    @property
    def command(self) -> str:
        """The command that walks it: `eval` or `drive`."""
        ...

    @property
    def name(self) -> str:
        """Its part of the name of a run's folder."""
        ...

    @property
    def actions(self) -> tuple[str, ...]:
        """Meta-actions, in the environment's order."""
        ...

    @property
    def scenario(self) -> Scenario:
        """The scenario of its episodes."""
        ...

    def record(self) -> FrozenScenes | ClosedLoop:
        """Its record in a run's manifest."""
        ...

    def options(self) -> list[tuple[str, object]]:
        """Options of `command` that name it; None for an option that is not given."""
        ...


@dataclass(frozen=True)
class Spec:
    """One evaluation.

    Attributes:
        card: the model.
        prompt: the prompt version.
        source: which world is walked.
        points: conditions, each an operating point.
        seeds: of the channel's draws.
        thinking: whether the model thinks first.
        answer: how the model answers: free `json`, `constrained` to the schema, or the `readout` of letters.
        batch_size: most requests that go through the engine together.
        device: engine's device, or None for its choice.
        dtype: number format, or None for the card's.
        latency: where inference times come from: `card`, `paper`, `measured`, or seconds as `declared`
            reads them; None for the card's, else the paper's.
        tags: words to find the run by, which change nothing in it.
    """

    card: Card
    prompt: Prompt
    source: Source
    points: tuple[OperatingPoint, ...]
    seeds: tuple[int, ...]
    thinking: bool = False
    answer: AnswerMode = "json"
    batch_size: int = 8
    device: str | None = None
    dtype: str | None = None
    latency: str | None = None
    tags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise UserError(
                f"--seeds {list(self.seeds)}: give one or more different whole numbers, such as 0:5"
            )
        for tag in self.tags:
            if not (0 < len(tag) <= TAG_CHARACTERS and tag.isprintable() and tag == tag.strip()):
                raise UserError(
                    f"--tag {printable(tag)!r}: give 1 to {TAG_CHARACTERS} printable characters, "
                    "with no space at either end"
                )
        if self.batch_size < 1:
            raise UserError(f"--batch-size {self.batch_size}: give 1 or more")
        if not fits(self.prompt.version, self.scenario.prompt):
            raise UserError(
                f"--prompt {self.prompt.version} speaks of a crossing, which {self.scenario.name} is not; "
                f"give {self.scenario.prompt}, or one of your own"
            )
        can = capabilities(self.card.engine)
        if self.source.kind == "closed-loop" and not can.closed_loop:
            raise UserError(
                f"--model {printable(self.card.name)}: a replay has answers to frozen scenes alone; "
                "give the model that it replays"
            )
        thinks = can.thinks == "always" or (can.thinks == "card" and self.card.thinking != "none")
        if self.thinking and not thinks:
            raise UserError(f"--thinking: {printable(self.card.name)} cannot think; leave it out")
        if self.card.thinking == "always":  # its answers hold a thought, asked for or not
            object.__setattr__(self, "thinking", True)
        if self.answer not in get_args(AnswerMode):
            raise unknown("answer mode", self.answer, get_args(AnswerMode))
        if self.answer not in can.answer_modes:
            reason = "cannot answer so" if can.language_model else "is no language model"
            modes = " or ".join(can.answer_modes)
            raise UserError(f"--answer {self.answer}: {printable(self.card.name)} {reason}; use {modes}")
        if self.answer != "json" and self.thinking:
            raise UserError(
                f"--answer {self.answer}: {printable(self.card.name)} thinks first, "
                "which only json leaves room for"
            )
        self._check_latency()
        for point in self.points:
            if point.messages != "own" and self.source.kind != "frozen":
                raise UserError(
                    f"condition {printable(point.name)}: messages={point.messages} is for frozen scenes; "
                    "use harness eval"
                )
            if point.asks_again and (not can.language_model or self.answer == "readout"):
                raise UserError(
                    f"condition {printable(point.name)}: "
                    + ("a readout gives no messages to merge; use --answer json or constrained"
                       if self.answer == "readout"
                       else f"{printable(self.card.name)} is no language model and cannot merge messages")
                )  # fmt: skip
        for flag, value in {"--device": self.device, "--dtype": self.dtype}.items():
            if value is not None and not can.has_weights:
                able = [name for name, engine in registrations().items() if engine.capabilities.has_weights]
                raise UserError(
                    f"{flag} {printable(value)}: {printable(self.card.name)} has no weights here "
                    f"(engines {' and '.join(able)} have); leave it out"
                )

    def _check_latency(self) -> None:
        shown, can = f"--latency {printable(self.latency)}", capabilities(self.card.engine)
        if self.latency is None:
            return
        if self.latency not in NAMES:
            declared(self.latency)
        elif can.own_latency and self.latency != "paper":
            raise UserError(f"{shown}: a replay has the times of its run; use paper, or leave it out")
        elif self.latency == MEASURED and not can.language_model:
            raise UserError(f"{shown}: {printable(self.card.name)} is no language model; use card or paper")
        elif self.latency == "card" and self.card.latency.inference_s is None:
            raise UserError(
                f"{shown}: the card of {printable(self.card.name)} declares no inference time; "
                "use paper or measured, or add inference_s to the card"
            )

    @property
    def actions(self) -> tuple[str, ...]:
        """Meta-actions, in the environment's order."""
        return self.source.actions

    @property
    def scenario(self) -> Scenario:
        """What is decided in."""
        return self.source.scenario

    @property
    def ego_alone(self) -> bool:
        """Whether the model answers for the ego only, as a driver does."""
        return not capabilities(self.card.engine).asks_helpers

    def viewers(self, scene: Scene) -> tuple[str, ...]:
        """The vehicles of a scene that the model answers for, the ego first."""
        return scene.viewers[:1] if self.ego_alone else scene.viewers

    def settings(self) -> dict[str, Any]:
        """What a run that goes on must have in common with what it began as, as plain values."""
        world = msgspec.to_builtins(self.source.record())
        return {
            "model": asdict(self.card),
            "prompt": {k: getattr(self.prompt, k) for k in ("version", "sha256", "released")},
            "world": world,
            "actions": list(self.actions),
            "conditions": [asdict(point) for point in self.points],
            "seeds": list(self.seeds),
            "thinking": self.thinking,
            "answer": self.answer,
            "batch_size": self.batch_size,
            "dtype": self.dtype,
            "latency_source": self.latency,
        }

    def command(self, out: Path) -> str:
        """A command line that runs this again, quoted for a shell."""
        first = self.seeds[0]
        seeds = ",".join(map(str, self.seeds)) if len(self.seeds) > 1 else f"{first}:{first + 1}"
        options = [
            ("--model", argument(self.card)), ("--prompt", self.prompt.version),
            *self.source.options(), ("--seeds", seeds),
            *(("--condition", point.name) for point in self.points), ("--answer", self.answer),
            ("--batch-size", self.batch_size), ("--device", self.device), ("--dtype", self.dtype),
            ("--latency", self.latency), *(("--tag", tag) for tag in self.tags), ("--out", out),
        ]  # fmt: skip
        parts = [part for flag, value in options if value is not None for part in (flag, str(value))]
        command = ["harness", self.source.command, *parts, *(["--thinking"] if self.thinking else [])]
        return shlex.join(command)


def versions(
    packages: Sequence[str] = (
        "numpy",
        "scipy",
        "jinja2",
        "highway-env",
        "torch",
        "transformers",
        "llama-cpp-python",
    ),
) -> Any:
    """Versions of the installed packages that a result may depend on."""
    installed = {"harness": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for name in packages:
        try:
            installed[name] = version(name)
        except PackageNotFoundError:
            continue
    return installed
