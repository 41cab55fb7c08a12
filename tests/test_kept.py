"""What is kept between runs: it saves time, and decides nothing."""

from pathlib import Path

import pytest

from harness.core import kept


def test_what_is_kept_is_there_again_until_it_cannot_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path / "kept"))
    kept.keep("name", b"data")
    assert kept.recall("name") == b"data"
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path / "kept" / "name"))
    kept.keep("name", b"data")
    assert kept.recall("name") is None
