"""Files that take another's place, and working folders:
one process at a time, no link, no remains.
"""

import os
import subprocess
import sys
from pathlib import Path
from threading import Thread

import pyarrow as pa
import pytest
from pyarrow import csv as pacsv

from harness.core import work
from harness.core.errors import UserError
from harness.core.files import alone, making, replacing, write_whole

BEGUN = work.WorkStart(settings={"seed": 1})


def test_what_a_killed_process_left_half_written_goes_and_what_another_writes_stays(
    tmp_path: Path,
) -> None:
    left, written = (tmp_path / f".table.csv.{pid}.part" for pid in (99998, 99999))
    left.write_text("half")
    written.write_text("half")
    with alone(written):
        write_whole(tmp_path / "table.csv", "whole")
    assert {p.name for p in tmp_path.iterdir()} == {"table.csv", written.name}
    assert written.read_text() == "half"


def test_a_folder_that_a_killed_process_left_half_made_goes_and_what_another_makes_stays(
    tmp_path: Path,
) -> None:
    left, made, theirs = (tmp_path / f".site.{pid}.part" for pid in (99998, 99999, "old"))
    for folder in (left, made, theirs):
        (folder / "data").mkdir(parents=True)
    with alone(made), making(tmp_path / "site") as part, making(tmp_path / "other"):
        (part / "page").write_text("whole")
    assert {p.name for p in tmp_path.iterdir()} == {"site", "other", made.name, theirs.name}
    assert (made / "data").is_dir()
    assert (tmp_path / "site/page").read_text() == "whole"


def test_no_link_is_followed_where_a_file_is_written(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    theirs.write_text("theirs")
    (tmp_path / f".mine.{os.getpid()}.part").symlink_to(theirs)
    write_whole(tmp_path / "mine", "mine")
    (tmp_path / "lock").symlink_to(theirs)
    with pytest.raises(OSError, match="symbolic link"), alone(tmp_path / "lock"):
        pass
    assert (theirs.read_text(), (tmp_path / "mine").read_text()) == ("theirs", "mine")


@pytest.mark.parametrize("name", ["lock", "answers.jsonl", "."])
def test_work_with_a_link_in_it_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    inside = tmp_path / "out" / ".work" / name
    inside.parent.mkdir(parents=True)
    inside.symlink_to(tmp_path / "elsewhere")
    with (
        pytest.raises(UserError, match="is a link, which no command makes"),
        work.working(tmp_path / "out", BEGUN),
    ):
        pass
    assert not list((tmp_path / "elsewhere").iterdir())


def test_work_with_a_pipe_in_it_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "out" / ".work"
    folder.mkdir(parents=True)
    os.mkfifo(folder / "costs.jsonl")
    with (
        pytest.raises(UserError, match=r"costs\.jsonl is a pipe or device, which no command makes"),
        work.working(tmp_path / "out", BEGUN),
    ):
        pass


def fail(kept: Path | None) -> None:
    if kept:
        kept.write_text("128 answers")
    raise UserError("the engine died")


def test_an_error_before_anything_is_done_leaves_nothing_and_one_after_keeps_it(
    tmp_path: Path,
) -> None:
    for done in (False, True):
        out = tmp_path / "reports" / "run"
        with pytest.raises(UserError, match="the engine died"), work.working(out, BEGUN) as place:
            fail(place / "answers.jsonl" if done else None)
        assert out.parent.exists() == done
    assert work.start_of(out, work.WorkStart) == BEGUN
    with work.working(out, BEGUN) as place:
        assert (place / "answers.jsonl").read_text() == "128 answers"


def test_what_another_process_began_since_is_not_touched(tmp_path: Path) -> None:
    with work.working(tmp_path, work.WorkStart(settings={"seed": 2})):
        pass
    with (
        pytest.raises(UserError, match="being written by another process"),
        work.working(tmp_path, BEGUN),
    ):
        pass


def test_who_waited_until_another_had_finished_writes_nothing_over_it(tmp_path: Path) -> None:
    with work.working(tmp_path, BEGUN, "run.json"):
        (tmp_path / "run.json").write_text("finished")
    with (
        pytest.raises(UserError, match="being written by another process"),
        work.working(tmp_path, BEGUN, "run.json"),
    ):
        (tmp_path / "run.json").write_text("again")
    assert (tmp_path / "run.json").read_text() == "finished"


def test_tidying_up_leaves_what_another_process_writes(tmp_path: Path) -> None:
    left, written = (tmp_path / f".report.html.{pid}.part" for pid in (99998, 99999))
    with work.working(tmp_path, BEGUN), alone(written):
        left.write_text("half")
        work.tidy(tmp_path)
    assert list(tmp_path.iterdir()) == [written]


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "3", '{"settings": 3}', "{}", '{"settings": {"a": ' + "[" * 100_000, "\xff"],
)
def test_a_damaged_beginning_is_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / ".work").mkdir()
    (tmp_path / ".work" / "config.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(
        UserError, match=r"config\.json is damaged .*; delete .* and start again"
    ) as raised:
        work.start_of(tmp_path, work.WorkStart)
    assert str(raised.value).isprintable()


def test_settings_that_differ_are_named(tmp_path: Path) -> None:
    work.same(tmp_path, {"seed": (1, 2)}, {"seed": [1, 2]})
    with pytest.raises(
        UserError, match="was begun with another seed, limit; repeat its settings"
    ) as raised:
        work.same(tmp_path, {"seed": 1, "limit": 3}, {"seed": 2})
    assert "repeat its settings (seed 2), delete it" in str(raised.value)
    now = {"channels": {"mine": {"loss": 0.1}, "6g": {}}, "kept": {"calibrations": {"cz": "a"}}}
    before = {"channels": {"mine": {"loss": 0.2}, "6g": {}}, "kept": {"calibrations": {"cz": "b"}}}
    with pytest.raises(UserError, match="another channels/mine/loss, kept/calibrations/cz; repeat"):
        work.same(tmp_path, now, before)
    stated = {"ask": "all", "ties": "fir\nst", "identity": "f" * 64, "dtype": None, "tags": []}
    with pytest.raises(UserError, match=r"settings \(ask all, ties fir\\nst\), delete") as raised:
        work.same(tmp_path, {}, stated)
    assert str(raised.value).isprintable()


PARENT = """
import sys, time
from pathlib import Path
from harness.core.parallel import spread
def work(folder):
    import os
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(600)
spread(work, sys.argv[1:] * 2, 2, lambda done: None)
"""


@pytest.mark.slow
def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT, str(tmp_path)])
    while len(workers := list(tmp_path.iterdir())) < 2:
        assert parent.poll() is None
    parent.kill()
    parent.wait()
    ends = [Thread(target=_until_gone, args=(int(worker.name),)) for worker in workers]
    for end in ends:
        end.start()
        end.join(30)
        assert not end.is_alive(), "a worker is still there"


def _until_gone(pid: int) -> None:
    while Path(f"/proc/{pid}").exists():
        pass


def test_a_table_may_lie_in_a_folder_whose_name_looks_like_an_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as `6g:loss=0/decisions.parquet`, relative, as it is typed."""
    monkeypatch.chdir(tmp_path)
    with (
        replacing(Path("6g:loss=0/table.csv")) as part,
        pacsv.CSVWriter(part, pa.schema({"n": pa.int64()})),
    ):
        pass
    assert Path("6g:loss=0/table.csv").read_text() == '"n"\n'


def test_a_file_is_whole_or_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    with pytest.raises(UserError), replacing(tmp_path / "a") as part:
        fail(part)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a", "old")]
