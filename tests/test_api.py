"""The harness from Python: few names, which say what the command line says and show themselves."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluating import live_spec_of, run, spec_of

import harness
from harness import extend
from harness.coordination.named_points import POINTS
from harness.core.extensions import PYTHON
from harness.dataset.load import Dataset
from harness.evaluate.command_options import OPTIONS

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("svg_alone")]


@pytest.fixture(scope="module")
def folder(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frozen runs, of the proxy and of a driver, and a closed-loop one."""
    folder, points = tmp_path_factory.mktemp("api"), (POINTS["single-local"], POINTS["6g"])
    for model in ("proxy", "local-view"):
        run(spec_of(small, model, points=points), folder / model)
    run(live_spec_of(points=points), folder / "driven")
    return folder


def test_there_are_few_names_and_importing_loads_nothing_else() -> None:
    assert [name for name in dir(harness) if name not in PYTHON] == [
        "Extension",
        "Setting",
        "UserError",
        "__version__",
        "compare",
        "load",
        "ls",
        "run",
        "sweep",
    ]
    code = "import sys, harness; assert not {'numpy', 'pandas', 'msgspec'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(
        AttributeError,
        match="no attribute 'evaluation'; it has Extension, Setting, UserError, compare",
    ):
        _ = harness.evaluation


def test_a_run_shows_its_headline_and_a_row_for_each_condition(folder: Path) -> None:
    page = harness.load(folder / "proxy")._repr_html_()
    assert page.startswith("<p>Under 6g, ")
    parts = ["<td>single-local</td>", "<td>6g</td>", "<th>success</th>", "<th>latency</th>"]
    assert [page.count(part) for part in parts] == [1] * 4
    assert "episodes × " in page


@pytest.mark.parametrize("name", ["proxy", "driven"])
def test_a_decision_point_shows_its_picture_answers_and_decisions(folder: Path, name: str) -> None:
    made = harness.load(folder / name)
    scene = made.decisions.scene.iloc[-1]
    point = made.decision(scene)
    assert scene in point.svg
    assert set(point.answers.scene) == set(point.decisions.scene) == {scene}
    page = point._repr_html_()
    assert "data:image/svg+xml" in page
    assert page.count("action_distribution") == len(point.answers)
    assert point.viewer is None
    other = made.decision(scene, point.scene.viewers[1])
    assert other.svg != point.svg
    with pytest.raises(harness.UserError, match="unknown viewer"):
        made.decision(scene, "v99")
    with pytest.raises(harness.UserError, match="unknown decision point"):
        made.decision("99999-0-nowhere")


def test_what_a_model_wrote_is_text_in_a_notebook(small: Dataset, tmp_path: Path) -> None:
    from run_on_disk import made_up

    def hostile(row: dict[str, object]) -> None:
        row["raw"] = "<script>alert(1)</script>"

    made = harness.load(made_up(tmp_path / "<b>run", answer=hostile))
    assert "<script>" not in made.answers.to_html()
    assert "<b>run" not in made._repr_html_()


def test_a_folder_of_runs_is_a_table(folder: Path) -> None:
    table = harness.ls(folder)
    assert set(table.name) == {"proxy", "local-view", "driven"}
    assert set(table.state) == {"finished"}
    with pytest.raises(harness.UserError, match="is no folder"):
        harness.ls(folder / "nowhere")


def test_a_comparison_is_the_command_lines(folder: Path) -> None:
    difference = harness.compare(harness.load(folder / "local-view"), folder / "proxy")
    table = difference.differences.set_index(["condition", "metric"])
    row: Any = table.loc[("6g", "success_rate")]
    assert row.b - row.a == pytest.approx(row.difference)
    assert row.low <= row.difference <= row.high
    assert [sentence.partition(":")[0] for sentence in difference.findings] == [
        "single-local",
        "6g",
    ]
    page = difference._repr_html_()
    assert all(sentence.replace("'", "&#39;") in page for sentence in difference.findings)
    shown = repr(difference)
    assert len(shown) < 1500
    assert all(sentence in shown for sentence in (*difference.findings, ".differences", "B: "))
    with pytest.raises(harness.UserError, match="give two of a kind"):
        harness.compare(folder / "proxy", folder / "driven")


def test_what_plug_ins_build_on_is_pinned() -> None:
    names = """
    ActsOn Backend Bools Broadcast Building Call Capabilities Card Channel Completion Content Delivery Draws Floats
    Formula Fused Ground Intents Ints Kept Lane Layout LayoutDraws Links Messages Metric PERCENT
    Parameters Part Path PathKey Physical Plugins Pool Registration Request Road Rule Run RunFacts
    Scenario ScheduleInputs Section Spawn Study Table Unit UserError
    crossings finish_study ground linear_pool link_up read_run straights to_the_left
    """
    # A name that goes stays here for a release, with a warning: docs/extend.md.
    assert sorted(extend.__all__, key=str.lower) == sorted(names.split(), key=str.lower)
    assert all(getattr(extend, name) for name in extend.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'Absent'"):
        _ = extend.Absent


@pytest.mark.parametrize(
    ("module", "names"), [("trust.attacks", ("Attack", "Turn")), ("interop.hooks", ("Hook",))]
)
def test_what_an_extension_gives_to_plug_ins_is_there_as_before(
    module: str, names: tuple[str, ...]
) -> None:
    there = pytest.importorskip(f"harness.extensions.{module}")
    for name in names:
        assert getattr(extend, name) is getattr(there, name)


def test_spellings_of_0_2_work_with_a_warning(small: Dataset) -> None:
    from harness.world import parameters, scenario
    from harness.world.world import World

    graph = next(iter(small.scenes(small.forest.ids[:1])[0].graphs.values()))
    with pytest.warns(FutureWarning, match=r"\['self'\] is now \.itself; it works until 0\.5\.0"):
        assert graph["self"] is graph.itself
    for name in ("braking", "__class__", "plain"):
        with pytest.raises(KeyError):
            graph.itself[name]
    with pytest.warns(FutureWarning, match=r"frames is now in harness\.world\.parameters"):
        assert scenario.frames is parameters.frames  # type: ignore[attr-defined]
    with pytest.warns(FutureWarning, match=r"is now Scenario\(world=Class\)"):
        old = replace(small.scenario, start=World.begun)
    assert old.has_own_world
    assert World.start(old, 3).state() == World.start(small.scenario, 3).state()
    assert replace(old, name="other").world is old.world
    with pytest.warns(FutureWarning, match=r"Old\.by_moment is now by_scene"):

        class Old(extend.Attack):
            by_moment = True

    assert Old.by_scene
    assert not extend.Attack.by_scene


def test_a_run_is_evaluated_with_the_command_lines_names(small_path: Path, tmp_path: Path) -> None:
    made = harness.run(
        model="local-view",
        dataset=str(small_path),
        condition="6g",
        limit=2,
        seeds="0:2",
        out=tmp_path / "run",
    )
    assert made.config["seeds"] == [0, 1]
    assert [each["name"] for each in made.config["conditions"]] == ["6g"]
    assert (made.path / "report.html").is_file()
    driven = harness.run(
        model="local-view", scenario="hard-brake-ahead", condition=["6g"], episodes=1, seeds="0",
        out=tmp_path / "driven", quiet=True,
    )  # fmt: skip
    assert driven.config["world"]["scenario"]["name"] == "hard-brake-ahead"
    with pytest.raises(
        harness.UserError, match="unknown setting 'dataest'; did you mean 'dataset'"
    ):
        harness.run(dataest="x")
    with pytest.raises(harness.UserError, match="unknown setting 'dataset'"):
        harness.run(scenario="blind-merge", dataset="x")


def test_a_sweep_is_the_command_lines(folder: Path, tmp_path: Path) -> None:
    study = harness.sweep(folder / "proxy", "loss", "0,1", out=tmp_path / "sweep", quiet=True)
    table = study.tables["conditions"].query("metric == 'success_rate' and interval == 'episodes'")
    assert table.value.tolist() == [0.0, 1.0]
    assert study._repr_html_().count("<img") == len(list(study.path.glob("*.svg"))) >= 1
    assert (study.path / "index.html").is_file()
    with pytest.raises(harness.UserError, match="--grid: 2 given for 1 of --over"):
        harness.sweep(folder / "proxy", "loss", ["0,1", "2"])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"temperature": "\ud800"}, r"temperature = '\\ud800'; allowed: "),
        ({"temperature": 10**400}, r"temperature = 10{60,}.*; allowed: a finite number"),
        ({"max_cost": "1"}, "max_cost = '1'; allowed: a number"),
        ({"tracker": ["wandb", 5]}, r"options \[tracker\]: 1 = 5; allowed: a text"),
        ({"out": 5}, "out = 5; allowed: a path, as text or a Path"),
    ],
)
def test_a_value_of_another_type_is_one_line(options: dict[str, Any], said: str) -> None:
    if not options.keys() <= {"temperature", "out", *OPTIONS}:
        pytest.skip("of an extension that is gone")
    with pytest.raises(harness.UserError, match=said):
        harness.run(model="proxy", limit=1, **options)


def test_what_is_no_path_is_one_line() -> None:
    for call in (harness.load, harness.ls, lambda run: harness.compare(run, "x")):
        with pytest.raises(harness.UserError, match="= 5; allowed: a path"):
            call(5)  # type: ignore[arg-type]


def test_a_lone_surrogate_in_a_run_hides_no_other(folder: Path, tmp_path: Path) -> None:
    for name in ("one", "other"):
        shutil.copytree(folder / "proxy", tmp_path / name)
    file = tmp_path / "one/run.json"
    stated = json.loads(file.read_text())
    stated["prompt"]["version"] = "\ud800"
    file.write_text(json.dumps(stated))
    assert "ud800" in file.read_text()
    assert sorted(harness.ls(tmp_path)["name"]) == ["one", "other"]
