"""A grid: every ego agent with every helper agent, and what each choice is worth."""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from evaluating import Watched, run, same_decisions, spec_of
from run_on_disk import answers_of

from harness.backends import cards
from harness.backends.proxy import Proxy
from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate.agent import Agent
from harness.evaluate.spec import Spec
from harness.extensions.mixed_helpers.grid.command import _combinations
from harness.extensions.mixed_helpers.grid.study import (
    Cell,
    Grid,
    front,
    grid_study,
    headline,
    run_cells,
)
from harness.prompts import versions
from harness.report.drawing.colours import INK
from harness.runs.headline import BALANCED, SUCCESS
from harness.runs.metric_names import LATENCY
from harness.runs.settings import Settings
from harness.runs.success import Success
from harness.studies.figures.described import Steps
from harness.studies.study import write_study

pytestmark = pytest.mark.usefixtures("svg_alone")


def agent(model: str = "proxy", prompt: str = "v2") -> Agent:
    return Agent(cards.resolve(model), versions.load(prompt))


def spec(data: Dataset) -> Spec:
    return spec_of(data, points=(POINTS["single-local"], POINTS["6g"]))


def played(data: Dataset, out: Path, done: Callable[[int], None] = lambda n: None) -> Grid:
    both = [agent("proxy"), agent("proxy-faulty")]
    return run_cells(spec(data), both, both, out, Watched(done), None)


@pytest.fixture(scope="module")
def grid(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Grid:
    return played(small, tmp_path_factory.mktemp("grid"))


@pytest.mark.slow
def test_a_cell_is_the_run_of_its_mix(grid: Grid, small: Dataset, tmp_path: Path) -> None:
    for cell in grid.cells[1:2]:  # whose helpers are others than its ego
        alone = replace(spec(small), ego=cell.ego, helpers=(cell.helper,))
        out = run(alone, tmp_path / cell.run.path.name).out
        assert same_decisions(out, cell.run.path)
        assert sorted(a.id for a in answers_of(out)) == sorted(a.id for a in cell.run.answers)


@pytest.mark.slow
def test_an_agent_is_asked_once_in_a_role_about_a_decision_point(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, str]] = []
    complete = Proxy.complete

    def noted(self: Proxy, requests: Sequence[Any]) -> Any:
        asked.extend((id(self), request.id) for request in requests)
        return complete(self, requests)

    monkeypatch.setattr(Proxy, "complete", noted)
    played(small, tmp_path / "grid")
    assert len(asked) == len(set(asked)) > 100


@pytest.mark.exhaustive
def test_a_stopped_grid_goes_on_and_asks_only_what_is_missing(
    small: Dataset, tmp_path: Path
) -> None:
    whole, again = played(small, tmp_path / "grid"), list[int]()
    played(small, tmp_path / "grid", again.append)
    assert again == []
    shutil.rmtree(tmp_path / "grid/cells/2-2")
    last = played(small, tmp_path / "grid")
    assert [c.estimate(SUCCESS, "6g") for c in last.cells] == [
        c.estimate(SUCCESS, "6g") for c in whole.cells
    ]
    others = [agent("proxy", "v1"), agent("proxy-faulty")]
    with pytest.raises(UserError, match="prompt"):
        run_cells(spec(small), others, others, tmp_path / "grid", Watched(), None)


# -- effects, played by hand -----------------------------------------------------------------------


def made_up(
    success: Mapping[tuple[str, str], Sequence[float]], dangerous: Sequence[int] = ()
) -> Grid:
    """Cells by prompt of ego and helpers: success of each episode under 6g, one seed."""
    n = len(next(iter(success.values())))
    told = {
        "conditions": ("6g",), "grid": 0, "path": Path("cells"), "clusters": None,
        "manifest": SimpleNamespace(conditions=[{"name": "6g", "profile": "6g"}]),
    }  # fmt: skip
    cells = []
    for (ego, helper), values in success.items():
        cell = Cell(agent(prompt=ego), agent(prompt=helper), SimpleNamespace(**told))  # type: ignore[arg-type]
        of = {SUCCESS: np.array(values).reshape(1, 1, n), LATENCY: np.full((1, 1, n), 100.0)}
        cell.__dict__["values"] = of
        cells.append(cell)
    return Grid(tuple(cells), 2, 2, Success(np.array(dangerous or [0] * n, dtype=bool)))


def test_main_effects_and_the_interaction_are_those_of_a_factorial() -> None:
    """v2's helpers succeed in 2 of 4 more; with ego v2 as well in the last one."""
    of = {
        ("v1", "v1"): [0, 0, 0, 0], ("v1", "v2"): [1, 1, 0, 0],
        ("v2", "v1"): [0, 0, 0, 0], ("v2", "v2"): [1, 1, 1, 0],
    }  # fmt: skip
    effects = {e.what: e.estimate for e in made_up(of).effects}
    assert {what: e.value for what, e in effects.items()} == pytest.approx({
        "ego prompt: v1 → v2": 0.125,
        "helper prompt: v1 → v2": 0.625,
        "ego prompt → v2 × helper prompt → v2": 0.125,
    })  # fmt: skip
    assert all(e.n == 4 and e.low < e.value < e.high for e in effects.values())


def test_effects_halves_and_the_front_go_by_balanced_success_where_it_leads() -> None:
    """Helpers of v2 win both dangers and lose 1 of 8 harmless episodes: half of 1 - 1/8 in all."""
    of = {
        (ego, helper): ([0] * 2 + [1] * 8 if helper == "v1" else [1] * 9 + [0])
        for ego in ("v1", "v2") for helper in ("v1", "v2")
    }  # fmt: skip
    grid = made_up(of, [1] * 2 + [0] * 8)
    assert grid.success_rule.metric == BALANCED
    [effect] = [e for e in grid.effects if e.what == "helper prompt: v1 → v2"]
    assert (effect.estimate.value, effect.estimate.n) == (pytest.approx((1 - 1 / 8) / 2), 10)
    assert grid.success(front(grid, "6g")[-1], "6g").value == pytest.approx((1 + 7 / 8) / 2)
    halves = grid.halves("6g")
    assert halves is not None
    assert halves.helpers.value == pytest.approx(1)


def test_holms_method_counts_every_effect() -> None:
    rng = np.random.default_rng(1)
    of = {
        (ego, helper): (rng.random(60) < (0.9 if helper == "v2" else 0.3)).astype(float).tolist()
        for ego in ("v1", "v2") for helper in ("v1", "v2")
    }  # fmt: skip
    clear = [e.what for e in made_up(of).effects if e.clear]
    assert clear == ["helper prompt: v1 → v2"]


def test_the_half_that_matters_is_named() -> None:
    rng = np.random.default_rng(2)
    of = {
        (ego, helper): (rng.random(80) < (0.95 if helper == "v2" else 0.2)).astype(float).tolist()
        for ego in ("v1", "v2") for helper in ("v1", "v2")
    }  # fmt: skip
    halves = made_up(of).halves("6g")
    assert halves is not None
    assert halves.ego.value + halves.helpers.value + halves.together.value == pytest.approx(1)
    assert halves.helpers.value > 0.9
    assert halves.apart.high < 0
    [said] = headline(made_up(of))
    assert said.startswith(
        "Under 6g, the choice of the helpers matters more: the choice among 2 egos"
    )


def test_cells_that_do_not_differ_have_no_half_that_matters() -> None:
    of = {(ego, helper): [1.0, 0.0, 1.0] for ego in ("v1", "v2") for helper in ("v1", "v2")}
    [said] = headline(made_up(of))
    assert said == (
        "Under 6g, success of the 4 combinations is 66.7 to 66.7 %; 0 of 3 effects are more than "
        "chance explains (n = 3)."
    )


def test_cells_that_differ_in_one_episode_alone_say_nothing_of_halves() -> None:
    of = {("v1", "v1"): [1.0] * 12, ("v1", "v2"): [1.0] * 12, ("v2", "v1"): [1.0] * 12}
    assert made_up({**of, ("v2", "v2"): [0.0] + [1.0] * 11}).halves("6g") is None


def test_the_front_is_what_none_beats_without_taking_longer() -> None:
    grid = made_up(
        {("v1", "v1"): [1, 0], ("v1", "v2"): [1, 1], ("v2", "v1"): [0, 0], ("v2", "v2"): [1, 1]}
    )
    for cell, ms in zip(grid.cells, (100, 200, 150, 300), strict=True):
        cell.values[LATENCY][:] = ms
    names = [(c.ego.prompt.version, c.helper.prompt.version) for c in front(grid, "6g")]
    assert names == [("v1", "v1"), ("v1", "v2")]


@pytest.mark.slow
def test_a_grid_s_folder_has_page_tables_and_pictures(grid: Grid, small: Dataset) -> None:
    pytest.importorskip("matplotlib", reason="needs the report extra")
    out = grid.cells[0].run.path.parent.parent
    (out / "cells/1-2/report.html").write_text("what `harness report` wrote")
    page = write_study(grid_study(grid, spec(small), out), out).read_text()
    cells, effects = pd.read_csv(out / "cells.csv"), pd.read_csv(out / "effects.csv")
    assert len(cells) == 4 * 2 * 4
    assert len(effects) == 3 * 2
    assert set(cells[cells.metric != "tokens"].n) == set(effects.n) == {len(small.episodes)}
    made = json.loads((out / "grid.json").read_text())
    assert made["cells"] == ["cells/1-1", "cells/1-2", "cells/2-1", "cells/2-2"]
    for name in ("heat-map", "pareto"):
        assert (out / f"{name}.svg").stat().st_size > 1000
    assert "proxy-faulty · v2 · json" in page
    assert (
        page.count("<a href=") == page.count('<a href="cells/1-2/report.html">cells/1-2</a>') == 2
    )


def test_names_in_the_figure_stay_inside_of_its_axes() -> None:
    drawing = pytest.importorskip("harness.studies.figures.points", reason="needs the report extra")
    steps = [Steps("", [x], [x], INK, name=letter * 30) for x, letter in ((0.0, "a"), (100.0, "b"))]
    figure = drawing.fronts([("", "latency of a decision, ms", steps)], "success")
    figure.draw_without_rendering()
    [axes] = figure.axes
    for name in axes.texts:
        box = name.get_window_extent()
        assert axes.bbox.x0 < box.x0 < box.x1 < axes.bbox.x1


def test_letters_and_reversed_lists_are_of_read_outs_alone() -> None:
    asked = Settings(
        model="swarm-tiny", prompt="v2", answer="json,readout", letters="cyclic", flip=True
    )
    given = _combinations(asked, "--", ("json", "readout"))
    assert [(one.answer, one.letters, one.flip) for one in given] == [
        ("json", None, False),
        ("readout", "cyclic", True),
    ]


@pytest.mark.exhaustive
def test_letters_are_those_of_the_agents_that_read_out(
    harness: Callable[..., Any], small_path: Path, tmp_path: Path
) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    few = (
        "--dataset",
        str(small_path),
        "--limit",
        "1",
        "--seeds",
        "0:1",
        "--condition",
        "single-local",
    )
    asked = (
        "study",
        "grid",
        "--model",
        "swarm-tiny",
        "--answer",
        "json,readout",
        "--helper-answer",
        "json",
    )
    code, _, err = harness(
        *asked, "--letters", "cyclic", *few, "--out", str(tmp_path / "grid"), "--quiet"
    )
    assert code == 0, err
    stated = [
        json.loads(file.read_text()) for file in sorted((tmp_path / "grid").rglob("run.json"))
    ]
    assert {(of["answer"], of.get("letters")) for of in stated} == {
        ("json", "raw"),
        ("readout", "cyclic"),
    }
    code, _, err = harness("study", "grid", "--prompt", "v1,v2", "--letters", "cyclic", *few)
    assert code == 2
    assert err == (
        "harness: --letters cyclic: proxy answers in json; leave it out, or give a language model "
        "and --answer readout\n"
    )


@pytest.mark.exhaustive
def test_a_grid_takes_every_setting_of_an_evaluation(
    harness: Callable[..., Any], small_path: Path, tmp_path: Path
) -> None:
    few = (
        "--dataset",
        str(small_path),
        "--limit",
        "1",
        "--seeds",
        "0:1",
        "--condition",
        "single-local",
    )
    both = (
        "study",
        "grid",
        "--model",
        "proxy",
        "--prompt",
        "v2",
        "--helper-model",
        "proxy,proxy-faulty",
    )
    code, _, err = harness(
        *both, *few, "--sums", "divide", "--tag", "sums", "--out", str(tmp_path / "grid")
    )
    assert code == 0, err
    stated = [
        json.loads(file.read_text()) for file in sorted((tmp_path / "grid").rglob("run.json"))
    ]
    assert [(run["sums"], run["tags"], run["ask"]) for run in stated] == [
        ("divide", ["sums"], "all")
    ] * 2
