"""What may be read: regular files that lie in the folder, links followed,
and in no hidden folder of it.
"""

import os
import stat
from pathlib import Path

from harness.core.errors import UserError, printable
from harness.extensions.view.notes import FILE as NOTES
from harness.runs.difficulty import FILE as DIFFICULTY

PICTURES = {".svg": "image/svg+xml", ".png": "image/png"}
# What a page of a run is made from.
READ = ("run.json", "summary.csv", "decisions.parquet", "answers.jsonl", "episodes.csv")
MAYBE = (NOTES, DIFFICULTY)  # what it may have besides


def own_file(root: Path, run: str, name: str) -> Path | None:
    """Return the real path of a file in a listed run's folder, with links resolved.

    `root` is the folder of all runs, `run` the run's name in the list, and `name` the file's path
    in the run's folder. It is None if there is no such regular file, or if it lies outside `root`
    or in a hidden folder.
    """
    base = os.path.realpath(root)
    file = Path(os.path.realpath(os.path.join(base, run, name)))
    if not file.is_relative_to(base) or any(
        part.startswith(".") for part in file.relative_to(base).parts
    ):
        return None
    try:
        return file if stat.S_ISREG(file.stat().st_mode) else None
    except OSError:
        return None


def whole(root: Path, run: str) -> Path:
    """Return the folder of a listed run, after a check that all of its files may be read.

    `root` is the folder of all runs, and `run` the run's name in the list.

    Raises:
        UserError: a file is missing, is no regular file, or is a link that leads out of the folder.
    """
    for name in READ:
        if own_file(root, run, name) is None:
            raise UserError(f"{printable(run)} has no {name} of its own; make the run again")
    for name in MAYBE:
        if os.path.lexists(root / run / name) and own_file(root, run, name) is None:
            raise UserError(f"{printable(run)} has no {name} of its own; delete it")
    return root / run


def pictures(root: Path, run: str) -> list[str]:
    """Return the file names of a listed study's pictures; of one in two formats only the SVG.

    `root` is the folder of all runs, and `run` the study's name in the list.
    """
    names = sorted(os.listdir(root / run))
    scaled = {Path(name).stem for name in names if name.endswith(".svg")}
    return [
        name
        for name in names
        if Path(name).suffix in PICTURES
        and (name.endswith(".svg") or Path(name).stem not in scaled)
        and name.isprintable()
        and own_file(root, run, name)
    ]
