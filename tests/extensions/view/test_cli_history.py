"""`harness run history`: a metric over runs, which only compare on the same scenes."""

import json
import re
from collections.abc import Callable
from html import unescape
from pathlib import Path
from shutil import copytree, rmtree
from typing import Any

import msgspec
import pytest
from run_on_disk import Row, configure, made_up

from harness.coordination.named_points import POINTS
from harness.extensions.view.history import history
from harness.runs.folder import read
from harness.runs.headline import BALANCED

Said = tuple[int, str, str]
Harness = Callable[..., Said]


def fail(*episodes: int) -> Callable[[Row], None]:
    def end(row: Row) -> None:
        if row["condition"] == "6g" and row["episode"] in episodes:
            row |= {"success": False, "failure": "late"}

    return end


def of(version: str, day: int) -> dict[str, Any]:
    prompt = {"version": version, "sha256": "0" * 64, "released": True}
    return {"prompt": prompt, "created": f"2026-01-{day:02d}T12:00:00+00:00"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs on a dataset, written in another order than made; one on another;
    one that was driven.
    """
    folder = tmp_path_factory.mktemp("history") / "reports"
    made_up(
        folder / "third", episode=fail(0, 1, 2), points=(POINTS["6g"], POINTS["v2x"]), **of("v4", 3)
    )
    made_up(folder / "first", **of("v2", 1))
    made_up(folder / "second", episode=fail(0), **of("v3", 2))
    other = made_up(folder / "other", episode=fail(0, 1), **of("v2", 4))
    world = msgspec.to_builtins(read(other).manifest.world)
    configure(other, world={**world, "sha256": "1" * 64, "name": "an-other"})
    made_up(folder / "driven", closed_loop=True, **of("v2", 5))
    (folder / "begun").mkdir()
    return folder


@pytest.fixture
def reports(made: Path, tmp_path: Path) -> Path:
    """A copy of these."""
    return Path(copytree(made, tmp_path / "reports"))


def test_a_metric_by_date_of_the_condition_that_most_runs_have(
    reports: Path, harness: Harness
) -> None:
    code, out, err = harness("run", "history", "--json")
    assert (code, err) == (0, "")
    groups = json.loads(out, parse_constant=pytest.fail)
    assert [(g["scenes"], g["condition"]) for g in groups] == [
        (
            "made-up from "
            "layout seed 0", "6g"), ("an-other 111111111111", "6g"), ("made-up 000000000000", "6g"),
    ]  # fmt: skip
    runs = groups[-1]["runs"]
    assert [(r["run"], r["prompt"], r["value"], r["n"]) for r in runs] == [
        ("first", "v2", 1.0, 4), ("second", "v3", 0.75, 4), ("third", "v4", 0.25, 4),
    ]  # fmt: skip
    for listed in runs:
        score = read(reports / listed["run"]).score("6g", "success_rate")
        assert (listed["low"], listed["high"]) == (score.low, score.high)


def test_the_table_fits_and_says_what_does_not_compare(reports: Path, harness: Harness) -> None:
    code, out, err = harness("run", "history", reports)
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    lines = out.split("made-up 000000000000, 6g\n")[1].splitlines()
    assert [re.sub(r"^[-\d]+ [:\d]+ ", "", line).split() for line in lines[:3]] == [
        ["made-up", "·", "v2", "·", "json", "100.0", "[51.0,", "100.0]", "n", "4"],
        ["made-up", "·", "v3", "·", "json", "75.0", "[30.1,", "95.4]", "n", "4"],
        ["made-up", "·", "v4", "·", "json", "25.0", "[4.6,", "69.9]", "n", "4"],
    ]
    assert out.endswith(
        "runs on different scenes do not compare, so each group has its own table\n"
    )


def test_another_metric_condition_and_dataset(reports: Path, harness: Harness) -> None:
    asked = (
        "run",
        "history",
        "--metric",
        "latency_proxy_ms",
        "--condition",
        "single-local",
        "--dataset",
        "made-up",
    )
    code, out, _ = harness(*asked)
    assert code == 0
    assert out.startswith("latency_proxy_ms with its 95 % interval\n")
    assert "an-other" not in out
    frozen = out.split("made-up 000000000000, single-local\n")[1].splitlines()
    assert ["145.0" in line for line in frozen[:3]] == [True, True, False]
    assert frozen[2].split()[-3:] == ["–", "n", "–"], "the third has no such condition"
    groups = json.loads(harness("run", "history", "--metric", "strict_rate_ego", "--json")[1])
    assert {group["condition"] for group in groups} == {"all"}


def test_the_page_has_each_run_with_its_link_and_picture(reports: Path, harness: Harness) -> None:
    (reports / "second" / "report.html").touch()
    configure(reports / "first", model={"name": "<script>alert(1)</script>", "engine": "proxy"})
    assert harness("run", "history", "--html", "page.html")[0] == 0
    source = Path("page.html").read_text()
    assert "<script" not in source
    page = unescape(source)
    assert '<a href="reports/second/report.html">second</a>' in page
    assert page.count('<svg class="forest"') == 5
    assert page.index(">first<") < page.index(">second<") < page.index(">third<")
    assert "30.1 to 95.4 %" in page


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (
            ("--metric", "sucess_rate"),
            "unknown metric of these runs 'sucess_rate'; did you mean 'success_rate'?",
        ),
        (("--condition", "5g"), "unknown condition of these runs '5g'"),
        (("--dataset", "made"), "unknown dataset of these runs 'made'; did you mean 'made-up'?"),
        (("--html", "."), "--html . cannot be written (Is a directory); name another file"),
        (("nowhere",), "nowhere is no folder; give one that holds runs"),
        (("reports/begun",), "no finished runs in reports/begun; `harness eval` makes one"),
    ],
)
def test_what_cannot_be_shown_is_one_line(
    args: tuple[str, ...], said: str, reports: Path, harness: Harness
) -> None:
    code, out, err = harness("run", "history", *args)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err


def test_a_broken_run_takes_no_history_with_it(tmp_path: Path, harness: Harness) -> None:
    for name in ("good", "bad"):
        made_up(tmp_path / "reports" / name)
    (tmp_path / "reports/bad/summary.csv").write_text(
        (tmp_path / "reports/bad/summary.csv").read_text() + "not,a,row\n"
    )
    code, said, _ = harness("run", "history")
    assert code == 0
    assert "bad · wrong" in said
    code, said, _ = harness("run", "history", "--json")
    *groups, wrong = json.loads(said)
    assert (code, [run["run"] for group in groups for run in group["runs"]]) == (0, ["good"])
    assert wrong["run"] == "bad"
    assert "summary.csv" in wrong["error"]
    rmtree(tmp_path / "reports/bad")
    assert "wrong" not in harness("run", "history")[1]


def test_balanced_success_leads_where_runs_know_the_danger(tmp_path: Path) -> None:
    def danger(row: Row) -> None:
        row["danger"] = "left" if row["episode"] < 8 else "none"

    made_up(tmp_path / "run", episode=danger, episodes=40)
    [group] = history(tmp_path, None)
    assert {line.score.metric for line in group.lines if line.score} == {BALANCED}
