"""Names that a terminal, a page or a record does not carry as they are."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from harness.backends.base import Completion, Request, failed
from harness.cli.init import command as init
from harness.core import resources
from harness.core.errors import UserError, unknown
from harness.core.files import making, write_whole
from harness.core.work import WorkStart, start_of
from harness.dataset.load import find
from harness.runs import settings
from harness.runs.folder import read
from harness.runs.listing import runs
from harness.runs.settings import FrozenSettings
from harness.studies.study import refuse_taken

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
        lambda: start_of(tmp_path / name, WorkStart),
        lambda: read(tmp_path / name),
        lambda: runs(tmp_path / name),
        lambda: settings.read(tmp_path / name, FrozenSettings, {}),
        lambda: write_whole(tmp_path / f"{name}.html", ""),
        lambda: making(tmp_path / f"{name}.d").__enter__(),
    ):
        with pytest.raises(UserError, match=REFUSED) as error:
            refused()
        assert name not in str(error.value)
    assert name not in str(unknown("model", "a", [name, f"{name}b"]))
    above = tmp_path / f"{name} above" / "runs"  # folders that would be made on the way
    for refused in (
        lambda: start_of(above / "x", WorkStart),
        lambda: refuse_taken(above / "x", "sweep"),
        lambda: write_whole(above / "x.html", ""),
        lambda: making(above / "x.d").__enter__(),
        lambda: init(above / "x"),
    ):
        with pytest.raises(UserError, match=REFUSED) as error:
            refused()
        assert name not in str(error.value)
    assert {path.name for path in tmp_path.iterdir()} == {"swarmdrive.toml", "models", name}
    write_whole(tmp_path / name / "x.html", "")  # a folder that is there, such as one's own


def test_a_name_that_looks_like_several_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board shows a model, its prompt and its answer mode with a dot between them."""
    monkeypatch.chdir(tmp_path)
    Path("swarmdrive.toml").touch()
    Path("models").mkdir()
    Path("models/m · v2 · json.toml").touch()
    with pytest.raises(UserError, match="has ` · `, which stands between names"):
        resources.find("models", "m · v2 · json.toml")


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
    for typed in (
        ("eval", "--model", name),
        ("run", "ls", name),
        ("prompt", "parse", f"IDLE {name}"),
    ):
        code, out, said = harness(*typed)
        assert (code, out, said.count("\n")) == (2, "", 1)
        assert "a\\udcffb` is no UTF-8, as all that is kept is; rename what it names" in said
    assert {path.name for path in tmp_path.iterdir()} == {"swarmdrive.toml", "models"}


@pytest.mark.parametrize(
    ("said", "kept"),
    [
        ("\ud800", "?"),
        ("a\udc00b é", "a?b é"),
        ("😀 \ud83d", "😀 ?"),
        ("whole é", "whole é"),
        ("", ""),
    ],
)
def test_no_completion_has_a_lone_surrogate(said: str, kept: str) -> None:
    """It is legal JSON, and no file can hold it; whichever model said it, and whoever asked."""
    done = Completion("a", said, None, 1, "stop", 0.0, 1, said)
    assert (done.text, done.error) == (kept, kept)
    assert replace(failed(Request("a", "ego", (), ("IDLE",), 1), said)).error == kept


@pytest.mark.parametrize(
    ("kind", "name", "said"),
    [
        (
            "model",
            "name-77x",
            "unknown model 'name-77x'; did you mean 'name-77'? known: name-77, name-",
        ),
        ("model", "?", "unknown model '?'; known: name-"),
        ("metric", "name-7", "unknown metric 'name-7'; did you mean one of name-7, name-70, "),
    ],
)
def test_of_many_names_a_message_lists_the_nearest_and_what_lists_all(
    kind: str, name: str, said: str
) -> None:
    words = str(unknown(kind, name, [f"name-{n}" for n in range(100)]))
    assert words.startswith(said)
    assert len(words) < 300
    assert " and 94 more" in words
    assert ("; `harness model list` lists all" in words) == (kind == "model")
    assert str(unknown(kind, "x", "abc")) == f"unknown {kind} 'x'; known: a, b, c"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "code"),
    [
        (("--letters", "raw"), 2), (("--letters", "raw", "--answer", "constrained"), 2),
        (("--letters", "raw", "--helper-answer", "json"), 2),
        (("--letters", "raw", "--model", "sparrow-robot", "--answer", "decision", "--dry-run"), 0),
    ],
)  # fmt: skip
def test_how_letters_are_read_is_said_where_none_are(
    typed: tuple[str, ...], code: int, two_path: Path, harness: Typed
) -> None:
    ended, _, said = harness(
        "eval", "--model", "smollm2-135m", "--dataset", two_path, "--limit", "1", *typed
    )
    assert ended == code, said
    assert ("--letters raw: no letters are read of an answer in" in said) == (code == 2)
