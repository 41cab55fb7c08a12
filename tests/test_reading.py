"""One reader opens every file: a regular one, of bounded size, without a wait;
and nothing else reads.
"""

import ast
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from run_on_disk import made_up

import harness as package
from harness.core.config import loads, toml
from harness.core.errors import UserError
from harness.core.files import LARGEST, Kind, Refused, bytes_of, opened, sha256_file, text_of
from harness.core.resources import folder
from harness.runs import folder as runs
from harness.runs.listing import runs as runs_in

SOURCES = Path(package.__file__).parent
Command = Callable[..., tuple[int, str, str]]
TRACE = (
    'model = "trace"\ndescription = "d"\nsource = "s"\nstatus = "measured"\n[parameters]\nfile = '
    '"points.csv"'
)
# Where another exit code than 2 is right: a verdict; or what is no file is as good as not there.
ELSE = {"small/layouts.zip": 1, "begun/.work/config.json": 0, "models/mine.toml": 0}
MARK = b"\xef\xbb\xbf"


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """Fail, and do not hang, where something waits."""

    def late(number: int, frame: object) -> None:
        raise AssertionError(f"it waits for more than {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def pipe(place: Path) -> None:
    os.mkfifo(place)


def device(place: Path) -> None:
    place.symlink_to("/dev/zero")


def huge(place: Path) -> None:
    place.touch()
    os.truncate(place, 1 << 43)  # takes no space on the disk


@pytest.mark.parametrize("kind", LARGEST)
@pytest.mark.parametrize("make", [pipe, device, huge])
def test_only_a_regular_file_of_its_kinds_size_is_read(
    make: Callable[[Path], None], kind: Kind, tmp_path: Path
) -> None:
    place = tmp_path / "it"
    make(place)
    for read in (bytes_of, text_of, sha256_file, opened):
        with within(5), pytest.raises(Refused) as refused:
            read(place, kind)
        expected = "the limit" if make is huge else "no file, but a pipe or a device"
        assert expected in str(refused.value.strerror)
        assert refused.value.filename == str(place)


def test_a_link_to_a_file_is_the_file_and_a_folder_and_a_gap_are_named(tmp_path: Path) -> None:
    (tmp_path / "it").write_bytes(b"here")
    (tmp_path / "link").symlink_to("it")
    assert bytes_of(tmp_path / "link", "text") == b"here"
    with pytest.raises(IsADirectoryError):
        bytes_of(tmp_path, "text")
    with pytest.raises(FileNotFoundError):
        bytes_of(tmp_path / "gone", "text")


def test_the_largest_file_of_a_kind_is_read_and_one_byte_more_is_not(tmp_path: Path) -> None:
    (tmp_path / "it").write_bytes(b"x" * LARGEST["settings"])
    assert len(bytes_of(tmp_path / "it", "settings")) == LARGEST["settings"]
    with (tmp_path / "it").open("ab") as file:
        file.write(b"x")
    with pytest.raises(Refused, match="larger than 1 MB"):
        bytes_of(tmp_path / "it", "settings")


def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path: Path) -> None:
    (tmp_path / "it").write_bytes(MARK + "a = 'ä'".encode())
    assert text_of(tmp_path / "it") == "a = 'ä'"
    assert toml(tmp_path / "it", "it") == {"a": "ä"}
    (tmp_path / "it").write_bytes("a = 1".encode("utf-16"))
    with pytest.raises(UserError, match="it is no TOML"):
        toml(tmp_path / "it", "it")


def test_a_key_with_thousands_of_dots_is_refused_at_once() -> None:
    with within(5), pytest.raises(UserError, match="more than 100 dots"):
        loads("a." * 400_000 + "a = 1", "it")
    with pytest.raises(UserError, match="more than 100 dots"):
        loads('[x]\n"a" . ' + "'b' .\tc." * 60 + "a = 1", "it")
    assert loads("a.b.c = 1", "it") == {"a": {"b": {"c": 1}}}


QUICK = ("eval", "--dataset", "small", "--limit", "1", "--seeds", "0", "--dry-run")
# Files of a project, and a command that reads each.
READ: dict[str, tuple[str, ...]] = {
    "channels/mine.toml": (*QUICK, "--condition", "mine"),
    "channels/points.csv": (*QUICK, "--condition", "trace"),
    "networks/mine.toml": (*QUICK, "--condition", "cloud:round_trip=mine"),
    "devices/mine.toml": ("model", "device", "show", "mine"),
    "schedules/mine.toml": (*QUICK, "--condition", "6g:schedule=mine"),
    "calibrations/mine.toml": (*QUICK, "--condition", "6g:calibration=mine"),
    "models/mine.toml": ("model", "list"),
    "models/folder/config.json": (*QUICK, "--model", "models/folder"),
    "models/mine.gguf": (*QUICK, "--model", "models/mine.gguf"),
    "prompts/mine/prompt.toml": (*QUICK, "--prompt", "mine"),
    "prompts/mine/ego.j2": (*QUICK, "--prompt", "mine"),
    "prompts/mine/examples.json": (*QUICK, "--prompt", "mine"),
    "prompts/mine/answer.json": (*QUICK, "--prompt", "mine"),
    "datasets/suites.toml": ("eval", "--dataset", "suite:mine", "--dry-run"),
    "curves.csv": ("radio", "check", "mode4", "--against", "curves.csv"),
    "config.json": ("drive", "--env", "merge-v0", "--env-config", "config.json", "--episodes", "1"),
    "answer.txt": ("prompt", "parse", "answer.txt"),
    "tokenizer.json": (
        "prompt",
        "check",
        "v2",
        "--dataset",
        "small",
        "--tokenizer",
        "tokenizer.json",
    ),
    "small/manifest.json": ("dataset", "check", "small"),
    "small/layouts.zip": ("dataset", "check", "small"),
    "begun/.work/config.json": ("eval", "--dataset", "small", "--limit", "1", "--out", "begun"),
    "suite/suite.json": ("report", "suite"),
}


@pytest.mark.parametrize("make", [pipe, device])
@pytest.mark.parametrize("file", READ)
def test_no_command_waits_for_what_is_no_file(
    file: str, make: Callable[[Path], None], harness: Command, small_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "swarmdrive.toml").touch()
    shutil.copytree(small_path, tmp_path / "small")
    if file.startswith("prompts/"):
        shutil.copytree(folder("prompts") / "v6", tmp_path / "prompts/mine")
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    if file == "channels/points.csv":
        (tmp_path / "channels/trace.toml").write_text(TRACE)
    (tmp_path / file).unlink(missing_ok=True)
    make(tmp_path / file)
    with within(60):
        code, _, err = harness(*READ[file])
    assert code in (2, ELSE.get(file)), err
    assert code != 2 or len(err.splitlines()) == 1, err


OF_A_RUN: dict[str, Callable[[Path], object]] = {
    "run.json": runs.read,
    "answers.jsonl": lambda run: runs.read(run).answers,
    "decisions.parquet": lambda run: runs.read(run).decisions,
    "episodes.csv": lambda run: runs.read(run).episodes,
    "summary.csv": lambda run: runs.read(run).scores,
}


@pytest.mark.parametrize("make", [pipe, device, huge])
@pytest.mark.parametrize("file", OF_A_RUN)
def test_no_reader_of_a_run_waits_for_what_is_no_file(
    file: str, make: Callable[[Path], None], tmp_path: Path
) -> None:
    run = made_up(tmp_path / "run")
    (run / file).unlink()
    make(run / file)
    with within(20), pytest.raises(UserError, match=r"no run\.json|it is no file|larger than"):
        OF_A_RUN[file](run)
    with within(20):
        assert [one.state for one in runs_in(tmp_path)] in (["broken"], ["finished"])


@pytest.mark.slow
def test_a_table_of_few_bytes_and_a_thousand_million_rows_is_refused(tmp_path: Path) -> None:
    run = made_up(tmp_path / "run")
    file = run / "decisions.parquet"
    table = pq.read_table(file)
    rows = pa.concat_tables([table.slice(0, 1)] * 1_000).combine_chunks()
    pq.write_table(pa.concat_tables([rows] * 100), file, compression="zstd")  # 100 000
    with pytest.raises(
        UserError, match=f"100000 rows; {2 * 10 * len(runs.read(run).episodes)} is the most"
    ):
        _ = runs.read(run).decisions


@pytest.mark.exhaustive
def test_a_table_of_few_bytes_and_a_text_of_many_is_refused(tmp_path: Path) -> None:
    run = made_up(tmp_path / "run")
    file = run / "decisions.parquet"
    table = pq.read_table(file)
    text = pa.array(["x" * 70_000_000]).dictionary_encode()
    wide = table.slice(0, 1).set_column(table.column_names.index("danger"), "danger", text)
    pq.write_table(
        pa.concat_tables([table.slice(1), wide], promote_options="permissive"),
        file,
        compression="zstd",
    )
    assert file.stat().st_size < 1 << 20
    with pytest.raises(UserError, match="more bytes than decisions need"):
        _ = runs.read(run).decisions


# What opens a file by itself: a name of a function or a method, and what must be its first
# argument's mode.
READERS = {
    "read_bytes", "read_text", "open", "ZipFile", "read_csv", "read_table", "OSFile", "memory_map",
    "from_file", "load_file", "GGUFReader", "loadtxt", "fromfile", "memmap", "FileIO", "copyfile", "copytree",
}  # fmt: skip
# Who may, and why.
EXCEPT = {
    "core/files.py": "the reader itself",
    "backends/counters.py": "counters of the kernel, below /sys",
    "backends/packages.py": "an archive that the reader has opened",
    "extensions/learn/training/model.py": "safetensors maps weights that training has just written",
    "extensions/openvino/exact.py": "gguf maps weights whose digest the reader has computed",
    "report/library.py": "the charting library of an installed package",
    "cli/init.py": "the project that ships",
    "core/process.py": "the null device",
    "core/seals.py": "a key that is new, which only its user may read",
    "cli/parse.py": "pipes that the shell hands over",
}


def direct_reads(source: Path) -> list[str]:
    """The calls in a file that read a file, other than through the reader."""
    found = []
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        words = [
            a.value
            for a in [*node.args, *(k.value for k in node.keywords)]
            if isinstance(a, ast.Constant)
        ]
        writes = any(
            (isinstance(word, str) and word[:1] in ("w", "a", "x")) or word == "r+b"
            for word in words
        )
        given = node.args[0] if node.args else None
        # What is handed bytes or an open file opens none.
        of_bytes = isinstance(given, ast.Call) and getattr(given.func, "id", "") in (
            "BytesIO",
            "StringIO",
        )
        of_file = (
            isinstance(given, ast.Name)
            and name in ("ZipFile", "read_csv")
            and given.id in ("data", "lines")
        )
        ours = (
            name == "open" and isinstance(node.func, ast.Attribute) and not is_path(node.func.value)
        )
        if name in READERS and not (writes or of_bytes or of_file or ours):
            found.append(f"{node.lineno}: {ast.unparse(node)}")
    return found


def is_path(value: ast.expr) -> bool:
    """Whether `open` of this is a path's: pools, backends, logs and archives have one, too."""
    return "pool" not in ast.unparse(value) and ast.unparse(value) not in (
        "archive",
        "module",
        "registration",
        "webbrowser",
    )


@pytest.mark.slow
def test_nothing_reads_a_file_but_through_the_reader() -> None:
    reads = {
        source.relative_to(SOURCES).as_posix(): found
        for source in sorted(SOURCES.rglob("*.py")) if (found := direct_reads(source))
    }  # fmt: skip
    assert {place: found for place, found in reads.items() if place not in EXCEPT} == {}
    assert set(EXCEPT) <= set(reads), "an exception that is none any more"
