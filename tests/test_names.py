"""Names that a terminal, a page or a record does not carry as they are."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from harness.backends.base import Completion, Request, failed
from harness.core import resources
from harness.core.errors import UserError
from harness.core.files import making, write_whole
from harness.core.work import WorkStart, begun
from harness.dataset.load import find

Typed = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parents[1]
HIDDEN = ["a\tb", "a\u202eb", "a\x1b[31mb", "a\nb", "a\u2066b"]
REFUSED = "has characters that nothing can show; "


@pytest.mark.parametrize("name", HIDDEN, ids=ascii)
def test_a_name_that_nothing_can_show_is_refused_where_it_is_read_and_where_it_is_made(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("swarmdrive.toml").touch()
    Path("models").mkdir()
    Path("models", f"{name}.toml").touch()
    (tmp_path / name).mkdir()
    for refused in (
        lambda: resources.find("models", f"{name}.toml"),
        lambda: find(name),
        lambda: begun(tmp_path / name, WorkStart),
        lambda: write_whole(tmp_path / f"{name}.html", ""),
        lambda: making(tmp_path / f"{name}.d").__enter__(),
    ):
        with pytest.raises(UserError, match=REFUSED) as error:
            refused()
        assert name not in str(error.value)
    assert {path.name for path in tmp_path.iterdir()} == {"swarmdrive.toml", "models", name}


@pytest.mark.parametrize("name", ["Größe 1", "中文", "a.b-c_d", "😀"])
def test_a_name_of_any_writing_is_taken(name: str, tmp_path: Path) -> None:
    write_whole(tmp_path / name, "x")
    assert (tmp_path / name).read_text() == "x"


@pytest.mark.slow
def test_what_is_typed_in_no_utf_8_is_refused_in_one_line(harness: Typed, tmp_path: Path) -> None:
    name = os.fsdecode(b"a\xffb")
    Path("swarmdrive.toml").touch()
    Path("models").mkdir()
    shutil.copy(ROOT / "models/proxy.toml", f"models/{name}.toml")
    for typed in (("eval", "--model", name), ("run", "ls", name), ("prompt", "parse", f"IDLE {name}")):
        code, out, said = harness(*typed)
        assert (code, out, said.count("\n")) == (2, "", 1)
        assert "a\\udcffb` is no UTF-8, as all that is kept is; rename what it names" in said
    assert {path.name for path in tmp_path.iterdir()} == {"swarmdrive.toml", "models"}


@pytest.mark.parametrize(
    ("said", "kept"),
    [("\ud800", "?"), ("a\udc00b é", "a?b é"), ("😀 \ud83d", "😀 ?"), ("whole é", "whole é"), ("", "")],
)
def test_no_completion_has_a_lone_surrogate(said: str, kept: str) -> None:
    """It is legal JSON, and no file can hold it; whichever model said it, and whoever asked."""
    done = Completion("a", said, None, 1, "stop", 0.0, 1, said)
    assert (done.text, done.error) == (kept, kept)
    assert replace(failed(Request("a", "ego", (), ("IDLE",), 1), said)).error == kept
