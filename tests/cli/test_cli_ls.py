"""`harness run ls`: what a folder of runs holds."""

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from evaluating import live_spec_of, run, spec_of

from harness import cli, studies
from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.core.extensions import STUDIES, extensions
from harness.core.extensions import studies as kinds_of_study
from harness.core.plugins import entries
from harness.dataset.load import Dataset
from harness.report.words import compared
from harness.runs import listing
from harness.runs.folder import read
from harness.runs.listing import runs
from harness.studies.study import refuse_taken

Said = tuple[int, str, str]


def type_in(*args: str | Path) -> None:
    kept, sys.argv = sys.argv, ["harness", *map(str, args)]
    try:
        with pytest.raises(SystemExit) as ended:
            cli.main()
    finally:
        sys.argv = kept
    assert not ended.value.code


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, small: Dataset) -> Path:
    """A frozen run with a sweep in it, and a live one."""
    folder = tmp_path_factory.mktemp("made")
    run(spec_of(small), folder / "frozen")
    type_in("sweep", folder / "frozen", "--over", "tau", "--grid", "0.2,0.9")
    run(live_spec_of(points=(POINTS["6g"],), seeds=(0,), episodes=1), folder / "live")
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "reports")
    return tmp_path / "reports"


def changed(file: Path, **members: object) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **members}))


def test_it_lists_frozen_live_and_sweep_newest_first(folder: Path) -> None:
    changed(folder / "frozen/run.json", created="2026-01-02T03:04:05+00:00")
    changed(folder / "live/run.json", created="2026-01-02T03:04:05+02:00")
    found = runs(folder)
    assert [(one.name, one.kind, one.state) for one in found] == [
        ("frozen/sweep-tau", "sweep", "finished"), ("frozen", "eval", "finished"),
        ("live", "drive", "finished"),
    ]  # fmt: skip
    assert [(one.model, one.prompt, one.answer) for one in found] == [
        ("proxy · v2 · json", None, None), ("proxy", "v2", "json"), ("proxy", "v2", "json"),
    ]  # fmt: skip


def test_success_is_that_of_the_condition_in_the_headline_over_episodes(folder: Path) -> None:
    [frozen] = [one for one in runs(folder) if one.name == "frozen"]
    lines = (folder / "frozen/summary.csv").read_text().splitlines()
    rates = [
        line.split(",")
        for line in lines
        if ",balanced_success_rate," in line and line.endswith(",episodes")
    ]
    [best] = [row for row in rates if row[4] == compared(read(folder / "frozen"))[0]]
    assert len(rates) == 3
    assert (frozen.condition, frozen.success, frozen.low, frozen.high) == (
        best[4],
        *map(float, best[6:9]),
    )


def test_a_condition_that_the_page_warns_of_is_the_best_in_no_list(folder: Path) -> None:
    summary = folder / "frozen/summary.csv"
    [best] = [one.condition for one in runs(folder) if one.name == "frozen"]
    lines = summary.read_text().splitlines(keepends=True)
    warned = [row.split(",") for row in lines if f",{best},off_lag_rate," in row]
    assert warned
    for row in warned:
        lines[lines.index(",".join(row))] = ",".join([*row[:6], "0.9", *row[7:]])
    summary.write_text("".join(lines))
    [frozen] = [one for one in runs(folder) if one.name == "frozen"]
    assert frozen.condition == compared(read(folder / "frozen"))[0] != best


def test_people_read_it_in_eighty_columns(harness: Callable[..., Said], folder: Path) -> None:
    (folder / "frozen").rename(folder / ("long-" * 40))
    changed(folder / "live/run.json", model={"name": "\x1b[31mred" * 30})
    code, out, err = harness("run", "ls")
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    assert "\x1b" not in out
    assert f"\nlive{'':<60}" in f"\n{out}"
    assert "  eval  proxy · v2 · json" in out


def test_json_has_every_field_whole(harness: Callable[..., Said], folder: Path) -> None:
    code, out, _ = harness("run", "ls", folder, "--json")
    told = {one["name"]: one for one in json.loads(out, parse_constant=pytest.fail)}
    assert code == 0
    assert list(told["live"]) == [
        "name", "kind", "state", "date", "why", "model", "prompt", "answer", "tags", "condition", "success",
        "low", "high", "unread", "metric", "pick",
    ]  # fmt: skip
    assert told["live"]["date"] == json.loads((folder / "live/run.json").read_text())["created"]


def test_an_unfinished_run_says_that_the_same_command_goes_on(
    harness: Callable[..., Said], folder: Path
) -> None:
    manifest = json.loads((folder / "live/run.json").read_text())
    shutil.rmtree(folder / "live")
    (folder / "live/.work").mkdir(parents=True)
    begun = {"created": manifest["created"], "settings": manifest, "identity": "", "tags": []}
    (folder / "live/.work/config.json").write_text(json.dumps(begun))
    [one] = [one for one in runs(folder) if one.name == "live"]
    assert (one.kind, one.state, one.why, one.model) == (
        "drive",
        "unfinished",
        "the same command continues it",
        "proxy",
    )
    assert "unfinished: the same command continues it\n" in harness("run", "ls", folder)[1]


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("run.json", None),
        ("run.json", ""),
        ("run.json", "[]"),
        ("run.json", "[" * 100_000),
        ("run.json", '{"format": "swarmdrive-run/9"}'),
        ("run.json", '{"format": ["swarmdrive-run/2"]}'),
        ("run.json", '{"format": "swarmdrive-run/2", "world": {"kind": "eval"}}'),
        (
            "run.json",
            '{"format": "swarmdrive-run/2", "world": {"kind": "frozen"}, '
            '"created": "0001-01-01T00:00:00+14:00"}',
        ),
        ("run.json", "\udcff"),
        ("summary.csv", None),
        ("summary.csv", ""),
        (
            "summary.csv",
            "condition,metric,value,ci_low,ci_high,interval\n6g,success_rate,x,,,episodes\n",
        ),
        (
            "summary.csv",
            "condition,metric,value,ci_low,ci_high,interval\n6g,success_rate,-5,,,episodes\n",
        ),
        (
            "summary.csv",
            "condition,metric,value,ci_low,ci_high,interval\n6g,success_rate,.9,.8,2,episodes\n",
        ),
        ("summary.csv", "\udcff"),
    ],
)
def test_a_broken_run_names_the_file_at_fault(folder: Path, file: str, text: str | None) -> None:
    if text is None:
        (folder / "frozen" / file).unlink()
    else:
        (folder / "frozen" / file).write_bytes(text.encode("utf-8", "surrogateescape"))
    [one] = [one for one in runs(folder) if one.name == "frozen"]
    assert (one.state, one.why, one.success) == ("broken", file, None)


@pytest.mark.parametrize("old", ["swarmdrive-run/1", "swarmdrive-drive/1"])
def test_a_run_of_an_older_format_is_broken_and_says_why(
    old: str, folder: Path, harness: Callable[..., Said]
) -> None:
    changed(folder / "frozen/run.json", format=old)
    [one] = [one for one in runs(folder) if one.name == "frozen"]
    assert (one.kind, one.state, one.why) == ("run", "broken", "run.json: format of harness 0.1")
    assert "broken: run.json: format of harness 0.1\n" in harness("run", "ls", folder)[1]


def test_listing_needs_no_array_and_no_table() -> None:
    code = (
        "import sys, harness.runs.listing; "
        "print([m for m in ('numpy', 'pyarrow', 'msgspec', 'pandas') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"


def test_a_broken_sweep_is_listed_as_such(folder: Path) -> None:
    (folder / "frozen/sweep-tau/sweep.json").write_text("{")
    [one] = [one for one in runs(folder) if one.kind == "sweep"]
    assert (one.state, one.why) == ("broken", "sweep.json")


def test_no_link_leads_out_and_none_goes_round(folder: Path, tmp_path: Path) -> None:
    (folder / "live").rename(tmp_path / "elsewhere")
    (folder / "live").symlink_to(tmp_path / "elsewhere")
    (folder / "round").symlink_to(folder)
    (folder / "self").symlink_to(folder / "self")
    (folder / "latest").symlink_to(folder / "frozen")
    (folder / "lent").mkdir()
    (folder / "lent/run.json").symlink_to(tmp_path / "elsewhere/run.json")
    names = {one.name for one in runs(folder)}
    assert {"frozen", "latest"} <= names
    assert not {name for name in names if "live" in name or "lent" in name}
    (folder / "lent/answers.jsonl").touch()
    [lent] = [one for one in runs(folder) if one.name == "lent"]
    assert (lent.state, lent.why) == ("broken", "run.json is a link out of the folder")


def test_what_is_no_run_is_not_listed(folder: Path) -> None:
    (folder / "notes").mkdir()
    (folder / "notes/run.json").mkdir()
    os.mkfifo(folder / "notes/summary.csv")
    (folder / "README.md").write_text("notes")
    assert len(runs(folder)) == 3


@pytest.mark.parametrize(("module", "call"), [(listing, "_entry"), (os, "listdir")])
def test_a_folder_that_is_deleted_while_it_is_read_is_not_listed(
    module: ModuleType, call: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = getattr(module, call)

    def deleting(path: str, *args: str) -> object:
        if path == str(folder / "live"):
            shutil.rmtree(path)
        return real(path, *args)

    with monkeypatch.context() as now:
        now.setattr(module, call, deleting)
        assert {each.name for each in runs(folder)} == {"frozen", "frozen/sweep-tau"}


def test_no_folder_is_one_line_and_an_empty_one_says_so(
    harness: Callable[..., Said], tmp_path: Path
) -> None:
    code, out, err = harness("run", "ls")
    assert (code, out) == (2, "")
    assert err.startswith("harness: reports is no folder; give one that holds runs")
    (tmp_path / "reports").mkdir()
    assert harness("run", "ls") == (0, "no runs in reports; `harness eval` makes one\n", "")
    assert harness("run", "ls", "--json")[1] == "[]\n"


def kinds_of_studies() -> set[str]:
    """The kinds that the program makes, by its text: `Study("sweep", …)`."""
    room = Path(studies.__file__).parent
    rooms = (room, room.parent / "extensions")
    calls = [
        node
        for room in rooms
        for file in room.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "Study"
    ]
    return {str(call.args[0].value) for call in calls if isinstance(call.args[0], ast.Constant)}


def test_every_study_that_is_made_is_listed_and_refuses_the_folder_of_another(
    tmp_path: Path,
) -> None:
    kinds = kinds_of_studies()
    assert "sweep" in kinds
    known = dict(kinds_of_study())
    here = {kind for extension in extensions().values() for kind in extension.studies}
    gone = entries(STUDIES).keys() - here  # where the folder of extensions is deleted
    assert kinds - {"attribution"} == set(known) - gone, "which lies in its run's folder"
    for kind in known:
        (tmp_path / kind).mkdir()
        (tmp_path / kind / f"{kind}.json").write_text('{"sources": [{"name": "proxy"}]}')
        other = next(name for name in known if name != kind)
        with pytest.raises(UserError, match=rf"holds something else, as its {kind}\.json says"):
            refuse_taken(tmp_path / kind, other)
    for name in ("a\x1b", "a\u202e"):
        with pytest.raises(
            UserError, match="has characters that nothing can show; give another name"
        ):
            refuse_taken(tmp_path / name, "sweep")
    listed = {one.name: one for one in runs(tmp_path)}
    assert listed.keys() == known.keys()
    assert {one.state for one in listed.values()} == {"finished"}
    assert {name: one.kind for name, one in listed.items()} == known
