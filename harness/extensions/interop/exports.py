"""Formats of other programs that a run is exported to."""

from pathlib import Path

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


INSPECT = InspectLog()
