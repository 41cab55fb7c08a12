"""The canonical text of a value, whose bytes digests and keys are made of;
and files that are read once.
"""

import math
import os
import random
import socket
import subprocess
import sys
from contextlib import nullcontext
from datetime import date
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile

import pyarrow as pa
import pytest

from harness.core.errors import UserError, printable
from harness.core.files import (
    Refused,
    alone,
    appending,
    canonical_json,
    digest,
    folder_in,
    is_there,
    read_once,
    refuse_bomb,
    replacing,
    write_whole,
)
from harness.core.junit import Case, junit
from harness.runs.decisions import arrow_file


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({"b": [1, True, None], "a": {"é": 0.1}}, '{"a":{"é":0.1},"b":[1,true,null]}'),
        ([1e-5, 1e-4, 1e16, -0.0, 2**64], "[1e-05,0.0001,1e+16,-0.0,18446744073709551616]"),
        ({"\ue000": 1, "\U0001f600": 2, "": 3}, '{"":3,"\ue000":1,"\U0001f600":2}'),
        ('\x7f\u2028\x00\x1f\b\n"\\/', '"\x7f\u2028\\u0000\\u001f\\b\\n\\"\\\\/"'),
        ({10: 1, 9: 2}, '{"9":2,"10":1}'),
        ((1, (2,)), "[1,[2]]"),
    ],
)  # fmt: skip
def test_a_value_has_one_text(value: Any, text: str) -> None:
    assert canonical_json(value) == text


def test_the_digest_is_that_of_the_text_in_utf_8() -> None:
    assert (
        digest({"b": "é", "a": 1})
        == "09ad9fd2fb648cb2f62141215828ea00a62c299db05d20aa9ade2f527a301cc6"
    )
    with pytest.raises(ValueError, match="surrogates not allowed"):
        digest("\ud83d")


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_refused_however_deep_it_stands(number: float) -> None:
    for value in (number, [1.0, number], {"a": [{"b": (None, number)}]}):
        with pytest.raises(ValueError, match="not JSON compliant"):
            canonical_json(value)


@pytest.mark.parametrize("value", [b"bytes", {1, 2}, date(2026, 1, 1), 1j, object()])
def test_a_type_that_json_lacks_is_refused(value: object) -> None:
    with pytest.raises(TypeError, match="not JSON serializable"):
        canonical_json({"in": [value]})


def test_a_file_is_read_again_only_after_it_was_written_again(tmp_path: Path) -> None:
    reads: list[Path] = []

    @read_once
    def text(path: Path) -> str:
        reads.append(path)
        return path.read_text()

    file = tmp_path / "x.toml"
    file.write_text("old")
    assert [text(file), text(file), len(reads)] == ["old", "old", 1]
    file.write_text("new")
    os.utime(file, ns=(0, 1))
    assert [text(file), text(file), len(reads)] == ["new", "new", 2]
    file.unlink()
    for _ in range(2):  # that it is not there is read every time
        with pytest.raises(FileNotFoundError):
            text(file)
    assert len(reads) == 4


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a /proc, as Linux has")
@pytest.mark.parametrize("path", ["/proc/x.zip", "/proc/x/y.zip"])
def test_where_no_file_can_be_made_is_no_missing_file(path: str) -> None:
    """A missing file is a bug, with a traceback; this is one line to the user."""
    with pytest.raises(PermissionError, match="no file can be made there") as refused:
        write_whole(Path(path), "x")
    assert refused.value.filename == path


@pytest.mark.parametrize("content", [b"", b"scene,value\n", bytes(10**6)])
def test_arrow_holds_a_file_in_memory_of_its_own(content: bytes, tmp_path: Path) -> None:
    """Its threads need the interpreter to let go of Python's,
    and abort the process as that ends.
    """
    (tmp_path / "file").write_bytes(content)
    before = pa.total_allocated_bytes()
    with arrow_file(tmp_path / "file") as file:
        assert pa.total_allocated_bytes() - before >= len(content)
        assert file.read() == content


def archive(times: int, **members: bytes) -> bytes:
    """Members, as often as that in the list of files, which all share one place."""
    data = BytesIO()
    with ZipFile(data, "w", ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
        file.filelist *= times
    return data.getvalue()


@pytest.mark.parametrize(
    ("data", "most", "refused"),
    [
        (archive(1, a=bytes(10**6)), math.inf, False),
        (archive(1, a=bytes(4 * 10**6)), math.inf, True),
        (archive(1, a=random.Random(0).randbytes(2 * 10**6)), math.inf, False),
        (archive(1, a=random.Random(0).randbytes(2 * 10**6)), 10**6, True),
        (archive(500, a=random.Random(0).randbytes(2 * 10**5)), math.inf, True),
    ],
    ids=["small", "zeros", "packs badly", "too large", "one place"],
)
def test_an_archive_that_unpacks_to_too_much_is_refused_before(
    data: bytes, most: float, refused: bool
) -> None:
    with ZipFile(BytesIO(data)) as file:
        file.read = file.open = lambda *_: pytest.fail("unpacked")  # type: ignore
        with pytest.raises(BadZipFile, match="would unpack to") if refused else nullcontext():
            refuse_bomb(file, len(data), most)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a /dev/full, as Linux has")
def test_a_full_disk_names_the_file_that_is_written(tmp_path: Path) -> None:
    full_at = pytest.raises(OSError, match="No space left")
    with full_at as full, replacing(tmp_path / "run.json"), open("/dev/full", "w") as file:
        file.write("x")
    assert full.value.filename == str(tmp_path / "run.json")
    with (
        pytest.raises(OSError, match="No space left") as full,
        appending(tmp_path / "answers.jsonl"),
        open("/dev/full", "w") as file,
    ):
        file.write("x")
    assert full.value.filename == str(tmp_path / "answers.jsonl")
    assert {path.name for path in tmp_path.iterdir()} == {"answers.jsonl"}


def test_a_file_that_grows_too_large_is_named(tmp_path: Path) -> None:
    code = (
        "import resource, signal, sys\nfrom pathlib import Path\nfrom harness.core.files import "
        "write_whole\nsignal.signal(signal.SIGXFSZ, "
        "signal.SIG_IGN)\nresource.setrlimit(resource.RLIMIT_FSIZE, (10, 10))\ntry:\n    "
        "write_whole(Path(sys.argv[1]), 'x' * 99)\nexcept OSError as error:\n    "
        "print(error.filename)\n"
    )
    out = tmp_path / "page.html"
    said = subprocess.run(
        [sys.executable, "-c", code, out], capture_output=True, text=True, check=True
    )
    assert (said.stdout, out.exists()) == (f"{out}\n", False)


@pytest.mark.parametrize("text", ["\x00\x1b", "\ufffe\ud800", "a & b <c>"], ids=ascii)
def test_every_text_of_junit_is_xml(text: str) -> None:
    cases = [Case(text, text), Case(text, text, failure=text), Case(text, text, error=text)]
    suite = ElementTree.fromstring(junit(text, cases))
    assert suite.attrib["name"] == printable(text)
    assert [case.attrib["name"] for case in suite] == [printable(text)] * 3


def test_a_device_or_a_pipe_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    refused = pytest.raises(Refused, match="a pipe or a device, and is not replaced")
    with refused, replacing(tmp_path / "pipe"):
        pass
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("kind", ["link to a file", "link to nothing", "pipe", "socket"])
def test_nothing_is_appended_to_what_is_no_file(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs, file = tmp_path / "theirs", tmp_path / "answers.jsonl"
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "socket":
        monkeypatch.chdir(tmp_path)  # a socket's path is a short one
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(file.name)
    else:
        file.symlink_to(theirs)
    if kind == "link to a file":
        theirs.write_text("theirs")
    else:
        with pytest.raises(Refused, match=r"it is no file, so nothing is appended to it"):
            is_there(file)
    with pytest.raises(Refused), appending(file):
        pass
    with pytest.raises(OSError), alone(file):  # noqa: PT011
        pass
    assert kind == "link to a file" or not theirs.exists()
    assert not theirs.exists() or theirs.read_text() == "theirs"


def test_a_file_that_is_appended_to_is_read_and_no_program(tmp_path: Path) -> None:
    assert not is_there(tmp_path / "answers.jsonl")
    with appending(tmp_path / "answers.jsonl") as file:
        file.write(b"1")
    assert is_there(tmp_path / "answers.jsonl")
    assert not os.access(tmp_path / "answers.jsonl", os.X_OK)


def test_a_folder_in_a_run_is_no_link(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "trust").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="trust is a link; delete it, or name another folder"):
        folder_in(tmp_path, "trust")
    assert folder_in(tmp_path, "schedules") == tmp_path / "schedules"
