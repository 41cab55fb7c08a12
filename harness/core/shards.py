"""Split work into shards, one folder each, and merge their files byte for byte.

A shard's working folder holds the same files as the whole work would,
and its config names the shard.
"""

import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec

from harness.core import work
from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.core.files import bytes_of, refuse_links, text_of
from harness.core.formats import CONFIG, WORK
from harness.core.seals import write_seal
from harness.core.zips import BROKEN_ZIP

T = TypeVar("T")
MOST = 100_000
# What taking a shard's values apart raises where they are forged.
BROKEN_PARTS = (ValueError, LookupError, TypeError, AttributeError, OverflowError)
# Environment variables that number a job's tasks, with the number taken as the first: an array of
# Slurm has the numbers that it was given, and Kubernetes counts from 0.
TASKS = {"SLURM_ARRAY_TASK_ID": 1, "JOB_COMPLETION_INDEX": 0}


@dataclass(frozen=True)
class Shard:
    """Name one of the equal parts into which some work is divided, to be done apart.

    It is part `number`, counted from 1, of `of` parts; as text `3/16`.
    """

    number: int  # which part, from 1
    of: int  # how many parts there are

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def part(self, items: Sequence[T], more: str = "") -> Sequence[T]:
        """Return this shard's slice of the items of a whole work, in their order.

        A shard is one of several parts of equal size. Raises UserError if there are more shards
        than items; `more` says what gives as many.
        """
        if self.of > len(items):
            parts, shards = amount(len(items), "part"), amount(len(items), "shard")
            instead = f", or {more}" if more else ""
            raise UserError(
                f"--shard {self}: the work has {parts}; give {shards} or fewer{instead}"
            )
        start, stop = (len(items) * n // self.of for n in (self.number - 1, self.number))
        return items[start:stop]


def shard_of(text: str, environment: Mapping[str, str] = os.environ) -> Shard:
    """Parse the value of `--shard`: `3/16`, or `auto/16` for the number of this task in a job.

    `auto` reads the task's number from `environment` (Slurm, Kubernetes). Raises UserError if there
    is no such shard, or `auto` is given outside a job.
    """
    number, _, total = text.partition("/")
    if number == "auto":
        name = next((name for name in TASKS if name in environment), None)
        if name is None:
            raise UserError(
                f"--shard {printable(text)}: neither {' nor '.join(TASKS)} is set; give 1/N to N/N"
            )
        task = environment[name]
        number = (
            str(int(task) + 1 - TASKS[name]) if re.fullmatch(r"\d{1,9}", task, re.ASCII) else task
        )
        text = f"{printable(number)}/{total} ({name} is {printable(task)})"
    counts = re.fullmatch(r"\d{1,9}/\d{1,9}", f"{number}/{total}", re.ASCII)
    if not counts or not 1 <= int(number) <= int(total) <= MOST:
        raise UserError(
            f"--shard {printable(text)}: give 1/N to N/N, or auto/N, with N shards, {MOST} at most"
        )
    return Shard(int(number), int(total))


Start = TypeVar("Start", bound=work.WorkStart)


def read(folders: Sequence[Path], kind: type[Start]) -> list[Start]:
    """Read the settings of all shards of one work, and check that they are complete.

    A shard is one part of a work (a run or a dataset), made with `--shard`, in an output folder of
    its own. `kind` is the type of its record of settings. Returns the records in the order of
    `folders`. Raises UserError if a folder holds no shard, one is still being written, they are of
    different works, or one is missing.
    """
    configs = [_read(folder, kind) for folder in folders]
    first, facts = folders[0], configs[0].facts()
    for folder, config in zip(folders, configs, strict=True):
        other_facts = config.facts()
        if differ := [
            key for key in {**facts, **other_facts} if facts.get(key) != other_facts.get(key)
        ]:
            raise UserError(
                f"{printable(folder)} and {printable(first)} differ in "
                f"{printable(', '.join(differ))}; give "
                "shards of one run"
            )
    shards = [shard_of(config.shard) for config in configs]
    totals = {shard.of for shard in shards}
    if len(totals) > 1:
        raise UserError(
            f"shards of {' and of '.join(map(str, sorted(totals)))}; give those of one run"
        )
    numbers, total = {shard.number for shard in shards}, shards[0].of
    if missing := [str(Shard(n, total)) for n in range(1, total + 1) if n not in numbers]:
        raise UserError(
            f"shards {printable(', '.join(missing))} are missing; give the folders of all {total}"
        )
    return configs


@contextmanager
def made_whole(folders: Sequence[Path], out: Path) -> Iterator[None]:
    """Enter a context for code that makes one run or dataset of shards in the folder `out`.

    Errors that damaged files of shards cause there become a UserError. `folders` are those of the
    shards, the parts of the work. On such an error `out` is deleted, unless it was there before.
    """
    was_there = out.exists()
    try:
        yield
    except (*BROKEN_PARTS, *BROKEN_ZIP) as error:
        if not was_there:
            shutil.rmtree(out, ignore_errors=True)
        named = printable(", ".join(map(str, folders)), 200)
        reason = f"{type(error).__name__}: {printable(error)}"
        raise UserError(
            f"{named} hold no parts of one whole ({reason}); make these shards again"
        ) from error


def _read(folder: Path, kind: type[Start]) -> Start:
    file = folder / WORK / CONFIG
    if not folder.is_dir():
        raise UserError(f"{printable(folder)} is no folder; give those of all shards")
    refuse_links(folder / WORK)
    try:
        config = msgspec.json.decode(text_of(file, "record"), type=kind)
    except (OSError, ValueError, RecursionError):
        config = None
    if config is None or not config.shard:
        raise UserError(
            f"{printable(folder)} is no shard; give folders made with --shard, by `harness drive` "
            "or `harness dataset build`, which were not merged yet"
        )
    shard_of(config.shard, {})
    if work.held(folder):
        raise UserError(f"{printable(folder)} is being written by another process; wait for it")
    return config


def owners(
    folders: Sequence[Path],
    configs: Sequence[work.WorkStart],
    parts: Sequence[str],
    label: Callable[[str], str],
) -> dict[str, Path]:
    """Return the path of each item of a work, by its file name, in the folder of its shard.

    An item is a file or folder of the working folder, such as that of an episode.

    Args:
        folders: the output folders of all shards.
        configs: their records of settings, in the same order, as `read` returns them.
        parts: the file names of all items of the work, in order.
        label: gives an item's name in messages from its file name.

    Raises:
        UserError: a shard is not finished, or an item differs between two folders.
    """
    paths: dict[str, Path] = {}
    for folder, config in zip(folders, configs, strict=True):
        shard_parts = {name: folder / WORK / name for name in shard_of(config.shard).part(parts)}
        if missing := [name for name, part in shard_parts.items() if not part.exists()]:
            first, *others = missing
            more = f" and {amount(len(others), 'part')} more" if others else ""
            raise UserError(
                f"{printable(folder)}, shard {config.shard}, lacks {printable(label(first))}{more};"
                " type its command again, and then merge"
            )
        for name, part in shard_parts.items():
            if name in paths and _content(part) != _content(paths[name]):
                raise UserError(
                    f"{printable(label(name))} came out differently in {printable(folder)} than in "
                    f"{printable(paths[name].parents[1])}; find out which is right, and leave out "
                    "the other"
                )
            paths[name] = part
    return paths


def collect(parts: Mapping[str, Path], folder: Path) -> None:
    """Copy files or folders from shards to a working folder, each in one step.

    `parts` has the path of each by its name in `folder`. What the folder already holds with the
    same bytes is skipped. Copies are sealed (`seals.write_seal`), so that work that goes on there
    trusts them, since whoever typed the command wants them as they are.
    """
    for name, part in parts.items():
        copy, there = folder / f".{name}.{os.getpid()}.part", folder / name
        content = _content(part)
        if there.exists() and _content(there) != content:
            shutil.rmtree(there) if there.is_dir() else there.unlink()
        if not there.exists():
            shutil.rmtree(copy, ignore_errors=True)
            write_seal(there, content)
            if part.is_dir():
                copy.mkdir()
                for file, data in content.items():
                    (copy / file).write_bytes(data)
            else:
                copy.write_bytes(content[part.name])
            os.replace(copy, there)


def _content(part: Path) -> dict[str, bytes]:
    files = sorted(part.iterdir()) if part.is_dir() else [part]
    return {file.name: bytes_of(file, "rows") for file in files}
