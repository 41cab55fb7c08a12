"""`harness view` while a run goes on: how far it is, and that the list asks until none goes."""

import os
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from evaluating import live_spec_of, spec_of
from markupsafe import escape
from starlette.testclient import TestClient
from viewing import SECRET, visitor

from harness.coordination.named_points import POINTS
from harness.core.files import alone
from harness.core.work import tidy
from harness.dataset.load import Dataset
from harness.evaluate import run as evaluation
from harness.report.library import digest
from harness.runs.unfinished import Extent, extent

BEGUN = (
    '{"created": "2026-01-03T12:00:00+00:00", "tags": [], "settings": {"model": {"name": "m"}, '
    '"answer": '
    '"json", "prompt": {"version": "v2"}, "world": {"kind": "frozen", "episodes": 3}}}'
)
Look = tuple[Extent, str, dict[str, Any]]


@pytest.fixture(scope="module")
def seen(made: Path, small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> list[Look]:
    """What is seen of a real run at each answer and after it:
    its extent, the list, what changes in it.
    """
    reports = Path(shutil.copytree(made, tmp_path_factory.mktemp("going") / "reports"))
    client = visitor(reports)
    spec = spec_of(
        small, points=(POINTS["single-local"], POINTS["6g"]), tag=("slow",), batch_size=1
    )
    looks = []

    def look(done: int) -> None:
        looks.append(
            (extent(reports / "now"), client.get("/").text, client.get("/progress").json())
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "TREES_AT_ONCE", 2)
        evaluation.evaluate(spec, reports / "now", look)
    tidy(reports / "now")
    look(0)
    return looks


@pytest.mark.slow
def test_the_list_says_how_far_a_run_is_while_it_goes_on(seen: list[Look]) -> None:
    *looks, (_, _, now) = seen
    extents = [each for each, _, _ in looks]
    assert all(each.going and each.due == 4 for each in extents)
    assert {each.done for each in extents} >= {0, 2}
    assert [each.done for each in extents] == sorted(each.done for each in extents)
    assert max(each.answers for each in extents) > 1, (
        "answers are counted before their episodes end"
    )
    for each, page, then in looks:
        text = then["unfinished"]["now"]
        assert text.startswith(f"going on now: {each.done} of 4 episodes")
        assert f'unfinished</strong> <small data-run="now">{text}</small>' in page
        assert then["going"]
    assert (now["going"], now["unfinished"]) == (False, {})
    assert now["listed"] != looks[-1][2]["listed"] == looks[0][2]["listed"], (
        "it changes once a run ends"
    )


@pytest.mark.slow
def test_the_list_runs_its_own_script_and_only_while_a_run_goes_on(
    seen: list[Look], client: TestClient, reports: Path
) -> None:
    *looks, (_, last, _) = seen
    assert all(page.count("<script") == 1 for _, page, _ in looks)
    assert "<script" not in last
    after = client.get("/")
    assert "<script" not in after.text
    assert "script-src" not in after.headers["content-security-policy"]
    work = reports / "begun/.work"
    work.mkdir(parents=True)
    (work / "config.json").write_text(BEGUN)
    assert "<script" not in client.get("/").text, "it is stopped"
    with alone(work / "lock"):
        while_it_goes = client.get("/")
        assert "<script" not in client.get("/?q=proxy").text, "what is shown has ended"
    [script] = re.findall("<script>(.*?)</script>", while_it_goes.text, re.S)
    policy = while_it_goes.headers["content-security-policy"]
    assert f"script-src 'sha256-{digest(script)}'; connect-src 'self'" in policy


def test_a_stopped_run_keeps_its_count_and_a_shard_has_none_to_reach(reports: Path) -> None:
    work = reports / "begun/.work"
    part = work / "episodes-000003-000009"
    part.mkdir(parents=True)
    rows = "".join(f'"6g:a,b",{s},{n},x\n' for n in (3, 7, 9) for s in (0, 1))
    (part / "episodes.csv").write_text(f"condition,seed,episode,more\n{rows}")
    (work / "episodes-000001-000002").mkdir()
    (work / "episodes-000001-000002/episodes.csv").write_text("")
    (work / "episodes-000010-000019.jsonl").write_text('{"id": 1}\n{"id": 2}\n{"torn')
    (work / "config.json").write_text('{"shard": "1/2", "settings": {"world": {"episodes": 40}}}')
    assert extent(reports / "begun") == Extent(
        going=False, done=3, due=None, early=False, answers=2
    )


@pytest.mark.parametrize(
    "config", ["", "[]", '{"settings": 1}', '{"settings": {"world": {"episodes": []}}}']
)
def test_what_is_broken_or_a_link_counts_as_not_done(
    config: str, reports: Path, tmp_path: Path
) -> None:
    work = reports / "begun/.work"
    (work / "episodes-000000-000001").mkdir(parents=True)
    (work / "config.json").write_text(config)
    (tmp_path / "secret/rows").write_text(f"head\n{SECRET}\n")
    os.symlink(tmp_path / "secret/rows", work / "answers.jsonl")
    os.symlink(tmp_path / "secret/rows", work / "episodes-000000-000001/episodes.csv")
    os.mkfifo(work / "lock")
    assert extent(reports / "begun") == Extent(
        going=False, done=0, due=None, early=False, answers=0
    )
    shutil.move(work, tmp_path / "elsewhere")
    work.symlink_to(tmp_path / "elsewhere")
    assert extent(reports / "begun") == Extent(
        going=False, done=0, due=None, early=False, answers=0
    )


def test_a_run_that_may_stop_early_has_that_many_at_most(reports: Path) -> None:
    work = reports / "begun/.work"
    work.mkdir(parents=True)
    (work / "config.json").write_text(
        '{"settings": {"world": {"episodes": 40, "looks": {"width": 0.1}}}}'
    )
    assert extent(reports / "begun") == Extent(going=False, done=0, due=40, early=True, answers=0)


@pytest.mark.exhaustive
def test_episodes_that_are_driven_are_counted_as_they_end(
    reports: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "EPISODES_AT_ONCE", 1)
    seen, spec = [], live_spec_of("cruise", 3, points=(POINTS["6g"],), batch_size=1)
    evaluation.evaluate(
        spec, reports / "now", lambda done: seen.append(extent(reports / "now").done)
    )
    assert seen == [1, 2, 3]


@pytest.mark.parametrize("name", ["turned\u202eround", "no text \udcff", "<b>&quot;</b>"])
def test_a_run_of_any_name_is_followed_by_what_the_list_calls_it(
    name: str, client: TestClient, reports: Path
) -> None:
    work = reports / name / ".work"
    work.mkdir(parents=True)
    (work / "config.json").write_text(BEGUN)
    [called] = client.get("/progress").json()["unfinished"]
    assert f'<small data-run="{escape(called)}">stopped: 0 of 3 episodes' in client.get("/").text
