"""Formats of `harness run export` for who fine-tunes a model: `--sft` and `--dpo`."""

from pathlib import Path
from types import MappingProxyType

from harness.runs.exports import Option
from harness.runs.folder import Run

MARGIN = 0.1  # by how much an answer is worth less than the one that is preferred to it


def _margin(value: float, option: str) -> str | None:
    if option == "--dpo" and 0 < value <= 1:
        return None
    return f"--margin {value:g}: it goes with --dpo, and is above 0 and at most 1"


def _report_seeds_too(value: bool, option: str) -> str | None:
    if option in ("--sft", "--dpo"):
        return None
    return "--report-seeds-too only goes with --sft and --dpo; give one, or leave it out"


REPORT_SEEDS_TOO = Option(
    bool,
    "With --sft and --dpo: also allow layouts with report seeds (200000 and above).",
    _report_seeds_too,
)
LEAST = Option(
    float, "With --dpo: how much less an answer must be worth, above 0 to 1. Default: 0.1.", _margin
)


class Lessons:
    """Export chats to fine-tune a language model on, made of a run: the format `--sft`.

    Each question that the run asked becomes one line of JSON: the chat messages, and the answer
    that the model should have given. It is known from the scene's decision tree, which has every
    course that actions can lead to from there, and how each ends. Methods are those of an export
    format of `harness run export`.
    """

    help = (
        "Write chats to fine-tune on as JSON Lines; their answers are those that the decision "
        "trees show to be right."
    )
    doing = "writing chats"
    needs = ()
    options = MappingProxyType({"report-seeds-too": REPORT_SEEDS_TOO})

    def write(
        self, run: Run, file: Path, dataset: Path | None, *, report_seeds_too: bool = False
    ) -> Path:
        from harness.extensions.learn.training import pairs

        return pairs.write(run, file, report_seeds_too, dataset)


class Preferences:
    """Export pairs of answers, a better and a worse one, to a run's chats: the format `--dpo`.

    Each line of JSON is a question that the model answered worse than it could: the chat messages,
    the right answer as the chosen one, and the model's as the rejected one. The right answer is
    known from the scene's decision tree, every course that actions can lead to. An answer is worth
    the probability that it gives to actions after which success is possible; `--margin` says by how
    much the model's must be worth less.
    """

    help = (
        "Write the same chats with the model's own answers as the rejected ones, where these are "
        "worse."
    )
    doing = "writing chats"
    needs = ()
    options = MappingProxyType({"margin": LEAST, "report-seeds-too": REPORT_SEEDS_TOO})

    def write(
        self,
        run: Run,
        file: Path,
        dataset: Path | None,
        *,
        margin: float = MARGIN,
        report_seeds_too: bool = False,
    ) -> Path:
        from harness.extensions.learn.training import pairs

        return pairs.write(run, file, report_seeds_too, dataset, margin)


SFT, DPO = Lessons(), Preferences()
