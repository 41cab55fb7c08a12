"""A decision's view with what moved it, and with helpers that are shown nothing."""

import pytest

pytest.importorskip("playwright", reason="needs the dev extra")
pytest.importorskip("axe_playwright_python", reason="needs the dev extra")

from axe_playwright_python.sync_playwright import Axe
from evaluating import run, spec_of
from opening import NARROW, picture

from harness.evaluate.resolve import points
from harness.extensions.studies.attribution.record import of_run
from harness.extensions.studies.attribution.study import attribute, write
from harness.report.page import write_report
from harness.report.runs import gather
from harness.runs import folder
from harness.studies.replayed_run import ReplayedRun

pytestmark = pytest.mark.exhaustive


@pytest.fixture(scope="module")
def made(small, tmp_path_factory):
    path = run(
        spec_of(small, points=points(["6g"], {"control": ["blind"]})),
        tmp_path_factory.mktemp("moved") / "run",
    ).out
    write(attribute(ReplayedRun(path), "6g", 12, 0), path)
    return write_report(gather([path]), path / "report.html", full=True)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_bars_stand_under_answers_and_decisions_of_the_sample_alone(opened, made, scheme):
    found = of_run(folder.read(made.parent))
    most = max(
        (each for each in found.left_out if each.role == "fusion"), key=lambda each: each.shift
    )
    page = opened(made, f"#scene={most.scene}&condition=6g&seed={most.seed}", scheme=scheme)
    here = [each for each in found.left_out if each.scene == most.scene]
    assert page.locator(".track").count() == len(here)
    for each in here:
        changed = f"{abs(each.change):.2f} {each.action}"
        row = page.locator(".moved span", has_text=f"without {each.item}: ").filter(
            has_text=changed
        )
        assert row.count() >= 1
    shown = page.locator(".track").first
    assert float(shown.get_attribute("title").split()[-1]) == round(most.shift, 2)
    wide = shown.bounding_box()["width"]
    assert shown.locator("i").bounding_box()["width"] == pytest.approx(most.shift * wide, abs=0.5)
    rules = {"runOnly": ["wcag2a", "wcag2aa"]}
    assert Axe().run(page, options=rules).response["violations"] == []
    picture(page, f"attribution-{scheme}")
    drawn = {each.scene for each in found.left_out}
    other = next(scene for scene in folder.read(made.parent).decisions.scenes if scene not in drawn)
    assert opened(made, f"#scene={other}").locator(".moved").count() == 0


def test_it_fits_a_narrow_screen_and_is_reached_from_the_list(opened, made):
    page = opened(made, "#decisions", NARROW)
    page.locator("a[data-scene]", has_text="-").first.click()
    page.wait_for_selector("#decision[data-drawn]")
    assert page.locator(".moved").count() > 1
    assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"]


def test_a_blind_condition_shows_what_blind_helpers_said(opened, made):
    scene = next(a.scene for a in folder.read(made.parent).answers if a.role == "blind")
    page = opened(made, f"#scene={scene}&condition=6g:messages=blind")
    assert page.locator(".answer h4", has_text="v2, blind helper").count() == 1
    assert page.locator(".chart text", has_text="v2, blind helper").count() >= 1
    assert page.locator(".chart text", has_text="v2, helper").count() == 0
    answer = page.locator(".answer", has=page.locator("h4", has_text="v2, blind helper"))
    prompt = answer.locator("details").text_content()
    assert "SECTORS you see: left 0%; right 0%; oncoming 0%" in prompt
