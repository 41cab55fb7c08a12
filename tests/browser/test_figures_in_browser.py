"""Every study's figures in a browser: all texts lie in them, and a dark page has no white card."""

import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("playwright", reason="needs the dev extra")

from evaluating import run as evaluate
from evaluating import spec_of
from former import DRIVE
from opening import NARROW, WIDE, picture
from PIL import Image
from typer.testing import CliRunner

from harness.cli import app
from harness.coordination.named_points import named_point
from harness.report.drawing import colours
from harness.report.page import write_report
from harness.report.runs import gather

LONG = "v2x:consensus=geometric-median,tau=0.5,max_helpers=2"
CONDITIONS = ("6g", "v2x", LONG, "6g:consensus=median,tau=0.5")
OUTSIDE = """() => { const all = document.documentElement.getBoundingClientRect();
  return [...document.querySelectorAll("text")].filter((text) => { const box = text.getBoundingClientRect();
    return box.left < all.left - 1 || box.right > all.right + 1 || box.top < all.top - 1
      || box.bottom > all.bottom + 1; }).map((text) => text.textContent); }"""
COLOUR = r"#[0-9a-f]{6}\b"
DARK = 70  # of 255: the brightest that the corner of a figure on a dark page is


@pytest.fixture(scope="module")
def studies(small, tmp_path_factory):
    """Folders of studies that draw, by name."""
    folder = tmp_path_factory.mktemp("figures")
    run = folder / "proxy"
    evaluate(spec_of(small, points=[*map(named_point, CONDITIONS)], seeds=(0,)), run)
    every = [option for name in CONDITIONS for option in ("--condition", name)]
    driven = folder / "driven"
    layouts = ("--episodes", "4", "--first-seed", "100", "--seeds", "0", "--workers", "1")
    drawn = {
        "driven": [*DRIVE, *layouts, "--quiet", "--out", driven],
        "radio": ["radio", "check", "mode4", "-n", "100", "--out", folder / "radio/radio.svg"],
        "crowd": ["radio", "crowd", "mode4", "--out", folder / "crowd/crowd.svg"],
    }
    commands = {
        "sweep": ["sweep", run, "--over", "loss", "--grid", "0,0.5", *every],
        "panels": ["sweep", run, *every],
        "words": ["sweep", run, "--over", "consensus", *every[:4]],
        "crossed": ["sweep", run, "--over", "tau", "--over", "max_helpers", "--over", "loss", "--grid",
                    "0.5,0.7", "--grid", "1,2", "--grid", "0,0.2", "--condition", LONG],
        "contents": ["contents", run],
        "trust": ["trust", run],
        "schedule": ["schedule", "compare", run],
        "twins": ["twins", "--model", "proxy", "--dataset", small.path, "--limit", "2"],
        "paper": ["paper"],
    }  # fmt: skip
    for name, typed in commands.items():
        drawn[name] = ["study", *typed, "--out", folder / name, "--quiet", "--pictures"]
    drawn["fidelity"] = [
        "study",
        "fidelity",
        run,
        driven,
        "--out",
        folder / "fidelity",
        "--pictures",
    ]
    for name, typed in drawn.items():
        (folder / name).mkdir(exist_ok=True)
        done = CliRunner().invoke(app, [*map(str, typed)])
        assert done.exit_code == 0, (name, done.output, done.exception)
    return {name: folder / name for name in drawn if name != "driven"}


@pytest.mark.exhaustive
def test_every_studys_figures_are_whole_and_in_the_reports_palette(browser, studies):
    palette = set(re.findall(COLOUR, Path(colours.__file__).read_text().lower()))
    page = browser.new_page(viewport={"width": 2400, "height": 2400})
    drawn = [svg for folder in studies.values() for svg in sorted(folder.glob("*.svg"))]
    assert {svg.parent.name for svg in drawn} == studies.keys()
    for svg in drawn:
        page.goto(svg.as_uri())
        assert page.evaluate(OUTSIDE) == [], svg
        assert set(re.findall(COLOUR, svg.read_text().lower())) <= palette, svg
    page.close()


@pytest.mark.exhaustive
@pytest.mark.parametrize("size", [WIDE, NARROW], ids=["wide", "narrow"])
def test_every_name_of_a_reports_legends_lies_in_its_chart(opened, small, tmp_path, size):
    paths = [tmp_path / name for name in ("one", "other")]
    for path, model in zip(paths, ("proxy", "proxy-faulty"), strict=True):
        evaluate(spec_of(small, model, points=[*map(named_point, CONDITIONS)], seeds=(0,)), path)
    write_report(gather(paths), tmp_path / "report.html")
    page = opened(tmp_path / "report.html", size=size)
    charts = page.locator(".chart svg")
    assert charts.count() > 3
    for chart in charts.all():
        right = chart.bounding_box()["x"] + chart.bounding_box()["width"]
        names = [name.bounding_box() for name in chart.locator(".role-legend-label text").all()]
        assert [box for box in names if box["x"] + box["width"] > right + 1] == []
    shown = page.locator(".role-legend-label text").all_text_contents()
    assert LONG in shown if size is WIDE else any(name.endswith("…") for name in shown)


@pytest.mark.exhaustive
def test_a_dark_page_draws_every_chart_and_none_is_white(browser, studies):
    page = browser.new_page(viewport=WIDE, color_scheme="dark")
    said = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    for name, folder in studies.items():
        if not (folder / "index.html").exists():
            continue  # a radio's picture has no page
        page.goto((folder / "index.html").as_uri())
        page.wait_for_selector("body[data-drawn]", state="attached")
        assert page.locator(".chart").count() == page.locator(".chart svg").count() > 0
        for place, figure in enumerate(page.locator(".chart svg").all()):
            shown = np.asarray(Image.open(BytesIO(figure.screenshot())).convert("L"))
            assert shown[12, 12] < DARK, (name, place)
            assert shown.max() > 200, "its axes are light"
        picture(page, f"study-{name}-dark")
    assert said == []
    page.close()
