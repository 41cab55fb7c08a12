"""The page of a run in which several vehicles decide: from one to another in the same step."""

from dataclasses import replace

import pytest

pytest.importorskip("playwright", reason="needs the dev extra")

from evaluating import live_spec_of, run
from opening import wait
from playwright.sync_api import expect

from harness.backends import cards
from harness.coordination.named_points import named_point
from harness.evaluate.agent import Agent
from harness.evaluate.live_world import LiveSource
from harness.prompts import versions
from harness.report.page import render
from harness.report.runs import gather

pytestmark = pytest.mark.exhaustive


def test_one_clicks_from_vehicle_to_vehicle_of_a_step(tmp_path, opened):
    source = LiveSource(50_001, 1, "all-way-crossing:agent_share=1")
    spec = replace(
        live_spec_of(prompt="v4", points=(named_point("6g"),), seeds=(0,)), source=source
    )
    run(spec, tmp_path / "run")
    (tmp_path / "report.html").write_text(render(gather([tmp_path / "run"]), full=True))
    page = opened(tmp_path / "report.html", "#decisions")

    shown = page.locator("#list tbody tr")
    decides = [row.locator("td, th").nth(1).inner_text() for row in shown.all()]
    assert decides[:8] == ["v1", "v2", "v3", "v4"] * 2, "by step and agent"
    assert len(page.locator("#strips .strip").all()) == 4, "a strip an agent"

    shown.nth(5).locator("a").click()
    wait(page)
    expect(page.locator("#decision p strong")).to_have_text("v2 decides")
    agents = page.locator("#decision table[data-csv=agents] tbody tr")
    actions = {
        row.locator("td, th").nth(0).inner_text(): row.locator("td, th").last
        for row in agents.all()
    }
    assert list(actions) == ["v1", "v2", "v3", "v4"]
    for agent, cell in actions.items():
        action = cell.inner_text().split()[0]
        assert any(f"{agent} " in label and f" {action}" in label for label in labels(page))

    page.locator("svg.scene a").first.click()
    expect(page.locator("#decision p strong")).to_have_text("v1 decides")
    page.locator("#decision table[data-csv=agents] a", has_text="v4").click()
    expect(page.locator("#decision p strong")).to_have_text("v4 decides")
    expect(page.locator("#decision p", has_text="step 1;")).to_be_visible()


def test_each_agent_is_shown_with_its_model_and_the_plans_that_were_heard(tmp_path, opened):
    point = named_point("6g:schedule=always,content=plan,consensus=yield-by-time")
    spec = live_spec_of(prompt="v4", points=(named_point("6g"),), seeds=(0,))
    cruise = Agent(cards.resolve("cruise"), versions.load("v4"))
    source = LiveSource(50_001, 1, "all-way-crossing:agent_share=1")
    spec = replace(spec, source=source, points=(point,), helpers=(cruise,)).changed(
        latency="ego=0.1,helper=0.15"
    )
    run(spec, tmp_path / "run")
    (tmp_path / "report.html").write_text(render(gather([tmp_path / "run"]), full=True))
    page = opened(tmp_path / "report.html", "#decisions")
    page.locator("#list tbody tr").nth(1).locator("a").click()
    wait(page)
    expect(
        page.locator("#decision p", has_text="v2 decides with cruise · v4 · json;")
    ).to_be_visible()
    agents = page.locator("#decision table[data-csv=agents] tbody tr")
    assert [row.locator("small").first.inner_text() for row in agents.all()][:2] == [
        "proxy · v4 · json", "cruise · v4 · json"
    ]  # fmt: skip
    charts = [chart.text_content() for chart in page.locator("#decision .chart svg").all()]
    assert all("v1, plan" in text and "v1, helper" not in text for text in charts)


def labels(page):
    return [each.text_content() for each in page.locator("svg.scene text.label").all()]
