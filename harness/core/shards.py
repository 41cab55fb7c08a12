"""Shards: parts of one work that are done apart, each in a folder of its own, and put together by the bytes.

A shard's working folder holds what the whole's would at these places, and says which shard it is.
"""

import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec

from harness.core import work
from harness.core.errors import UserError, printable
from harness.core.formats import CONFIG, WORK

T = TypeVar("T")
MOST = 100_000
# Numbers of a job's task, and what its first one is: Slurm's is what the array says, Kubernetes's is 0.
TASKS = {"SLURM_ARRAY_TASK_ID": 1, "JOB_COMPLETION_INDEX": 0}


@dataclass(frozen=True)
class Shard:
    """One of `of` parts of a work, counted from 1."""

    number: int
    of: int

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def part(self, items: Sequence[T]) -> Sequence[T]:
        """Of a sequence the shard's items, which stand together. Raises UserError where a shard has none."""
        if self.of > len(items):
            raise UserError(
                f"--shard {self}: the work has {len(items)} parts; give {len(items)} shards or fewer"
            )
        at, until = (len(items) * n // self.of for n in (self.number - 1, self.number))
        return items[at:until]


def shard_of(text: str, environment: Mapping[str, str] = os.environ) -> Shard:
    """The shard that `--shard` names: `3/16`, or `auto/16` for the number of this task of a job.

    Raises:
        UserError: there is no such shard, or this is no task of a job.
    """
    number, _, of = text.partition("/")
    if number == "auto":
        name = next((name for name in TASKS if name in environment), None)
        if name is None:
            raise UserError(
                f"--shard {printable(text)}: neither {' nor '.join(TASKS)} is set; give 1/N to N/N"
            )
        task = environment[name]
        number = str(int(task) + 1 - TASKS[name]) if re.fullmatch(r"\d{1,9}", task, re.ASCII) else task
        text = f"{printable(number)}/{of} ({name} is {printable(task)})"
    counts = re.fullmatch(r"\d{1,9}/\d{1,9}", f"{number}/{of}", re.ASCII)
    if not counts or not 1 <= int(number) <= int(of) <= MOST:
        raise UserError(
            f"--shard {printable(text)}: give 1/N to N/N, or auto/N, with N shards, {MOST} at most"
        )
    return Shard(int(number), int(of))


Begun = TypeVar("Begun", bound=work.Begun)


def read(folders: Sequence[Path], kind: type[Begun]) -> list[Begun]:
    """What the shards in some folders began with: all shards of one work.

    Raises:
        UserError: a folder holds none, one is still being written, they are of different works, or one is
            missing.
    """
    found = [_read(folder, kind) for folder in folders]
    first, facts = folders[0], found[0].facts()
    for folder, begun in zip(folders, found, strict=True):
        others = begun.facts()
        if differ := [key for key in {**facts, **others} if facts.get(key) != others.get(key)]:
            raise UserError(
                f"{printable(folder)} and {printable(first)} differ in {printable(', '.join(differ))}; give "
                "shards of one run"
            )
    shards = [shard_of(begun.shard) for begun in found]
    of = {shard.of for shard in shards}
    if len(of) > 1:
        raise UserError(f"shards of {' and of '.join(map(str, sorted(of)))}; give those of one run")
    have, every = {shard.number for shard in shards}, shards[0].of
    if lack := [str(Shard(n, every)) for n in range(1, every + 1) if n not in have]:
        raise UserError(f"shards {printable(', '.join(lack))} are missing; give the folders of all {every}")
    return found


def _read(folder: Path, kind: type[Begun]) -> Begun:
    file = folder / WORK / CONFIG
    try:
        begun = msgspec.json.decode(file.read_bytes(), type=kind)
    except (OSError, ValueError, RecursionError):
        begun = None
    if begun is None or not begun.shard:
        raise UserError(
            f"{printable(folder)} is no shard; give folders made with --shard, which were not merged yet"
        )
    shard_of(begun.shard, {})
    if work.held(folder):
        raise UserError(f"{printable(folder)} is being written by another process; wait for it")
    return begun


def owners(
    folders: Sequence[Path], begun: Sequence[work.Begun], parts: Sequence[str], named: Callable[[str], str]
) -> dict[str, Path]:
    """Where each part of a work lies.

    Args:
        folders: of the shards.
        begun: what each began with.
        parts: names of all parts of the work, in order.
        named: what a part is called in messages.

    Raises:
        UserError: a shard is not finished, or two folders have a part that differs.
    """
    found: dict[str, Path] = {}
    for folder, each in zip(folders, begun, strict=True):
        mine = {name: folder / WORK / name for name in shard_of(each.shard).part(parts)}
        if lack := [name for name, part in mine.items() if not part.exists()]:
            raise UserError(
                f"{printable(folder)}, shard {each.shard}, lacks {printable(named(lack[0]))} and "
                f"{len(lack) - 1} parts more; type its command again, and then merge"
            )
        for name, part in mine.items():
            if name in found and _content(part) != _content(found[name]):
                raise UserError(
                    f"{printable(named(name))} came out differently in {printable(folder)} than in "
                    f"{printable(found[name].parents[1])}; find out which is right, and leave out the other"
                )
            found[name] = part
    return found


def collect(parts: Mapping[str, Path], place: Path) -> None:
    """Copy parts to a working folder, each whole, but those that are there."""
    for name, part in parts.items():
        half = place / f".{name}.{os.getpid()}.part"
        if not (place / name).exists():
            shutil.rmtree(half, ignore_errors=True)
            (shutil.copytree if part.is_dir() else shutil.copyfile)(part, half)
            os.replace(half, place / name)


def _content(part: Path) -> dict[str, bytes]:
    files = sorted(part.iterdir()) if part.is_dir() else [part]
    return {file.name: file.read_bytes() for file in files}
