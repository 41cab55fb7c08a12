"""Layouts that numbers are reported of, under another purpose, teach and choose nothing."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
from former import NAME
from msgspec.structs import replace
from relabelling import FEW, SEED, relabel

from harness.cli import dataset as checking
from harness.core.errors import UserError
from harness.dataset import rebuilt, verify
from harness.dataset.build import build
from harness.dataset.freeze import freeze
from harness.dataset.load import find, load
from harness.dataset.rebuilt import Start
from harness.world import scenarios
from harness.world.world import World

Harness = Callable[..., tuple[int, str, str]]


def splice(source: Path, dataset: Path, number: int) -> None:
    """Put a layout of one dataset into another of the same seeds, every digest in order."""
    folder = f"{number:05d}/"
    layouts, manifests = list[dict[str, bytes]](), list[dict[str, Any]]()
    for each in (source, dataset):
        with ZipFile(each / "layouts.zip") as file:
            layouts.append({name: file.read(name) for name in file.namelist()})
        manifests.append(json.loads((each / "manifest.json").read_text()))
    ours, theirs = (
        layouts[1],
        {name: data for name, data in layouts[0].items() if name.startswith(folder)},
    )
    points = [json.loads(of[f"{folder}tree.json"])["levels"] for of in (theirs, ours)]
    more, fewer = (sum(map(len, levels)) for levels in points)
    manifests[1]["trees_sha256"][number] = manifests[0]["trees_sha256"][number]
    manifests[1]["nodes"] += more - fewer
    (dataset / "manifest.json").write_text(json.dumps(manifests[1]))
    rest = {name: data for name, data in ours.items() if not name.startswith(folder)}
    with ZipFile(dataset / "layouts.zip", "w") as file:
        for name, data in {**rest, **theirs}.items():
            file.writestr(name, data)


@pytest.mark.slow
def test_a_check_rebuilds_a_few(
    relabelled: Path, small_path: Path, harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rebuilt, "REBUILT", 1)
    code, out, _ = harness("dataset", "check", relabelled)
    assert code == 1
    assert "is not what layout seed" in out
    assert harness("dataset", "check", small_path)[0] == 0


def test_a_check_prints_some_lines_and_how_many_more(
    small_path: Path, harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verify, "check", lambda path: [f"problem {n}" for n in range(70)])
    code, out, _ = harness("dataset", "check", small_path)
    assert code == 1
    assert out.splitlines()[-2:] == ["problem 49", "(20 more problems: --json)"]


@pytest.mark.exhaustive
def test_one_layout_under_another_seed_is_found_whichever_are_built_whole(
    relabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its first scene tells; a tree that begins as it should is found where it is drawn."""
    monkeypatch.setattr(rebuilt, "REBUILT", 0)
    build(FEW, tmp_path / "tune", 2, 0, 1, lambda done: None)
    assert list(rebuilt.differences(load(tmp_path / "tune"))) == []
    splice(relabelled, tmp_path / "tune", 1)
    [found] = rebuilt.differences(load(tmp_path / "tune"))
    assert found == "layout 1 is not what layout seed 1 gives"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Any]]:
    """A dataset of a tune layout, and what its seed gives, as it takes a second."""
    out = tmp_path_factory.mktemp("built") / "tune"
    build(FEW, out, 1, 1, 1, lambda done: None)
    return out, list(freeze(FEW, {0: 1}))


def _unsent(record: dict[str, Any]) -> None:
    record["danger"] = {"sector": None, "vehicle": None}


def _braked(tree: dict[str, Any]) -> None:
    drivers = tree["levels"][0][0]["drivers"]
    drivers["full-view"] = "FASTER" if drivers["full-view"] == "SLOWER" else "SLOWER"


def _ended(tree: dict[str, Any]) -> None:
    end = next(e["end"] for level in tree["levels"] for p in level for e in p["edges"] if e["end"])
    end["time_s"] = 0.001


def _conflicted(tree: dict[str, Any]) -> None:
    tree["levels"][0][0]["edges"][0]["ttc_s"] = 0.5


def _stopped(record: dict[str, Any]) -> None:
    for graph in record["graphs"].values():
        for node in graph["nodes"]:
            node["speed_mps"] = 0.0


def _far(record: dict[str, Any]) -> None:
    record["distance_m"] = dict.fromkeys(record["distance_m"], 999.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of_tree", "of_scenes"),
    [(_unsent, None), (_braked, None), (_ended, None), (_conflicted, None), (None, _unsent), (None, _stopped),
     (None, _far)],
    ids=["danger", "drivers", "end", "conflict", "danger of scenes", "graphs", "distances"],
)  # fmt: skip
def test_whatever_a_tree_says_is_held_against_its_seed(
    of_tree: Callable[[Any], None] | None, of_scenes: Callable[[Any], None] | None,
    built: tuple[Path, list[Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Ids hold a digest of the state, but not of what vehicles see, and what a score is made of."""
    path, frozen = built
    shutil.copytree(path, tmp_path / "tune")
    monkeypatch.setattr("harness.dataset.freeze.freeze", lambda scenario, seeds: frozen)
    assert list(rebuilt.differences(load(path))) == []
    relabel(tmp_path / "tune", {0: 1}, of_tree, of_scenes)
    assert list(rebuilt.differences(load(tmp_path / "tune"))) == [
        "layout 0 is not what layout seed 1 gives"
    ]


@pytest.mark.slow
def test_typing_a_command_again_draws_no_other_layouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = load(find("occluded-intersection-v3"), 50)
    draws = {tuple(rebuilt.drawn(dataset, 3)) for _ in range(9)}
    assert len(draws) == 1
    monkeypatch.setattr("platform.node", lambda: "another")
    assert tuple(rebuilt.drawn(dataset, 3)) not in draws
    assert tuple(rebuilt.drawn(load(find("occluded-intersection-v2"), 50), 3)) not in draws


@pytest.mark.slow
@pytest.mark.parametrize(
    "typed",
    [
        "model calibrate {run} --dataset {data} --out calibrations/mine.toml",
        "study schedule compare {other} --tune {run} --out schedules",
        "dataset export {data} --out calibrations",
    ],
)
def test_nothing_fits_or_learns_there_or_is_published_to_learn_from(
    typed: str, relabelled: Path, run_of_it: Path, proxy_run: Path, harness: Harness, tmp_path: Path
) -> None:
    run, other = (
        shutil.copytree(each, tmp_path / each.parent.name) for each in (run_of_it, proxy_run)
    )
    code, out, error = harness(*typed.format(run=run, other=other, data=relabelled).split())
    assert (code, error.count("\n")) == (2, 1), (out, error)
    assert "is not what layout seed" in error
    assert not (tmp_path / "calibrations").exists()


@pytest.mark.slow
def test_what_is_not_rebuilt_is_said(
    relabelled: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rebuilt, "find_spec", lambda name: None)
    rebuilt.refuse(load(relabelled))
    said = "whether its layouts are those of its seeds is not checked, which needs highway-env"
    assert said in capsys.readouterr().err


@pytest.mark.exhaustive
def test_scenes_that_a_command_reports_are_not_tuned_on(tmp_path: Path) -> None:
    """Whatever seeds they have: the vehicles of a first scene tell."""
    build(scenarios.get(NAME), tmp_path / "tune", 2, 10, 1, lambda done: None)
    build(scenarios.get(NAME), tmp_path / "report", 2, SEED, 1, lambda done: None)
    relabel(tmp_path / "report", {0: 7, 1: 8})
    tune, report = load(tmp_path / "tune"), load(tmp_path / "report")
    rebuilt.refuse(tune, [report])
    with pytest.raises(
        UserError, match=r"has scene 0000\d-0-.*, which is scene 0000\d-0-.* of tune"
    ):
        rebuilt.refuse(tune, [tune])


@pytest.mark.slow
def test_released_layouts_under_other_seeds_are_known(tmp_path: Path) -> None:
    shipped = load(find("occluded-intersection-v3"), 1)
    build(shipped.scenario, tmp_path / "mine", 1, 200_000, 1, lambda done: None)
    relabel(tmp_path / "mine", {0: 0})
    with pytest.raises(
        UserError, match="of occluded-intersection-v3, and numbers are reported of that"
    ):
        rebuilt.refuse(load(tmp_path / "mine"))


@pytest.mark.slow
def test_a_check_without_the_simulator_says_that_nothing_was_built(
    small_path: Path, harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (rebuilt, checking):
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    code, out, _ = harness("dataset", "check", small_path)
    assert code == 0
    assert "no layout was built again from its seed, since highway-env is not installed" in out
    assert json.loads(harness("dataset", "check", small_path, "--json")[1])["built_again"] is False


def test_a_start_is_that_of_another_scenario_wherever_it_lies_and_whoever_it_shows() -> None:
    state = World.start(scenarios.get(NAME), SEED).state()
    start = Start.of("one", state)

    def other(count: int, faster_mps: float = 0.0, turned_rad: float = 0.3) -> Start:
        """Return what another recording has of it, of so many of its vehicles: elsewhere, turned."""
        cos, sin = math.cos(turned_rad), math.sin(turned_rad)
        ego, *others = state.vehicles[:count]
        vehicles = [replace(ego, speed_mps=ego.speed_mps + faster_mps), *others]
        moved = []
        for v in vehicles:
            x_m, y_m = v.x_m * cos - v.y_m * sin + 7, v.x_m * sin + v.y_m * cos - 9
            heading_rad = v.heading_rad + turned_rad
            moved.append(replace(v, id=f"{v.id}0", x_m=x_m, y_m=y_m, heading_rad=heading_rad))
        return Start.of("other", replace(state, vehicles=tuple(moved)))

    count = len(state.vehicles)
    assert count > 2
    assert start.is_part(other(count))
    assert start.is_part(other(count, turned_rad=0.0))
    assert start.is_part(other(count, turned_rad=3.0))
    assert other(2).is_part(start)
    assert not start.is_part(other(count, 0.1))
    assert not start.is_part(other(1)), "an ego alone says nothing"


def test_a_difference_of_a_rounding_makes_no_other_layout() -> None:
    [vehicle, *_] = World.start(scenarios.get(NAME), SEED).state().vehicles
    assert rebuilt._coarse(replace(vehicle, x_m=vehicle.x_m + 1e-9)) == rebuilt._coarse(vehicle)
    assert rebuilt._coarse(replace(vehicle, x_m=vehicle.x_m + 0.1)) != rebuilt._coarse(vehicle)
