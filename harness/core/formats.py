"""Names of the files that identify a folder as a run, unfinished work, a suite or a study."""

import os
from pathlib import Path

from harness.core.errors import UserError, printable

WORK = ".work"  # folder of unfinished work
# in it, the settings that the work began with; without it there is nothing to resume
CONFIG = "config.json"
# in an output folder, questions for another program, whose answers are to be judged
QUESTIONS = "questions.jsonl"
SOURCES = "sources"  # folder in a run's folder, of the files that it was made of
SUITE = "suite.json"  # marks a folder that holds a suite's runs
# What a run, a suite or a dataset is read from.
DATA = frozenset(
    {
        *("run.json", "run.toml", "decisions.parquet", "episodes.csv", "answers.jsonl"),
        *("more-answers.jsonl", "summary.csv", "difficulty.csv", SUITE, "manifest.json"),
        *("layouts.zip", "notes.json", "servers.jsonl", "costs.jsonl", CONFIG),
    }
)
# Every kind of study, and what lists call it; `<kind>.json` marks its folder. Who makes a kind adds
# it here.
STUDIES = {"sweep": "sweep"}


def refuse_data(option: str, out: Path) -> None:
    """Raise UserError if a command's output file would replace data of a run or a dataset.

    That is so if `out` exists and is a file that a run, a suite of runs or a dataset consists of,
    such as `run.json`. `option` names the option that gave it.
    """
    is_source = SOURCES in out.absolute().parts[-5:]
    if (out.name in DATA or is_source) and os.path.lexists(out):
        raise UserError(
            f"{option} {printable(out)} is a file of a run, suite or dataset, which would be lost; "
            "name another file"
        )
