"""Pages of studies and comparisons: none is wider than a telephone,
and what is wide in them scrolls inside itself.
"""

import pytest

pytest.importorskip("playwright", reason="needs the dev extra")
pytest.importorskip("axe_playwright_python", reason="needs the dev extra")

from axe_playwright_python.sync_playwright import Axe
from evaluating import run as evaluate
from evaluating import spec_of
from opening import NARROW, SCROLLS, SHEETS, picture, sheets

from harness.coordination.named_points import named_point
from harness.core.statistics import Estimate
from harness.report.compare.difference import compare
from harness.report.compare.page import render
from harness.report.compare.pair import pair
from harness.report.document import Section, Table, document
from harness.report.drawing.colours import COLOURS
from harness.studies.figures import charts
from harness.studies.figures.described import Rows

LONG = "6g:schedule=always,weight_cap=0.5,max_helpers=2"


@pytest.fixture(scope="module")
def pages(small, tmp_path_factory):
    """A page as studies write them, and one of a comparison, by name."""
    folder = tmp_path_factory.mktemp("documents")
    points = named_point("single-local"), named_point(LONG)
    runs = [folder / "reports" / name for name in ("proxy", "cruise")]
    for run in runs:
        evaluate(spec_of(small, run.name, points=points, seeds=(0,)), run)
    cells = [f"{value}.0 [{value}.0, 100.0]" for value in range(10)]
    table = Table("A table of ten columns", [*map(str, range(10))], [cells])
    rows = Rows("share, %", [LONG], {"series": [Estimate(0.5, 0.2, 0.8, 9, 0)]})
    [chart] = charts.intervals([rows], {"series": COLOURS[0]})
    study = Section(f"A study of {LONG}", [LONG], tables=[table], charts={"share": chart})
    (folder / "study.html").write_text(document([study]))
    (folder / "compare.html").write_text(render(compare(pair(*runs)), (), 10, lambda run: None))
    return {"study": folder / "study.html", "compare": folder / "compare.html"}


WIDELY = pytest.mark.exhaustive


@pytest.mark.parametrize(
    ("name", "scheme"),
    [
        pytest.param("study", "light", marks=WIDELY),
        pytest.param("study", "dark", marks=WIDELY),
        pytest.param("compare", "light", marks=WIDELY),
        pytest.param("compare", "dark", marks=pytest.mark.slow),
    ],
)
def test_a_document_fits_a_telephone_and_is_read_aloud(browser, pages, name, scheme):
    page = browser.new_page(viewport=NARROW, color_scheme=scheme)
    page.goto(pages[name].as_uri())
    if name == "study":
        page.wait_for_selector("body[data-drawn]", state="attached")
        assert page.locator(".chart svg").count() == 1
    assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"]
    said = page.evaluate(SCROLLS)
    assert [label for label, wider, sign in said if wider != sign] == []
    assert any(sign for _, _, sign in said)
    assert Axe().run(page).response["violations"] == []
    picture(page, f"{name}-narrow-{scheme}")
    page.close()


@pytest.mark.exhaustive
def test_a_comparison_begins_with_its_verdict_two_numbers_and_the_figure(browser, pages):
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(pages["compare"].as_uri())
    verdict = page.locator(".found").bounding_box()
    for what in (".first .key", ".first figure"):
        box = page.locator(what).bounding_box()
        assert verdict["y"] < box["y"] <= box["y"] + box["height"] <= 900, what
    assert page.locator(".key > div").count() == 2
    assert sheets(page) <= SHEETS
    page.close()
