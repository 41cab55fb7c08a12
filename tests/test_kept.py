"""What is kept between runs: it saves time, decides nothing, and nobody's else is taken."""

from importlib.metadata import version
from pathlib import Path

import pytest
import vl_convert

from harness.core import kept
from harness.report import library


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


def _unmade(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that takes long may be done again."""

    def again(*args: object) -> None:
        raise AssertionError("it was kept")

    monkeypatch.setattr(vl_convert, "javascript_bundle", again)


def test_the_bundle_is_made_once_and_a_changed_one_is_never_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A new vl-convert needs the digest of its bundle in BUNDLES, or every page costs a second more.
    assert version("vl-convert-python") in library.BUNDLES
    made = library.vega.__wrapped__()
    [file] = folder.iterdir()
    file.write_bytes(file.read_bytes() + b"alert(1)")
    assert library.vega.__wrapped__() == made
    with monkeypatch.context() as patch:
        _unmade(patch)
        assert library.vega.__wrapped__() == made


def test_a_bundle_of_a_version_that_is_not_known_is_made_and_not_kept(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vl_convert, "javascript_bundle", lambda snippet: "other")
    assert library.vega.__wrapped__() == "(()=>{other})();"
    monkeypatch.setattr(library, "BUNDLES", {})
    assert library.vega.__wrapped__() == "(()=>{other})();"
    assert not folder.exists()


def test_a_folder_that_cannot_be_written_keeps_nothing(folder: Path) -> None:
    folder.write_text("a file")
    kept.keep("name", b"data")
    assert kept.recall("name") is None
