"""Pack a benchmark's results into one zip file, and unpack a stranger's.

In it are `results.json`, and of each dataset's run a folder with its manifest, its answers, how its
episodes ended, and the figures that its edition names. Its bytes follow from these.
"""

import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from zipfile import ZipFile, ZipInfo

import msgspec
from msgspec import Struct, to_builtins
from msgspec.structs import replace

from harness.core.errors import UserError, printable
from harness.core.files import (
    BROKEN,
    NO_ROOM,
    Refused,
    bytes_of,
    refuse_bomb,
    replacing,
    write_whole,
)
from harness.core.zips import BROKEN_ZIP, bounded_archive, piece, refuse_larger
from harness.runs.folder import Run
from harness.runs.listing import own_name
from harness.runs.records import FrozenScenes, Score
from harness.runs.settings import FrozenSettings, deciding
from harness.runs.writer import csv_text, record_text

FORMAT = "swarmdrive-results/1"
CONTENTS = "results.json"
FILES = {  # of each run, with the most bytes that each may have
    "run.json": 16 << 20,
    "answers.jsonl": 1 << 30,
    "episodes.csv": 256 << 20,
    "summary.csv": 16 << 20,
}
MOST_UNPACKED = 1 << 30  # bytes of all files together
MOST_RUNS = 100
MOST_LETTERS = 200  # of who made it
LARGEST_LIST = 1 << 20  # bytes of the archive's list of files
CHUNK = 1 << 20


class Contents(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the content of `results.json`, which describes a file of a benchmark's results.

    `edition` is the name of the benchmark's release, and `digest` its hex SHA-256; `made_by` says
    in the maker's words who made the file; `runs` are the names of the datasets, each with a run.
    Raises ValueError for another format, bad names of runs, or a `made_by` that is too long.
    """

    format: str  # `FORMAT`
    edition: str  # name of the edition, the release of the benchmark, that the results are of
    digest: str  # the edition's digest, hex SHA-256
    made_by: str  # who made the file, in their own words
    runs: tuple[str, ...]  # names of the datasets, each with a run

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
        if not 0 < len(self.runs) == len(set(self.runs)) <= MOST_RUNS or not all(
            map(_plain, self.runs)
        ):
            raise ValueError(
                "runs: none, too many, one twice, or one with a name that is no folder's"
            )
        if len(self.made_by) > MOST_LETTERS:
            raise ValueError(f"made_by has more than {MOST_LETTERS} letters")


def pack(
    contents: Contents,
    runs: Mapping[str, Run],
    figures: Callable[[Run], Sequence[Score]],
    out: Path,
) -> None:
    """Write a benchmark entry, one model's results, to the zip file `out`.

    `contents` describes it, and `runs` has the run on each dataset, by the dataset's name.
    `figures` takes a run and returns its scores that are written. Paths of this machine are left
    out. Equal runs give equal bytes.
    """
    with (
        replacing(out) as part,
        ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive,
    ):
        for name, data in _files(contents, runs, figures):
            member = ZipInfo(name)  # of 1980, so that the bytes follow from the content
            member.compress_type, member.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(member, data)


def _files(
    contents: Contents, runs: Mapping[str, Run], figures: Callable[[Run], Sequence[Score]]
) -> Iterator[tuple[str, bytes]]:
    yield CONTENTS, msgspec.json.format(msgspec.json.encode(contents), indent=1) + b"\n"
    for name, run in runs.items():
        world = run.manifest.world
        assert isinstance(world, FrozenScenes)
        scenes = FrozenSettings(dataset=name, limit=world.limit)
        settings = replace(deciding(run.manifest.settings), world=scenes)
        manifest = replace(
            run.manifest,
            name=name,
            command="",
            tags=(),
            world=replace(world, path=name),
            settings=settings,
        )
        yield f"{name}/run.json", record_text(to_builtins(manifest), run.answers.sha256)
        for file in ("answers.jsonl", "episodes.csv"):
            yield f"{name}/{file}", bytes_of(run.path / file, "rows")
        yield f"{name}/summary.csv", csv_text(Score, figures(run), manifest.variant).encode()


def contents_of(file: Path) -> Contents:
    """Read the description of a benchmark's file of results; nothing else is unpacked.

    This is its `results.json`: of which release of the benchmark the results are, who made them,
    and which runs there are. Raises UserError if the file is not one of results.
    """
    with _archive(file) as archive:
        return msgspec.json.decode(piece(archive, CONTENTS, CHUNK), type=Contents)


def unpack(file: Path, contents: Contents, folder: Path) -> None:
    """Write the runs in a benchmark's file of results to folders below `folder`, one a dataset.

    `contents` is the file's description (its `results.json`), which names the runs. Only the files
    that it calls for are written, under names made here and no larger than `FILES` allows. Raises
    UserError if the file is broken; or, before anything is unpacked, if it holds others or larger
    ones.
    """
    with _archive(file) as archive:
        wanted = {f"{name}/{each}": most for name in contents.runs for each, most in FILES.items()}
        if sorted(archive.namelist()) != sorted([CONTENTS, *wanted]):
            raise ValueError("it has other files than it should, or one twice")
        for name, most in wanted.items():
            refuse_larger(name, archive.getinfo(name).file_size, most)
        refuse_bomb(archive, file.stat().st_size, MOST_UNPACKED)
        for name, most in wanted.items():
            write_whole(folder / name, piece(archive, name, most))


@contextmanager
def _archive(file: Path) -> Iterator[ZipFile]:
    """Open a file of results. Raises UserError if it, or what is read of it, is none."""
    try:
        with bounded_archive(file, "record", LARGEST_LIST) as archive:
            yield archive
    except (*BROKEN, *BROKEN_ZIP) as error:
        if getattr(error, "errno", None) in NO_ROOM and not isinstance(error, Refused):
            raise  # it is of where this is unpacked
        reason = getattr(error, "strerror", None) or error
        raise UserError(
            f"{printable(file)} is no file of results ({printable(reason)}); give one that "
            "`harness benchmark run` or `pack` wrote"
        ) from None


def _plain(name: str) -> bool:
    return own_name(name) and name.isprintable() and "\\" not in name and 0 < len(name) <= 100
