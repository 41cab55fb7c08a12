"""Runs of earlier commits, kept under `records/`, are read by every command,
or one line says why not.

`records/make.py` made them, each with the program of its commit.
"""

import csv
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import fields
from itertools import product
from pathlib import Path

import msgspec
import pyarrow.parquet as pq
import pytest
from former import DATASET, NAME
from packaged import register
from starlette.testclient import TestClient
from tiers import some

import harness as package
from harness.backends.card import Card
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.part_settings import more_parts
from harness.core.errors import UserError
from harness.core.extensions import extensions
from harness.core.versions import versions
from harness.evaluate.lifecycle import RunStart
from harness.runs import folder, formats, records
from harness.runs.decisions import schema
from harness.runs.settings import PLAIN
from harness.runs.timers import added_columns

HERE = Path(__file__).parent / "records"
COMMITS = ("356ad2b", "8cccefb", "0103f23")
RUNS = sorted(path.parent.relative_to(HERE).as_posix() for path in HERE.glob("*/*/run.json"))
STUDIED = ("356ad2b/proxy", "8cccefb/mixed", "0103f23/attack")
Typed = Callable[..., tuple[int, str, str]]


@pytest.fixture
def kept(tmp_path: Path) -> Callable[[str], Path]:
    """A kept run, or all of a commit, in a folder that a command may write to."""
    return lambda name: Path(
        shutil.copytree(HERE / name, tmp_path / "kept" / name, dirs_exist_ok=True)
    )


def test_records_are_of_three_commits_and_small() -> None:
    assert {run.split("/")[0] for run in RUNS} == set(COMMITS)
    assert sum(path.stat().st_size for path in HERE.rglob("*")) < 2_000_000


@pytest.mark.parametrize("run", RUNS)
def test_tables_load(run: str) -> None:
    tables = package.load(HERE / run)
    assert all(map(len, (tables.decisions, tables.answers, tables.episodes, tables.summary)))


READERS = {
    "check": "run check {run}",
    "report": "report {run} --out page.html",
    "csv": "run export {run} --csv --out out",
    "jsonl": "run export {run} --jsonl --out out",
    "junit": "run export {run} --junit out.xml",
    "compare": "compare {run} {run}",
}


# The oldest, which lacks the most, is read by every command, and the latest of each kind by `run
# check`, which reads all that there is; a driven one, a mix and an attacked one also by what shows
# most of them. The rest of the product is of `make exhaustive`.
SOME = {
    *(("356ad2b/proxy", command) for command in READERS),
    *((run, "check") for run in RUNS if run.startswith(COMMITS[-1])),
    ("356ad2b/drive", "report"),
    ("8cccefb/mixed", "check"),
    ("8cccefb/mixed", "compare"),
    ("0103f23/attack", "report"),
}


def tier(run: str, command: str) -> tuple[pytest.MarkDecorator, ...]:
    if (run, command) not in SOME:
        return (pytest.mark.exhaustive,)
    return (pytest.mark.slow,) if command == "report" else ()


@pytest.mark.parametrize(
    ("run", "command"),
    [
        pytest.param(run, command, marks=tier(run, command))
        for run, command in product(RUNS, READERS)
    ],
)
def test_commands_read_every_run(run: str, command: str, harness: Typed) -> None:
    if run.endswith("/attack") and "trust" not in extensions():
        pytest.skip("attacks are of an extension that is gone")
    code, _, error = harness(*READERS[command].format(run=HERE / run).split())
    assert (code, error) == (0, "")


STUDIES = {
    "sft": "run export {run} --sft out.jsonl --report-seeds-too",
    "dpo": "run export {run} --dpo out.jsonl --report-seeds-too",
    "sweep": "study sweep {run} --over loss --grid 0,0.5 --seeds 0 --no-model --quiet",
    "trust": "study trust {run} --attacks liar --rules median "
    "--share 1/3 --seeds 0 --no-model --quiet",
    "schedule": "study schedule compare {run} --schedule random --seeds 0 --quiet",
    "attribute": "study attribute {run} --sample 1 --quiet",
    "replay": f"eval --model replay:{{run}} --dataset {DATASET} {{same}} --quiet --out replayed",
}
SAME = {
    "356ad2b/proxy": "--limit 2 --seeds 0,1 --condition "
    "single-local --condition v2x --condition 6g",
    "8cccefb/mixed": "--limit 2 --seeds 0 --condition 6g --helper-model replay:{run}",
    "0103f23/attack": "--limit 2 --seeds 0,1 --condition 6g "
    "--condition 6g:consensus=trust --attack liar",
}


# All of the oldest run, which lacks the most; of a mix and of an attacked run what walks anew.
USUAL = {
    *(("356ad2b/proxy", command) for command in STUDIES),
    ("8cccefb/mixed", "replay"),
    ("0103f23/attack", "trust"),
}


@pytest.mark.usefixtures("svg_alone")
@pytest.mark.parametrize(
    ("run", "command"),
    [
        pytest.param(*each, marks=pytest.mark.slow if each in USUAL else pytest.mark.exhaustive)
        for each in product(STUDIED, STUDIES)
    ],
)
def test_studies_read_frozen_runs(
    run: str, command: str, kept: Callable[[str], Path], harness: Typed
) -> None:
    path = kept(run)
    if command in ("sft", "dpo"):
        pytest.importorskip("harness.extensions.learn")
    code, _, error = harness(
        *STUDIES[command].format(run=path, same=SAME[run].format(run=path)).split()
    )
    assert (code, error) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("run", ["356ad2b/proxy", "0103f23/attack"])
def test_a_replay_decides_as_the_run_did(
    run: str, kept: Callable[[str], Path], harness: Typed
) -> None:
    again = f"{SAME[run]} --dataset {DATASET} --ties first --quiet --out again"
    harness("eval", "--model", f"replay:{kept(run)}", *again.split())
    old, new = (folder.read(path).decisions for path in (HERE / run, Path("again")))
    assert old.labels("action") == new.labels("action")


def opened(reports: Path) -> TestClient:
    """A browser that may see a folder of runs."""
    view, access = (
        pytest.importorskip(f"harness.extensions.view.{name}") for name in ("app", "access")
    )
    cookies = {access.cookie(7654): "token"}
    return TestClient(view.app(reports, "token"), base_url="http://127.0.0.1:7654", cookies=cookies)


@pytest.mark.parametrize("commit", COMMITS)
def test_folders_of_runs_are_listed_shown_and_compared(commit: str, harness: Typed) -> None:
    runs = [run for run in RUNS if run.startswith(commit)]
    code, out, error = harness("run", "ls", HERE / commit, "--json")
    states = {entry["name"]: entry["state"] for entry in json.loads(out)}
    assert (code, error, states.pop("begun")) == (0, "", "unfinished")
    assert set(states.values()) == {"finished"}
    assert {f"{commit}/{name}" for name in states} >= set(runs)
    assert harness("run", "history", HERE / commit)[::2] == (0, "")
    browser = opened(HERE / commit)
    assert all(name in browser.get("/").text for name in states)
    assert browser.get("/run?path=sweep").status_code == 200


@pytest.mark.exhaustive
def test_runs_of_different_days_are_compared(harness: Typed) -> None:
    code, out, error = harness("compare", HERE / "356ad2b/proxy", HERE / "0103f23/proxy")
    assert (code, error) == (0, "")
    assert "success" in out
    assert opened(HERE).get("/compare?path=356ad2b/proxy&path=0103f23/proxy").status_code == 200
    pages = [HERE / commit / "proxy" for commit in COMMITS]
    assert harness("report", *pages, "--out", "page.html")[::2] == (0, "")


@pytest.mark.parametrize("commit", some(["356ad2b"], exhaustive=["0103f23"]))
def test_driven_runs_are_held_against_frozen_ones(commit: str, harness: Typed) -> None:
    run = HERE / commit
    code, _, error = harness("study", "fidelity", run / "proxy", run / "drive", "--out", "fidelity")
    assert (code, error) == (0, "")


@pytest.mark.parametrize("commit", some(["356ad2b"], exhaustive=["8cccefb", "0103f23"]))
def test_what_a_run_cannot_have_is_one_line(commit: str, harness: Typed) -> None:
    for words, why in {
        "study sweep {run}/drive": "was driven",
        "run merge {run}/proxy {run}/drive --out merged": "is no shard",
        "eval --model replay:{run}/begun": "is no finished run, and the command that began it conti",
    }.items():
        code, _, error = harness(*words.format(run=HERE / commit).split())
        assert (code, error.count("\n")) == (2, 1)
        assert why in error


BEGUN = (
    "drive --model local-view --episodes 40 --seeds 0 --workers 1 --condition single-local --quiet"
)


@pytest.mark.parametrize(
    "commit",
    [
        pytest.param("8cccefb", marks=pytest.mark.exhaustive),
        pytest.param("0103f23", marks=pytest.mark.slow),
    ],
)
def test_a_begun_run_resumes(commit: str, kept: Callable[[str], Path], harness: Typed) -> None:
    """The part that it had has no seal, and is driven again. Its bare name has come to mean other scenes, and its
    parser read answers otherwise, and episodes had other luck where helpers leave, so that it goes
    on only where it says that it has the present ones.
    """
    begun = kept(f"{commit}/begun")
    [part] = begun.glob(".work/episodes-*/answers.jsonl")
    answers = part.read_bytes()
    typed = (*BEGUN.split(), "--ask", "all", "--ties", "first", "--out", begun)
    code, _, error = harness(*typed)
    assert (code, error.count("\n")) == (2, 1)
    assert "with --scenario occluded-intersection:limits=2" in error
    code, _, error = harness(*typed, "--scenario", NAME)
    assert (code, error.count("\n")) == (2, 1)
    assert "repeat its settings (version of parser 1, version of decisions 1)" in error
    config = begun / ".work/config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"versions": versions()}))
    code, _, error = harness(*typed, "--scenario", NAME)
    assert (code, error.count("\n")) == (0, 1)
    assert "has 1 finished part that nobody finished here with your key; their ep" in error
    assert len(folder.read(begun).episodes) == 40
    assert (begun / "answers.jsonl").read_bytes().startswith(answers)


def test_a_begun_run_goes_on_with_the_packages_that_it_began_with(
    kept: Callable[[str], Path],
    harness: Typed,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Their rules, radios and scenarios made what it has."""
    begun = kept("0103f23/begun")
    register(
        tmp_path / "site", "[swarmdrive.notes]\nmine = by_hand_notes:NOTES\n", by_hand_notes=""
    )
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    assert versions()["by-hand"] == "1.0"
    config = begun / ".work/config.json"
    began_with = {**versions(), "by-hand": "0.9"}
    config.write_text(json.dumps(json.loads(config.read_text()) | {"versions": began_with}))
    typed = (*BEGUN.split(), "--ask", "all", "--ties", "first", "--out", begun)
    code, _, error = harness(*typed, "--scenario", NAME)
    assert (code, error.count("\n")) == (2, 1)
    assert (
        "was begun with another version of package by-hand; repeat its settings (version" in error
    )


def test_a_begun_run_of_the_first_commit_is_refused(
    kept: Callable[[str], Path], harness: Typed
) -> None:
    """It has a digest of its model's identity, and its parts are single episodes."""
    code, _, error = harness(*BEGUN.split(), "--out", kept("356ad2b/begun"))
    assert (code, error.count("\n")) == (2, 1)
    assert "start again" in error


@pytest.mark.parametrize("run", RUNS)
def test_what_a_run_lacks_has_an_entry(run: str) -> None:
    """Whoever adds a field or a column says in `formats` what it is in older runs."""
    stated = json.loads((HERE / run / "run.json").read_text())
    columns = pq.read_schema(HERE / run / "decisions.parquet").names
    helpers = sum(name.startswith("helper_") for name in columns)
    with (HERE / run / "episodes.csv").open() as file:
        head = next(csv.reader(file))
    of_extensions = {key for kind in more_parts().values() for key in kind.__struct_fields__}
    condition, manifest = (
        {*OperatingPoint.types()} - of_extensions,
        set(records.Manifest.__struct_fields__),
    )
    # Letters are a setting of the agent; an adapter, a price, prompts, a cost and digests are stated
    # where there are some.
    card = {field.name for field in fields(Card)} - {"letters", "adapter", "price", "prompts"}
    lacks = {
        "MANIFEST": manifest
        - {*stated, *formats.AGENT, *formats.BESIDE, "settings", "cost", "digests"},
        "SETTINGS": PLAIN.keys() - {formats.BESIDE[key] for key in formats.BESIDE if key in stated},
        "AGENT": set(formats.AGENT) - {*stated},
        "MODEL": card - {*stated["model"]},
        "CONDITION": set.union(*(condition - {*point} for point in stated["conditions"])),
        "COLUMNS": {
            re.sub(r"_\d+$", "", name)
            for name in set(schema(stated["actions"], helpers).names) - {*columns, *added_columns()}
        },
    }
    for table, names in lacks.items():
        assert names <= getattr(formats, table).keys(), f"add an entry to formats.{table}"
    assert {*records.Episode.__struct_fields__} <= {*head, *formats.EPISODE}
    with (HERE / run / "answers.jsonl").open() as lines:
        assert {*records.Answer.__struct_fields__} <= {
            *json.loads(next(lines)),
            "heard",
            *formats.ANSWER,
        }


@pytest.mark.parametrize(
    ("kind", "added"),
    [
        (records.Answer, formats.ANSWER),
        (records.Episode, formats.EPISODE),
        (RunStart, formats.START),
    ],
)
def test_a_struct_has_the_defaults_that_the_table_states(kind: type, added: dict) -> None:
    stated = {field.name: field for field in msgspec.structs.fields(kind)}
    for name, entry in added.items():
        field = stated[name]
        default = (
            field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
        )
        assert (formats.UNSET if default is msgspec.UNSET else default) == entry.absent


@pytest.mark.parametrize(
    ("version", "why"),
    [
        ("swarmdrive-run/1", "harness 0.1 reads it"),
        ("swarmdrive-run/3", "a newer harness made it: install that"),
        ("mine/1", "give a folder made by"),
        (None, "give a folder made by"),
    ],
)
def test_another_format_is_one_line(version: str, why: str) -> None:
    with pytest.raises(UserError, match=re.escape(why)):
        formats.checked(version, "run.json")


@pytest.mark.slow
def test_a_run_whose_tables_cannot_be_read_is_made_again_from_its_answers(
    kept: Callable[[str], Path], harness: Typed
) -> None:
    run = kept("0103f23/proxy")
    (run / "decisions.parquet").write_bytes(b"of another program")
    code, _, error = harness("report", run)
    assert code == 2
    assert f"--model replay:{run}" in error
    again = f"{SAME['356ad2b/proxy']} --dataset {DATASET} --quiet"
    assert harness("eval", "--model", f"replay:{run}", *again.split(), "--out", "again")[0] == 0
