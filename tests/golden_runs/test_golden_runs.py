"""What whole runs say is what they said:
golden tables of frozen and closed-loop runs, sweeps and the study.

`UPDATE_GOLDEN=1` writes the tables anew. `UPDATE_GOLDEN=completions` asks swarm-tiny for its
completions anew, which needs an engine; write the tables anew after that.
"""

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import adapter
import comparing
import playing
import pytest
from fitting import unfit
from former import DATASET, DRIVE, NAME

DATA = Path(__file__).parent / "data"
COMPLETIONS = DATA / "completions.jsonl"

pytestmark = pytest.mark.slow

PAPER = ("single-local", "v2x", "6g")
EGO_PROMPT = "6g:consensus=ego-prompt"
RECORDED = "swarm-tiny:transformers"  # float32 on a CPU
PLAYED = ("--model", playing.MODEL, "--latency", "paper", "--no-cache")


def conditions(*names: str) -> list[str]:
    return [part for name in names for part in ("--condition", name)]


EVAL = ("eval", "--dataset", DATASET)
FROZEN = {
    "frozen-proxy": [
        *EVAL, "--limit", "6", "--seeds", "0:3", *conditions(*PAPER, "6g:consensus=log-pool"),
    ],
    "frozen-faulty": [
        *EVAL, "--model", "proxy-faulty", "--limit", "5", "--seeds", "0,7",
        *conditions(
            "single-local:fallback=brake", "6g:on_demand=true", "6g:max_helpers=2,density_coupled=true",
            "v2x:helper_rounds=true", "v2x:edge=relay,window_s=0.3",
        ),
    ],
    "frozen-local-view": [
        *EVAL, "--model", "local-view", "--limit", "6", "--seeds", "0:2", *conditions(*PAPER),
    ],
    "frozen-tiny-json": [
        *EVAL, *PLAYED, "--limit", "4", "--seeds", "0:2", *conditions(*PAPER, EGO_PROMPT),
    ],
    "frozen-tiny-readout": [
        *EVAL, *PLAYED, "--limit", "4", "--seeds", "0:2", "--answer", "readout", "--letters", "raw",
        *conditions(*PAPER),
    ],
}  # fmt: skip
CLOSED = {
    "closed-proxy": [
        *DRIVE, "--workers", "1", "--episodes", "4", "--seeds", "0:2", *conditions(*PAPER),
    ],
    "closed-faulty": [
        *DRIVE, "--workers", "1", "--model", "proxy-faulty", "--episodes", "2", "--seeds", "0:2",
        *conditions("single-local:fallback=brake", "v2x:window_s=0.4,consensus=log-pool"),
    ],
    "closed-full-view": [
        *DRIVE, "--workers", "1", "--model", "full-view", "--episodes", "3", "--seeds", "0,1",
        *conditions("single-local", "6g"),
    ],
    "closed-tiny": [
        *DRIVE, "--workers", "1", *PLAYED, "--episodes", "2", "--seeds", "0:2",
        *conditions("single-local", "v2x", "6g", EGO_PROMPT),
    ],
}  # fmt: skip
STUDIES = {
    "sweep-axes": [
        "study", "sweep", "{frozen-proxy}", "--apart", "--seeds", "0:2",
        *conditions("6g", "v2x:on_demand=true"),
        "--over", "tau", "--grid", "0.5,0.7,0.9", "--over", "loss", "--grid", "0,0.2",
        "--over", "size", "--grid", "1:3", "--over", "window", "--grid", "150,250",
        "--over", "latency", "--grid", "0,100",
    ],
    "sweep-usual": ["study", "sweep", "{frozen-faulty}", "--seeds", "0:2"],
    "sweep-tiny": [
        "study", "sweep", "{frozen-tiny-json}", "{frozen-tiny-readout}", "--over", "tau", "--grid", "0.6,0.9",
    ],
    "sweep-ego-prompt": [
        "study", "sweep", "{frozen-tiny-json}", "--over", "consensus", "--grid", "linear,log-pool,ego-prompt",
    ],
    "paper": ["study", "paper", "--episodes", "10", "--sweep-episodes", "10"],
    "closed-loop": [
        "study", "closed-loop", "--scenario", NAME, "--workers", "1", "--model", "proxy", "--episodes", "2",
        "--seeds", "0:2",
    ],
    "fidelity": ["study", "fidelity", "{frozen-proxy}", "{closed-proxy}"],
}  # fmt: skip
TABLES = {
    **dict.fromkeys(STUDIES, ("conditions", "episodes")),
    "paper": ("conditions", "ledger"),
    "closed-loop": ("conditions",),
    "fidelity": ("fidelity", "episodes"),
}
RUNS = {**FROZEN, **CLOSED, **STUDIES}
# Sweeps of other axes have goldens too, and both of the paper's studies are tried by `trials.py`.
TRIED = ("sweep-usual", "paper", "closed-loop")
ASKING = ("sweep-tiny", "sweep-ego-prompt")  # walks that lead elsewhere ask for more
TINY = [name for name, command in {**FROZEN, **CLOSED}.items() if playing.MODEL in command]

Finished = Callable[[str], Path]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Finished]:
    """The folder of a run by name, made when it is first asked for."""
    folder = tmp_path_factory.mktemp("golden") / "project"

    def run(name: str) -> Path:
        if not (folder / name).exists():
            command = [run(part[1:-1]) if part[0] == "{" else part for part in RUNS[name]]
            missing.clear()
            quiet = [] if command[1] == "fidelity" else ["--quiet"]  # which has no such option
            printed = adapter.typed(*command, *quiet, "--out", folder / name)
            assert not (quiet and printed)
            assert not missing, (
                f"{name} asks what no completion is stored for, first:\n{missing[0]}"
            )
        return folder / name

    with pytest.MonkeyPatch.context() as patch, playing.project(COMPLETIONS, folder) as missing:
        patch.chdir(folder)
        patch.setattr("harness.studies.study.DRAWN", ("svg",))  # tables are looked at
        patch.setenv("NO_PROXY", "127.0.0.1")
        yield run


@pytest.mark.skipif(
    os.environ.get("UPDATE_GOLDEN") != "completions", reason="asks the model itself"
)
def test_record_completions(tmp_path: Path) -> None:
    """No test, but the way to `completions.jsonl`."""
    said = []
    for name in TINY:
        command = [part.replace(playing.MODEL, RECORDED) for part in RUNS[name]]
        adapter.typed(*command, "--quiet", "--out", tmp_path / name)
        said += adapter.tables_of(tmp_path / name)["answers"]
    for name in ASKING:
        command = [str(tmp_path / part[1:-1]) if part[0] == "{" else part for part in RUNS[name]]
        adapter.typed(*command, "--quiet", "--out", tmp_path / name)
    for more in tmp_path.glob("*/more-answers.jsonl"):
        said += map(json.loads, more.read_text(encoding="utf-8").splitlines())
    playing.store(COMPLETIONS, said)


@pytest.mark.parametrize("name", [*FROZEN, *CLOSED])
def test_a_run_says_what_it_said(name: str, finished: Finished) -> None:
    run = finished(name)
    for stem, table in adapter.tables_of(run).items():
        comparing.held(DATA / name / f"{stem}.csv", table, more=True)
    for stem in ("episodes", "summary"):
        table = sorted(comparing.read_file(run / f"{stem}.csv"), key=adapter.place)
        comparing.held(DATA / name / f"{stem}.csv", table, more=True)
    assert list(unfit(run)) == []


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.exhaustive) if n in TRIED else n for n in STUDIES],
)
def test_a_study_says_what_it_said(name: str, finished: Finished) -> None:
    folder = finished(name)
    for stem in TABLES[name]:
        comparing.held(DATA / name / f"{stem}.csv", comparing.read_file(folder / f"{stem}.csv"))


@pytest.mark.skipif(comparing.UPDATE, reason="writes nothing")
def test_a_replay_says_what_its_run_said(finished: Finished, tmp_path: Path) -> None:
    name = "frozen-tiny-json"
    command = [part for part in RUNS[name] if part != "--no-cache"]
    command[command.index(playing.MODEL)] = f"replay:{finished(name)}"
    adapter.typed(*command, "--quiet", "--out", tmp_path / "replay")
    for stem, table in adapter.tables_of(tmp_path / "replay").items():
        comparing.held(DATA / name / f"{stem}.csv", table, more=True)
