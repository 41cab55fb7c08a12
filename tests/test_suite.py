"""A suite: datasets of several families evaluated together, from the command to the page of all."""

import json
import re
import shutil
from collections.abc import Callable
from html import unescape
from pathlib import Path
from shutil import copytree, rmtree
from typing import Any

import pytest
from evaluating import same_files
from run_on_disk import configure
from starlette.testclient import TestClient
from tiers import some

from harness.core.statistics import mean_of, paired_difference
from harness.dataset.build import build
from harness.report.words import compared
from harness.runs.headline import BALANCED, PAIRED
from harness.runs.listing import runs
from harness.runs.metric_values import of_ends
from harness.runs.metrics import METRICS
from harness.runs.suite import read
from harness.world import scenarios

pytestmark = pytest.mark.slow

Said = tuple[int, str, str]
Harness = Callable[..., Said]
Once = Callable[[str, Callable[[Path], object]], Path]
EVAL = ("eval", "--dataset", "suite:two", "--seeds", "0:2")
DONE = Path("reports/proxy-v2-v4-two")
SUITES = """
[two]
description = "Two families"
datasets = ["small", "exits"]
"""


@pytest.fixture(scope="session")
def exits_path(once: Once) -> Path:
    return once(
        "exits",
        lambda out: build(scenarios.get("parking-exit"), out, 2, 5000, 1, lambda done: None),
    )


@pytest.fixture
def project(harness: Harness, tmp_path: Path, small_path: Path, exits_path: Path) -> Harness:
    """The command, typed in a project that has a suite of two datasets."""
    (tmp_path / "datasets").mkdir()
    (tmp_path / "swarmdrive.toml").touch()
    for name, path in (("small", small_path), ("exits", exits_path)):
        (tmp_path / "datasets" / name).symlink_to(path)
    (tmp_path / "datasets/suites.toml").write_text(SUITES)
    return harness


@pytest.fixture
def evaluated(project: Harness, once: Once) -> Harness:
    """The same project, after the suite was evaluated (once for all tests)."""

    def fill(folder: Path) -> None:
        code, out, err = project(*EVAL)
        assert (code, err) == (0, "")
        DONE.rename(folder)
        folder.with_suffix(".txt").write_text(out)

    made = once("suite", fill)
    copytree(made, DONE)
    shutil.copy(made.with_suffix(".txt"), "out.txt")
    return project


def test_a_suite_is_a_run_of_each_dataset_their_means_and_a_page(evaluated: Harness) -> None:
    out = Path("out.txt").read_text()
    assert max(map(len, out.splitlines())) <= 80
    lines = out.splitlines()
    assert lines[0] == "proxy · prompt v2 and v4 (not read) · json · suite two"
    assert lines[-2] == f"wrote {DONE / 'report.html'}"
    assert lines[-1] == "next: harness eval --model local-view --dataset suite:two --seeds 0,1"
    for name in ("occluded-intersection", "parking-exit", "mean over families"):
        assert sum(line.startswith(name) for line in lines) == 1, "success"
    assert {path.name for path in DONE.iterdir()} == {
        "small", "exits", "suite.json", "summary.csv", "report.html",
    }  # fmt: skip
    assert (DONE / "exits/report.html").is_file()


def test_a_run_of_a_suite_is_what_it_is_alone(evaluated: Harness) -> None:
    code, _, err = evaluated("eval", "--dataset", "exits", "--seeds", "0:2", "--out", "alone")
    assert (code, err) == (0, "")
    assert same_files(Path("alone"), DONE / "exits")


def test_means_weight_families_alike_and_join_their_intervals(evaluated: Harness) -> None:
    suite = read(DONE)
    assert list(suite.runs) == ["occluded-intersection", "parking-exit"]
    for metric in ("success_rate", "unsafe_rate", "latency_proxy_ms"):
        scores = [run.score("6g", metric) for run in suite.runs.values()]
        expected = mean_of([score.estimate for score in scores if score])
        found = suite.score("6g", metric)
        assert found
        assert (found.value, found.low, found.high) == pytest.approx(
            (expected.value, expected.low, expected.high), nan_ok=True
        )
        assert found.value == pytest.approx(
            sum(s.value for s in scores if s and s.value is not None) / 2
        )
    assert found.n == 6, "four layouts and two"


def test_a_gain_takes_the_layouts_of_all_families_together(evaluated: Harness) -> None:
    suite = read(DONE)
    differences = []
    for run in suite.runs.values():
        by = dict(
            zip(
                run.conditions,
                of_ends(METRICS["success_rate"], run.grid, run.episodes),
                strict=True,
            )
        )
        differences.append((by["6g"] - by["single-local"]).mean(axis=0))
    expected = paired_difference(differences)
    gain = suite.score("6g", "success_gain_over_single-local")
    assert gain
    assert (gain.value, gain.low, gain.high, gain.n, gain.interval) == (
        expected.value, expected.low, expected.high, 6, PAIRED,
    )  # fmt: skip


def test_a_gain_that_no_run_can_have_is_no_traceback(evaluated: Harness, tmp_path: Path) -> None:
    copytree(DONE, tmp_path / "suite")
    for summary in tmp_path.glob("suite/*/summary.csv"):
        stated = (
            "proxy,v2,json,,nowhere,success_gain_over_single-local,0.5,0.1,0.6,4,0,paired "
            "episodes\n"
        )
        summary.write_text(summary.read_text() + stated)
    suite = read(tmp_path / "suite")
    strange = suite.score("nowhere", "success_gain_over_single-local")
    assert strange
    assert strange.value == 0.5
    before = read(DONE).score("6g", "success_gain_over_single-local")
    assert suite.score("6g", "success_gain_over_single-local") == before


def test_json_has_every_family_and_the_means(project: Harness) -> None:
    code, out, err = project(*EVAL, "--json", "--limit", "1")
    told: dict[str, Any] = json.loads(out, parse_constant=pytest.fail)
    assert (code, err, told["suite"]) == (0, "", "two")
    assert list(told["families"]) == ["occluded-intersection", "parking-exit"]
    of_family = told["families"]["parking-exit"]
    assert of_family["manifest"]["world"]["name"] == "exits"
    assert of_family["drivers"]["full-view"]["value"] == 1.0
    rows = {(r["condition"], r["metric"], r["interval"]): r for r in told["mean"]["summary"]}
    assert rows["6g", "success_rate", "episodes"]["n"] == 2
    assert rows["6g", "success_gain_over_single-local", PAIRED]["ci_low"] is None, (
        "one episode bounds nothing"
    )


def test_the_same_command_goes_on_and_a_finished_suite_is_refused(evaluated: Harness) -> None:
    before = (DONE / "summary.csv").read_text()
    kept = (DONE / "small/answers.jsonl").stat().st_mtime_ns
    rmtree(DONE / "exits")  # as if it was killed between the two
    for name in ("suite.json", "summary.csv", "report.html"):
        (DONE / name).unlink()
    code, _, err = evaluated(*EVAL)
    assert (code, err) == (0, "")
    assert (DONE / "summary.csv").read_text() == before
    assert (DONE / "small/answers.jsonl").stat().st_mtime_ns == kept
    code, out, err = evaluated(*EVAL, "--out", DONE)
    assert (code, out) == (2, "")
    assert err == (
        f"harness: --out {DONE} already holds a finished suite; choose another folder or delete "
        "it\n"
    )


def test_other_settings_do_not_go_on(evaluated: Harness) -> None:
    (DONE / "suite.json").unlink()
    code, _, err = evaluated(*EVAL[:-1], "0:1", "--out", DONE)
    assert code == 2
    assert err.startswith(
        f"harness: --out {DONE / 'small'} was begun with --seeds 0,1, and not with --seeds 0:1"
    )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ("--dataset", "suite:tow"),
            "unknown suite 'tow'; did you mean 'two'? known: two, v2v-safety, v2v",
        ),
        (("--prompt", "v2"), "--prompt v2 speaks of a crossing, which parking-exit is not; "),
        (("--latency", "measured"), "--latency measured: "),
    ],
)
def test_bad_input_is_one_line_before_anything_is_asked(
    project: Harness, options: tuple[str, str], said: str
) -> None:
    code, out, err = project(*EVAL, *options)
    assert (code, out) == (2, "")
    assert err.startswith(f"harness: {said}")
    assert err.count("\n") == 1
    assert not Path("reports").exists()


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('two = "small"', "suite two in {file} is no table; give it a description and datasets"),
        ("[two]\ndescription = ''\ndatasets = []", 
            "suite two in {file}: datasets = []; allowed: a list of datasets' names, one or more"),
        ("[two]\ndescription = ''", "suite two in {file} has no datasets; add it"),
        (
            "[two]\ndescription = ''\ndatasets = "
            "['small', 'exits']\nweight = 1", "unknown key in suite two in "
         "{file} 'weight'; known: datasets, description"),
        ("[two]\ndescription = ''\ndatasets = ['none']", "unknown dataset 'none'; known: "),
        (
            "[two]\ndescription = "
            "''\ndatasets = ['small', "
            "'small']", "suite two has occluded-intersection "
         "twice; give each family one dataset"),
        (
            "[v2v-safety]\ndescription = "
            "''\ndatasets = ['small']\n[two]", "suite two in {file} has no "
         "description; add it"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_one_line(project: Harness, table: str, said: str) -> None:
    file = Path("datasets/suites.toml").absolute()
    file.write_text(table)
    code, out, err = project(*EVAL)
    assert (code, out) == (2, "")
    assert err.startswith(f"harness: {said.format(file=file)}")


def test_a_suite_of_the_project_may_not_have_a_shipped_ones_name(project: Harness) -> None:
    Path("datasets/suites.toml").write_text(SUITES.replace("two", "v2v-safety"))
    code, _, err = project("eval", "--dataset", "suite:v2v-safety")
    assert code == 2
    assert err.startswith(
        "harness: suite v2v-safety is in this project and ships with the harness; "
    )


def test_a_dry_run_counts_every_dataset(project: Harness) -> None:
    code, out, err = project(*EVAL, "--dry-run")
    assert (code, err) == (0, "")
    assert [line.split(":")[0] for line in out.splitlines() if "requests" in line] == [
        "small",
        "exits",
    ]
    assert not Path("reports").exists()


def test_the_page_has_families_by_conditions_and_leads_to_each(evaluated: Harness) -> None:
    page = (DONE / "report.html").read_text()
    for family, folder in (("occluded-intersection", "small"), ("parking-exit", "exits")):
        assert f'<a href="{folder}/report.html">{family}</a>' in page
        assert (DONE / folder / "report.html").is_file()
    for score in (
        read(DONE).score(c, "balanced_success_rate") for c in ("single-local", "v2x", "6g")
    ):
        assert f"<dd>{100 * score.value:.1f} %" in page
    code, out, err = evaluated("report", DONE, "--out", "again.html")
    assert (code, err, out) == (0, "", "wrote again.html\n")
    assert Path("again.html").read_text() == page.replace('href="', f'href="{DONE}/')


@pytest.mark.exhaustive
def test_a_loss_has_one_minus_on_the_page(project: Harness) -> None:
    code, _, err = project(*EVAL, "--control", "shuffled-messages")
    assert (code, err) == (0, "")
    gains = [
        s.value for s in read(DONE).scores if s.metric == "balanced_success_gain_over_single-local"
    ]
    assert min(gains) < 0, "messages of other layouts lose episodes"
    page = (DONE / "report.html").read_text()
    shown = re.findall(r'<span class="gain \w*">(?:[✓✗] )?([^<]*)<', page)
    assert f"{100 * min(gains):.1f} points" in shown


def test_what_bounds_a_suites_numbers_stands_above_them(evaluated: Harness) -> None:
    page = unescape((DONE / "report.html").read_text())
    assert (
        page.index("episodes: the interval of a rate")
        < page.index("reads no prompt")
        < page.index("</table>")
    )
    assert (
        page.index("</table>") < page.index("latency: ego ") < page.index("as means over families.")
    )


def test_an_exported_suite_leads_to_the_pages_of_its_runs(evaluated: Harness) -> None:
    assert evaluated("view", "reports", "--export", "site")[0] == 0
    for page in (Path("site/index.html"), Path("site") / DONE.name / "report.html"):
        links = re.findall('<a href="([^"#]+)"', page.read_text())
        assert len(links) == 3
        assert all((page.parent / link).is_file() for link in links)
    rmtree("site")


@pytest.mark.exhaustive
def test_suites_are_reported_side_by_side_and_not_with_runs(evaluated: Harness) -> None:
    code, _, err = evaluated(
        *EVAL, "--model", "local-view", "--condition", "single-local", "--limit", "1"
    )
    assert (code, err) == (0, "")
    other = Path("reports/local-view-v2-v4-two")
    code, out, err = evaluated("report", DONE, other, "--out", "both.html")
    assert (code, out, err) == (0, "wrote both.html\n", "")
    page = Path("both.html").read_text()
    assert page.index("proxy · v2 and v4 · json on two") < page.index(
        "local-view · v2 and v4 · json on two"
    )
    code, out, err = evaluated("report", DONE, other / "small", "--out", "both.html")
    assert (code, out) == (2, "")
    assert (
        err == f"harness: {other / 'small'} is no suite, but others are; write separate reports\n"
    )


def test_a_command_on_one_run_says_that_a_suite_has_several(evaluated: Harness) -> None:
    code, out, err = evaluated("compare", DONE, DONE / "small")
    assert (code, out) == (2, "")
    assert err == f"harness: {DONE} is a suite; give the folder of one of its runs\n"


def test_ls_lists_a_suite_above_its_runs_with_its_mean(evaluated: Harness) -> None:
    found = {one.name: one for one in runs(Path("reports"))}
    assert list(found) == [DONE.name, f"{DONE.name}/exits", f"{DONE.name}/small"]
    suite, best = found[DONE.name], read(DONE).score(found[DONE.name].condition, BALANCED)
    assert suite.condition == compared(read(DONE))[0]
    assert (suite.kind, suite.state, suite.model, suite.prompt) == (
        "suite",
        "finished",
        "proxy",
        "v2 and v4",
    )
    assert (suite.success, suite.low, suite.high) == (best.value, best.low, best.high)
    assert "  suite proxy · v2 and v4 · json" in evaluated("run", "ls")[1]


@pytest.mark.parametrize(
    "families",
    ["{}", '{"a": ".."}', '{"a": "/etc"}', '{"a": "none"}', '{"a": 1}', "[]", '{"a": "."}'],
)
def test_a_broken_suite_is_one_line(evaluated: Harness, families: str) -> None:
    (DONE / "suite.json").write_text(
        f'{{"format": "swarmdrive-suite/1", "name": "two", "description": "", "families": '
        f"{families}}}"
    )
    [suite] = [one for one in runs(Path("reports")) if one.kind == "suite"]
    assert (suite.state, suite.why) == ("broken", "suite.json")
    code, out, err = evaluated("report", DONE)
    assert (code, out, err.count("\n")) == (2, "", 1)


def test_view_opens_a_suite_with_links_to_its_runs_and_none_whose_files_lead_out(
    evaluated: Harness,
) -> None:
    view, access = (
        pytest.importorskip(f"harness.extensions.view.{name}") for name in ("app", "access")
    )
    shown = view.app(Path("reports").absolute(), "token")
    browser = TestClient(shown, base_url="http://127.0.0.1", cookies={access.cookie(80): "token"})
    page = browser.get("/run", params={"path": DONE.name})
    assert page.status_code == 200
    for family, folder in (("occluded-intersection", "small"), ("parking-exit", "exits")):
        assert f'<a href="/run?path={DONE.name}%2F{folder}">{family}</a>' in page.text
    assert browser.get("/run", params={"path": f"{DONE.name}/exits"}).status_code == 200
    summary = DONE / "exits/summary.csv"
    summary.rename("outside.csv")
    summary.symlink_to(Path("outside.csv").absolute())
    assert browser.get("/run", params={"path": DONE.name}).status_code == 400


def edited(file: Path, before: str, after: str) -> None:
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after, 1))


def flattered(row: str) -> str:
    """Return a row of a summary with a success of 98.7 %."""
    cells = row.split(",")
    cells[6] = "0.987"
    return ",".join(cells)


@pytest.mark.parametrize(
    "change",
    some(["a mean"], exhaustive=["a mean that is left out", "one that is none", "a family twice"]),
)
def test_a_suites_own_table_is_held_against_its_runs(change: str, evaluated: Harness) -> None:
    best = next(one for one in runs(Path("reports")) if one.kind == "suite")
    table = DONE / "summary.csv"
    [row] = [
        line
        for line in table.read_text().splitlines()
        if ",6g,success_rate," in line and "episodes" in line
    ]
    if change == "a mean":
        edited(table, row, flattered(row))
        said = "summary.csv has success_rate 0.987 in 6g (episodes), and its runs make it "
    elif change == "a mean that is left out":
        edited(table, row + "\n", "")
        said = "summary.csv lacks success_rate in 6g (episodes)"
    elif change == "one that is none":
        edited(table, row, row + "\n" + flattered(row).replace("success_rate", "safe_rate"))
        said = "summary.csv has safe_rate 0.987 in 6g (episodes), which is no mean over its runs"
    else:
        edited(DONE / "suite.json", '"exits"', '"small"')
        said = "suite.json has two families of the same scenes"
    code, out, _ = evaluated("run", "check", DONE)
    assert code == 1
    assert said in " ".join(out.split())
    if change == "a mean":
        code, out, error = evaluated("report", DONE)
        assert (code, out, error.count("\n")) == (2, "", 1)
        assert f"{DONE} contradicts itself: " in error
    if change != "a family twice":
        assert best == next(one for one in runs(Path("reports")) if one.kind == "suite"), (
            "ls reads its runs"
        )


def test_a_suite_with_a_run_by_older_rules_is_held_by_value_alone_and_said_to_be(
    evaluated: Harness,
) -> None:
    stated = json.loads((DONE / "small/run.json").read_text())["versions"]
    configure(DONE / "small", versions={**stated, "figures": "1"})
    table = DONE / "summary.csv"
    table.write_text(table.read_text().replace(",8,", ",400,"))
    _, out, _ = evaluated("run", "check", DONE)
    words = " ".join(out.split())
    assert f"{DONE}: equal where it can be checked: " in words
    assert (
        "Its means are held by value alone, not their intervals and n: run.json of small" in words
    )


def test_a_run_counts_for_the_family_whose_scenes_it_has(evaluated: Harness) -> None:
    edited(DONE / "suite.json", '"parking-exit"', '"roundabout"')
    code, out, error = evaluated("report", DONE)
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert "has a run of parking-exit as that of roundabout" in error


def test_a_suite_that_lacks_a_dataset_of_its_name_is_named(evaluated: Harness) -> None:
    suites = Path("datasets/suites.toml")
    suites.write_text(suites.read_text().replace('"small", ', '"small", "blind-merge-v2", '))
    code, out, _ = evaluated("run", "check", DONE)
    assert code == 1
    assert "suite.json has 2 of the 3 datasets of suite" in " ".join(out.split())


@pytest.mark.parametrize("name", ["ties", "latency", "sampling_seed"])
def test_runs_of_a_suite_have_the_same_settings(name: str, evaluated: Harness) -> None:
    folder = DONE / "exits"
    stated = json.loads((folder / "run.json").read_text())
    changes: dict[str, dict[str, object]] = {
        "ties": {"ties": "first", "settings": {**stated["settings"], "ties": "first"}},
        "latency": {"latency": {**stated["latency"], "source": "declared", "ego_s": 0.001}},
        "sampling_seed": {
            "settings": {**stated["settings"], "sampling_seed": 1},
            "sampling_seed": 1,
        },
    }
    configure(folder, **changes[name])
    code, out, error = evaluated("report", DONE)
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert "has another model, other conditions, seeds or settings than" in error


def test_a_suite_that_nobody_changed_is_equal(evaluated: Harness) -> None:
    code, out, _ = evaluated("run", "check", DONE)
    assert (code, "not equal" in out) == (0, False)
    assert re.search(rf"{DONE}: equal: \d+ means, computed again from its\s+runs", out)


def test_a_family_has_a_folder_in_that_of_the_suite(evaluated: Harness) -> None:
    edited(DONE / "suite.json", '"exits"', '""')
    code, out, error = evaluated("report", DONE)
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert "families: none, or one outside this folder" in error
