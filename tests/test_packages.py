"""Weights out of a wheel: what is fetched, what is compared,
and what wheels and registries refuse.
"""

import io
import os
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from harness.backends import cards, packages
from harness.backends.card import Card, Latency
from harness.backends.packages import Packaged, find_packaged, unpack
from harness.backends.weights import find_weights
from harness.core.errors import UserError
from harness.core.files import sha256_bytes, sha256_file

GGUF = b"GGUF" + bytes(range(256)) * 500
FILE = "some_weights/model.gguf"
CARD = """\
engine = "llama-cpp"
description = "d"
weights = "package:some-weights/some_weights/model.gguf"
revision = "1.0"
sha256 = "{digest}"
licence = "MIT"
[latency]
source = "paper"
basis = "b"
"""


def wheel(folder: Path, files: Mapping[str, bytes], version: str = "1.0") -> Path:
    """A wheel that pip takes, of a package whose code must never run and whose requirement does not
    exist.
    """
    folder.mkdir(exist_ok=True)
    file = folder / f"some_weights-{version}-py3-none-any.whl"
    about = f"some_weights-{version}.dist-info"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
        archive.writestr(
            f"{about}/METADATA",
            f"Metadata-Version: 2.1\nName: some-weights\nVersion: {version}\n"
            "Requires-Dist: no-such-thing-x\n",
        )
        archive.writestr(
            f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        archive.writestr(f"{about}/RECORD", "")
    return file


def project(folder: Path, digest: str = sha256_bytes(GGUF)) -> Path:
    (folder / "models").mkdir(parents=True)
    (folder / "swarmdrive.toml").touch()
    (folder / "models" / "mine.toml").write_text(CARD.format(digest=digest))
    return folder


def harness(where: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A command line in a project, whose pip knows the wheels of the folder `wheels` beside it
    alone.
    """
    known = {
        "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(where.parent / "wheels"), "PIP_CONFIG_FILE": os.devnull,
        "SWARMDRIVE_CACHE": str(where.parent / "cache"),
    }  # fmt: skip
    return subprocess.run(
        [sys.executable, "-P", "-m", "harness", *arguments], cwd=where, capture_output=True, text=True,
        env={**os.environ, **known, **environment}, check=False,
    )  # fmt: skip


def refusal(done: subprocess.CompletedProcess[str]) -> str:
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    assert not list(Path(done.args[0]).glob("*.gguf"))
    return done.stderr


@pytest.mark.slow
def test_one_file_of_a_wheel_is_fetched_once_and_nothing_of_the_package_runs(
    tmp_path: Path,
) -> None:
    where = project(tmp_path / "project")
    (where / "pip.py").write_text("raise SystemExit('this is not pip')")
    runs = b"from pathlib import Path; Path('ran').touch()"
    found = wheel(
        tmp_path / "wheels", {FILE: GGUF, "some_weights/__init__.py": runs, "other.gguf": b"x"}
    )
    done = harness(where, "model", "pull", "mine")
    assert (done.returncode, done.stderr) == (0, "")
    kept = tmp_path / "cache" / "weights" / sha256_bytes(GGUF)[:16] / "model.gguf"
    assert done.stdout == f"mine lies in {kept}, 0 MB; licence: MIT\n"
    assert kept.read_bytes() == GGUF
    assert [path for path in (tmp_path / "cache").rglob("*") if path.is_file()] == [kept]
    found.unlink()
    assert harness(where, "model", "pull", "mine").returncode == 0, (
        "no wheel is asked for a second time"
    )
    assert not (where / "ran").exists()
    assert subprocess.run(
        [sys.executable, "-c", "import some_weights"], capture_output=True
    ).returncode


@pytest.mark.exhaustive
def test_no_command_but_pull_downloads(tmp_path: Path) -> None:
    where = project(tmp_path / "project")
    wheel(tmp_path / "wheels", {FILE: GGUF})
    for command in (("model", "check", "mine"), ("eval", "--model", "mine", "--limit", "1")):
        said = refusal(harness(where, *command))
        assert "package some-weights 1.0 is not fetched yet; run `harness model pull mine`" in said
    assert "no: weights" in harness(where, "model", "list").stdout
    assert "harness model pull mine" in harness(where, "model", "doctor").stdout
    assert not (tmp_path / "cache" / "weights").exists()


@pytest.mark.slow
def test_another_digest_keeps_nothing(tmp_path: Path) -> None:
    where = project(tmp_path / "project", digest="0" * 64)
    wheel(tmp_path / "wheels", {FILE: GGUF})
    said = refusal(harness(where, "model", "pull", "mine"))
    assert f"sha256 {sha256_bytes(GGUF)}, and the card has {'0' * 64}; nothing was kept" in said
    assert not list((tmp_path / "cache").rglob("*.*"))


@pytest.mark.exhaustive
def test_a_wheel_without_the_file_names_those_that_it_has(tmp_path: Path) -> None:
    where = project(tmp_path / "project")
    wheel(tmp_path / "wheels", {"some_weights/other.gguf": GGUF})
    said = refusal(harness(where, "model", "pull", "mine"))
    assert "has no file some_weights/model.gguf; its .gguf files: some_weights/other.gguf" in said


@pytest.mark.exhaustive
def test_a_source_package_is_never_built(tmp_path: Path) -> None:
    where = project(tmp_path / "project")
    (tmp_path / "wheels").mkdir()
    ran = tmp_path / "ran"
    with tarfile.open(tmp_path / "wheels" / "some_weights-1.0.tar.gz", "w:gz") as archive:
        setup = f"from pathlib import Path; Path({str(ran)!r}).touch()".encode()
        for name, data in (
            ("setup.py", setup),
            ("PKG-INFO", b"Name: some-weights\nVersion: 1.0\n"),
        ):
            entry = tarfile.TarInfo(f"some_weights-1.0/{name}")
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    said = refusal(harness(where, "model", "pull", "mine"))
    assert "pip cannot fetch it: Could not find a version" in said
    assert not ran.exists()


@pytest.mark.exhaustive
def test_an_unknown_version_and_a_registry_that_is_not_reached_are_one_line(tmp_path: Path) -> None:
    where = project(tmp_path / "project")
    wheel(tmp_path / "wheels", {FILE: GGUF}, "2.0")
    assert "(from versions: 2.0)" in refusal(harness(where, "model", "pull", "mine"))
    nobody = {
        "PIP_NO_INDEX": "0",
        "PIP_FIND_LINKS": "",
        "PIP_INDEX_URL": "http://127.0.0.1:9/simple",
    }
    said = refusal(harness(where, "model", "pull", "mine", **nobody))
    assert (
        "package some-weights 1.0: pip cannot fetch it: the package registry is not reached; "
        in said
    )


def test_without_pip_it_is_one_line(tmp_path: Path) -> None:
    where = project(tmp_path / "project")
    (tmp_path / "less").mkdir()
    (tmp_path / "less" / "pip.py").write_text("raise ModuleNotFoundError('No module named pip')")
    said = refusal(harness(where, "model", "pull", "mine", PYTHONPATH=str(tmp_path / "less")))
    assert "pip, which fetches it, is not installed here; run `python -m ensurepip`" in said


@pytest.fixture
def wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Packaged:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path / "cache"))
    return Packaged("some-weights", "1.0", FILE, sha256_bytes(GGUF), "mine")


def refused(made: Path, wanted: Packaged) -> str:
    with pytest.raises(UserError) as caught:
        unpack(made, wanted)
    assert str(caught.value).isprintable()
    assert not [path for path in wanted.place.parent.rglob("*") if path.is_file()]
    return str(caught.value)


def test_a_broken_or_bent_wheel_is_one_line_and_keeps_nothing(
    wanted: Packaged, tmp_path: Path
) -> None:
    whole = wheel(tmp_path / "whole", {FILE: GGUF}).read_bytes()
    at = whole.index(GGUF[:4]) if GGUF[:4] in whole else 200
    bent = {
        "empty": b"",
        "no zip": b"MZ" * 500,
        "cut off": whole[: len(whole) // 2],
        "other bytes": whole[:at]
        + bytes(byte ^ 255 for byte in whole[at : at + 64])
        + whole[at + 64 :],
        "encrypted": whole.replace(
            b"PK\x01\x02\x14\x03\x14\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01"
        ),
        "unknown method": whole.replace(b"\x08\x00", b"\x63\x00"),
    }
    for name, data in bent.items():
        made = tmp_path / "bent.whl"
        made.write_bytes(data)
        assert data != whole, name
        assert "its wheel cannot be read (" in refused(made, wanted), name


def test_what_states_a_size_beyond_the_limit_is_not_unpacked(
    wanted: Packaged, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packages, "MOST_BYTES", 1000)
    assert f"{FILE} has 0.0 GB; allowed: " in refused(wheel(tmp_path / "w", {FILE: GGUF}), wanted)


def test_a_wheel_that_holds_more_than_it_states_is_refused(
    wanted: Packaged, tmp_path: Path
) -> None:
    made = wheel(tmp_path / "w", {FILE: GGUF})
    size = len(GGUF).to_bytes(4, "little")
    made.write_bytes(made.read_bytes().replace(size, (100).to_bytes(4, "little")))
    assert "its wheel cannot be read" in refused(made, wanted)


def test_a_folder_that_cannot_be_written_is_one_line(wanted: Packaged, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file")
    made = wheel(tmp_path / "w", {FILE: GGUF})
    with pytest.raises(UserError, match=r"cannot write .*; SWARMDRIVE_CACHE names another folder"):
        unpack(made, wanted)


def card(**changes: object) -> Card:
    latency = Latency("paper", None, "b")
    made = Card(
        "mine", "llama-cpp", "d", latency, f"package:a/{FILE}", None, "1.0", sha256_bytes(GGUF)
    )
    return replace(made, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "weights",
    ["package:", "package:a", "package:a/", "package:/m.gguf", "package:-r/m.gguf", 
        "package:a b/m.gguf",
     "package:a/../m.gguf", "package:a//m.gguf", "package:a/m.bin", "package:a/b\\m.gguf",
     "package:a/\nm.gguf", "package:a @ http:/m.gguf"],
)  # fmt: skip
def test_a_card_names_a_package_and_a_file_and_nothing_else(weights: str) -> None:
    for look in (find_packaged, find_weights):
        with pytest.raises(UserError, match=r"allowed: package:NAME/FILE"):
            look(card(weights=weights))


def test_a_card_names_a_version_and_a_digest() -> None:
    assert find_packaged(card()) == Packaged("a", "1.0", FILE, sha256_bytes(GGUF), "mine")
    for revision in (None, "main", "1.0 --index-url=x", "1,<2"):
        with pytest.raises(UserError, match="needs revision = a version of the package"):
            find_packaged(card(revision=revision))
    with pytest.raises(UserError, match="needs the sha256 of the file"):
        find_packaged(card(sha256=None))
    assert find_packaged(card(weights="Qwen/Qwen3-4B")) is None


@pytest.mark.exhaustive
def test_the_published_model_is_fetched_from_the_registry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path))
    stated = cards.load("smollm2-135m")
    wanted = find_packaged(stated)
    try:
        where = packages.fetch(wanted)
    except UserError as error:
        if "pip cannot fetch it" in str(error) or "is not installed here" in str(error):
            pytest.skip(str(error))
        raise
    assert sha256_file(where) == stated.sha256
