"""Formats of other programs that a run is exported to."""

from pathlib import Path

from harness.core.errors import UserError
from harness.runs.folder import Run


class InspectLog:
    """Export a run as a log of Inspect AI, for `harness run export --inspect`.

    `write` takes the run, the file to write and the folder of the run's dataset (None: where the
    run says), and returns the file's path.
    """

    help = "Write an Inspect AI log, NAME.eval: one sample per answer."
    doing = "writing a log"
    needs = ("inspect_ai",)

    def write(self, run: Run, file: Path, dataset: Path | None) -> Path:
        from harness.extensions.interop import inspect_log

        return inspect_log.write(run, file, dataset)


class EveryEval:
    """Export a run as a record of Every Eval Ever, for `harness run export --every-eval`.

    `write` takes the run and the file to write, and returns the file's path. It reads no dataset,
    and raises UserError if one is named.
    """

    help = "Write a record of Every Eval Ever, a JSON file: each score with its interval."
    doing = "writing a record"
    needs = ()

    def write(self, run: Run, file: Path, dataset: Path | None) -> Path:
        from harness.extensions.interop import every_eval

        if dataset:
            raise UserError(
                "--dataset does not go with --every-eval, which reads none; leave it out"
            )
        return every_eval.write(run, file)


INSPECT = InspectLog()
EVERY_EVAL = EveryEval()
