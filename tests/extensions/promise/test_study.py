"""The study of what a model may promise: what is tried, what is chosen, and what is refused."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest
from msgspec.structs import replace
from run_on_disk import digested, restated
from studied import Once

from harness.coordination.named_points import named_point
from harness.core.progress import Progress
from harness.core.resources import MARKER
from harness.dataset.load import load
from harness.extensions.promise.caveat import caveats
from harness.extensions.promise.grid import SHARES, grid_of
from harness.extensions.promise.outcomes import Outcome, play
from harness.extensions.promise.promises import promise
from harness.extensions.promise.study import run_promise
from harness.runs.folder import read
from harness.studies.replayed_run import ReplayedRun

pytestmark = pytest.mark.usefixtures("svg_alone", "unrebuilt")

Typed = Callable[..., tuple[int, str, str]]
SIX_G = named_point("6g")


def thresholds(point):
    return point.setting("tau_nats"), point.setting("careful_nats")


def test_what_is_tried_for_unsafe_goes_from_always_careful_to_never():
    """Always, as it is and never asking; always careful is one setting, which is tested first."""
    grid = grid_of([SIX_G], 3, "unsafe")
    never = math.ceil(1e4 * math.log(3)) / 1e4
    assert len(grid.points) == 1 + 3 * len(SHARES)
    assert thresholds(grid.points[grid.order.first]) == (never, 0.0)
    levels = [round(share * math.log(3), 4) for share in SHARES[1:]]
    for chain, tau_nats in zip(grid.order.chains, (0.0, 0.7, never), strict=True):
        points = [grid.points[place] for place in chain]
        assert [thresholds(point) for point in points] == [
            *((tau_nats, careful) for careful in levels),
            (tau_nats, None),
        ]
    assert sorted([0, *(place for chain in grid.order.chains for place in chain)]) == list(
        range(len(grid.points))
    )


def test_what_is_tried_for_failed_goes_the_other_way():
    grid = grid_of([SIX_G], 3, "failed")
    assert grid.points[0] == SIX_G
    for chain in grid.order.chains:
        careful = [grid.points[place].setting("careful_nats") or 9 for place in chain[:-1]]
        assert careful == sorted(careful, reverse=True)
        assert grid.points[chain[-1]].setting("careful_nats") == 0
    assert len(set(grid.points)) == len(grid.points) == 3 * (1 + len(SHARES))


def test_a_schedule_that_does_not_look_at_tau_has_one_chain():
    grid = grid_of([named_point("6g:schedule=never"), SIX_G], 3, "unsafe")
    assert len(grid.order.chains) == 1 + 3


def test_layouts_of_one_scene_are_one_unit():
    """Two seeds; the first two layouts are of one scene."""
    harm = np.array([[1.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    outcome = Outcome(harm, 1 - harm, {})
    assert outcome.units(None).tolist() == [0.5, 0.0, 1.0]
    assert outcome.units(np.array([0, 0, 1])).tolist() == [0.25, 1.0]


@pytest.fixture
def runs(
    once: Once, proxy_run: Path, small_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A project with `tune`, a run on four tune layouts, and `report/run`, on two report layouts."""
    report_run = run_path(str(Path(__file__).with_name("trials.py")))["report_run"]
    shutil.copytree(report_run(once), tmp_path / "report")
    shutil.copytree(proxy_run, tmp_path / "tune")
    shutil.copytree(small_path, tmp_path / "small")
    (tmp_path / MARKER).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_a_promise_is_chosen_written_and_kept(runs: Path, harness: Typed) -> None:
    """Of four layouts without a failure 60 % may be promised; a run by the file does as it says."""
    twice = ("--condition", "6g", "--condition", "6g")
    words = ("study", "promise", "report/run", "--tune", "tune", *twice)
    more = ("--harm", "failed", "--at-most", "60", "--seeds", "0,1")
    code, out, error = harness(*words, *more, "--json", "--write", "promises/p.toml", "--quiet")
    assert (code, error) == (0, "")
    rows = {row["setting"]: row for row in json.loads(out)}
    shown = ["as it is", "always careful", "≤ 60 %"]
    blind = [name for name, row in rows.items() if row["run"] == "blind"]
    assert [*shown, *blind] == list(rows)
    assert [rows[name]["promised"] for name in shown] == [False, False, True]
    assert {"always SLOWER", "always IDLE", "uniform"} < set(blind)
    assert rows["always SLOWER"]["harm_value"] == 1.0
    assert rows["always careful"]["harm_value"] == 1.0
    file = promise("p")
    assert (file.harm, file.at_most, file.delta, file.units) == ("failed", 0.6, 0.05, 4)
    assert file.dataset_sha256 == load(runs / "small").sha256
    chosen = rows["≤ 60 %"]
    assert (file.tau_nats, file.careful_nats) == (chosen["tau_nats"], chosen["careful_nats"])
    code, _, error = harness(
        "eval", "--dataset", "report/layouts", "--condition", "6g:promise=p", "--seeds", "0,1",
        "--quiet", "--no-cache", "--out", "kept",
    )  # fmt: skip
    assert (code, error) == (0, "")
    played = read(runs / "kept")
    failed = 1 - played.score("6g:promise=p", "success_rate").value
    assert failed == pytest.approx(chosen["harm_value"])
    assert [*caveats(played.manifest)] == []
    danger = replace(played.manifest.world, selection={"danger": "none"})
    [said] = caveats(replace(played.manifest, world=danger))
    assert said == "Promise p is of all layouts, and says nothing of those chosen by --danger none."
    latency_ms = played.score("6g:promise=p", "latency_proxy_ms").value
    assert latency_ms == pytest.approx(chosen["latency_ms"], abs=0.01)
    tried = (runs / "report/run/promise/settings.csv").read_text().splitlines()[1:]
    assert len(tried) == len(grid_of([SIX_G], 3, "failed").points)
    code, _, error = harness(*words, *more, "--write", "promises/p.toml")
    assert code == 2
    assert "--write promises/p.toml is there already" in error
    (runs / MARKER).unlink()
    code, _, error = harness(*words, *more, "--write", "promises/q.toml")
    assert (code, error.count("\n")) == (2, 1)
    assert "--write promises/q.toml: no project is here that could use it" in error


def test_a_promise_is_written_before_anything_is_printed(
    runs: Path, harness: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who reads the first lines alone, as `head` does, ends the command there."""

    def stop(*args: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr("harness.cli.show.show", stop)
    words = ("study", "promise", "report/run", "--tune", "tune", "--condition", "6g")
    more = ("--harm", "failed", "--at-most", "60", "--write", "promises/p.toml")
    harness(*words, *more)
    assert promise("p").at_most == 0.6


@pytest.mark.slow
def test_what_nobody_can_promise_is_said_and_no_file_is_written(runs: Path, harness: Typed) -> None:
    """In these scenes an ego that stands is unsafe, so that nothing can be promised."""
    words = ("report/run", "--tune", "tune", "--condition", "6g", "--at-most", "60")
    code, out, error = harness("study", "promise", *words, "--write", "promises/p.toml")
    assert code == 2
    says = "No setting of proxy · v2 · json can promise unsafe episodes ≤ 60 %"
    assert says in " ".join(out.split())
    assert f"{says}; no file is written" in error
    assert not (runs / "promises").exists()


@pytest.mark.slow
def test_what_is_chosen_is_the_best_that_is_certified(runs: Path) -> None:
    """Of four layouts, .4^4 is below a third of .05: all without a failure are certified that
    nothing before them in their chain has one.
    """
    tune, report = ReplayedRun(runs / "tune"), ReplayedRun(runs / "report/run")
    result = run_promise(
        [report, report], tune, ["6g"], "failed", [0.6], 0.08, (0,), runs / "out", Progress()
    )
    [level] = result.levels
    assert level.needed == 3
    outcomes = play(tune, result.grid.points, "failed", (0,), Progress())
    failures = [outcomes[point].harm.sum() for point in result.grid.points]
    assert failures[0] == 0
    certified = {0}
    for chain in result.grid.order.chains:
        for place in chain:
            if failures[place]:
                break
            certified.add(place)
    assert level.certified == len(certified) > 1
    requests = {n: outcomes[result.grid.points[n]].costs["requests"] for n in certified}
    assert level.chosen == result.grid.points[min(requests, key=requests.get)]
    # what is scored elsewhere is what was scored on report layouts
    [elsewhere] = result.elsewhere
    assert elsewhere.harm(level.chosen) == result.report.harm(level.chosen)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            "report/run --tune tune --at-most 5",
            "--tune tune: 4 independent layouts, and a promise of 5 % needs 59 without harm "
            "(delta = 5 %); give a run on more, or a larger --at-most",
        ),
        ("report/run --tune tune", "and a promise of 10 % needs 29 without harm"),
        ("report/run --tune report/run --at-most 60", "a promise is fitted on tune seeds"),
        ("tune --tune tune --at-most 60", "give a run on report layouts, which no threshold is"),
        ("report/run --tune tune --at-most 60 --condition single-local", "has no channel"),
        ("report/run --tune tune --at-most 60 --delta 0", "--delta 0: give percent, between"),
        ("report/run --tune tune --at-most 1e-321", "--at-most 9.98013e-322: give percent, betw"),
        ("report/run --tune tune --at-most 60 --condition 7g", "unknown operating point '7g'"),
        ("report/run --tune tune --at-most 60 --no-model", "--no-model: tune lacks answers of"),
    ],
)
def test_what_cannot_be_promised_is_one_line(
    runs: Path, harness: Typed, words: str, says: str
) -> None:
    code, out, error = harness("study", "promise", *words.split())
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert says in error


def test_runs_of_two_models_are_refused(runs: Path, harness: Typed) -> None:
    code, _, error = harness(
        "eval", "--model", "uniform", "--dataset", "report/layouts", "--condition", "6g",
        "--seeds", "0,1", "--quiet", "--no-cache", "--out", "uniform",
    )  # fmt: skip
    assert (code, error) == (0, "")
    code, _, error = harness("study", "promise", "uniform", "--tune", "tune", "--at-most", "60")
    assert code == 2
    assert "--tune tune differs from uniform in model, latency" in error


@pytest.mark.parametrize(
    ("choice", "says"),
    [
        ("--only 0,2", "--tune chosen: its layouts are chosen by --only 0,2, those of report/run"),
        ("--danger none", "by --danger none, those of report/run by nothing; give runs on all"),
        ("--sample 3", "3 independent layouts"),
        ("--until-width 90", "how many layouts it has was decided by looks at their outcome; give"),
    ],
)
def test_layouts_that_are_not_chosen_by_chance_promise_nothing(
    runs: Path, harness: Typed, choice: str, says: str
) -> None:
    words = ("eval", "--dataset", "small", "--condition", "6g", "--seeds", "0,1", "--no-cache")
    code, _, error = harness(*words, *choice.split(), "--quiet", "--out", "chosen")
    assert (code, error) == (0, "")
    code, _, error = harness("study", "promise", "report/run", "--tune", "chosen", "--at-most", "5")
    assert (code, error.count("\n")) == (2, 1)
    assert says in error
    more = ("--at-most", "5", "--write", "promises/p.toml")
    code, _, error = harness("study", "promise", "report/run", "--tune", "chosen", *more)
    assert code == 2
    if "until" in choice:
        return
    assert ("--write: a file promises of all layouts" in error) == ("sample" not in choice)
    record = json.loads(Path("chosen/run.json").read_text())
    world = {**record["world"], "selection": {}}  # though they are chosen
    Path("chosen/run.json").write_text(json.dumps(restated(record, {"world": world})))
    digested(Path("chosen"))
    code, _, error = harness("study", "promise", "report/run", "--tune", "chosen", *more)
    assert "chosen: episodes.csv has other episodes than run.json says that were selected" in error
