"""What is kept between runs: it saves time, decides nothing, and nobody's else is taken."""

from importlib.metadata import version
from pathlib import Path

import pytest
import vl_convert
from harness.evaluate.success import reference_success

from harness.core import kept
from harness.dataset.load import Dataset
from harness.evaluate import success
from harness.report import library
from harness.world.drivers import DRIVERS


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


def _unmade(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that takes long may be done again."""

    def again(*args: object) -> None:
        raise AssertionError("it was kept")

    monkeypatch.setattr(vl_convert, "javascript_bundle", again)
    monkeypatch.setattr(success, "driver_choices", again)


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


def test_reference_drivers_are_played_once_for_a_dataset_and_a_program(
    small: Dataset, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played = reference_success(small)
    assert list(played) == list(DRIVERS)
    with monkeypatch.context() as patch:
        _unmade(patch)
        assert reference_success(small) == played
        patch.setattr(kept, "code_sha256", lambda *patterns: "another planner")
        with pytest.raises(AssertionError, match="it was kept"):
            reference_success(small)


@pytest.mark.parametrize(
    "said", [b"", b"\xff", b"[" * 100_000, b"[]", b"null", b'{"brake": 1}', b'{"%s": NaN}', b'{"%s": 2}']
)
def test_broken_shares_are_played_again(small: Dataset, folder: Path, said: bytes) -> None:
    played = reference_success(small)
    [file] = folder.iterdir()
    if b"%s" in said:
        said = b'{"brake": 0, "cruise": 0, "local-view": 0, ' + said.replace(b"%s", b"full-view")[1:]
    file.write_bytes(said)
    assert reference_success(small) == played
    assert file.read_bytes() != said


def test_a_folder_that_cannot_be_written_keeps_nothing(folder: Path) -> None:
    folder.write_text("a file")
    kept.keep("name", b"data")
    assert kept.recall("name") is None
