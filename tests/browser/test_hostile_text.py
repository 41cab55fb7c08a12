"""Hostile text in every place that a model, a prompt, a file or its name can write to:
nothing of it runs.

Each payload stands alone in every field: one report is of as many runs as there are payloads,
another of one run under as many conditions; in answers they come in turn. A third is of a run for
each way into markup, with another deed each, and of all that is written otherwise.
"""

import csv
import json

import pytest
from evaluating import course
from opening import wait
from reading import Page, details, packed
from sample_hostile import OF_EACH_KIND, PAYLOADS, hostile, prompt_of

from harness.core import places
from harness.report.page import render
from harness.report.runs import gather
from harness.report.templating import visible

WRITTEN = """
  html head meta title style body nav a button noscript main section h1 h2 h3 p strong code span small br
  table thead tbody tr th td dl dt dd details summary div figure figcaption pre script
"""
WATCH = """
window.ran = [];
for (const name of ["alert", "confirm", "prompt", "open"])
  window[name] = (...words) => { window.ran.push([name, words]); };
addEventListener("securitypolicyviolation", (e) => window.ran.push([e.violatedDirective, e.sample]), true);
"""
# Elements that the report never makes, and attributes that run.
FOREIGN = """
  [...document.querySelectorAll("*")].filter((element) =>
    /^(iframe|object|embed|base|marquee|video|audio|img|link|math|template|animate)$/i.test(element.tagName)
    || [...element.attributes].some(({ name, value }) => /^on/i.test(name)
      || /^(href|src|xlink:href|action|formaction)$/i.test(name) && !/^(#|blob:|data:image)/.test(value)))
  .map((element) => element.outerHTML.slice(0, 200))
"""
GO = """(where) => {
  delete document.getElementById("decision").dataset.drawn;
  location.hash = new URLSearchParams(where);
}"""
# Opens what is closed and hovers over every mark of a chart; how many tooltips that showed.
TOUCH = """(where) => {
  let shown = 0;
  for (const found of document.querySelectorAll(`${where} details`)) found.open = true;
  for (const found of document.querySelectorAll(`${where} .chart svg :is(path, rect, line)`)) {
    const { x, y, width, height } = found.getBoundingClientRect();
    const at = { bubbles: true, clientX: x + width / 2, clientY: y + height / 2, view: window };
    for (const kind of ["pointerover", "pointermove"]) found.dispatchEvent(new PointerEvent(kind, at));
    shown += document.querySelectorAll("#vg-tooltip-element.visible").length;
  }
  return shown;
}"""


def test_there_are_a_hundred_payloads_and_each_is_another():
    assert len(set(PAYLOADS)) == len(PAYLOADS) >= 100


@pytest.fixture(
    scope="module",
    params=[
        pytest.param("one of each kind", marks=pytest.mark.slow),
        pytest.param("many runs", marks=pytest.mark.exhaustive),
        pytest.param("many conditions", marks=pytest.mark.exhaustive),
    ],
)
def attacked(request, small, tmp_path_factory):
    """The report and its text."""
    base = tmp_path_factory.mktemp("hostile")
    if request.param == "one of each kind":
        folders = [hostile(base / str(n), small, n) for n in OF_EACH_KIND]
    elif request.param == "many runs":
        folders = [hostile(base / str(n), small, n) for n in range(len(PAYLOADS))]
    else:
        folders = [hostile(base / "0", small, 0, PAYLOADS)]

    def prompts(run):
        n = PAYLOADS.index(run.manifest.name)
        return lambda scene, viewer, heard: prompt_of(n, scene.id, viewer)

    text = render(gather(folders, course(small, 1)), prompts)
    (base / "report.html").write_text(text, encoding="utf-8")
    return base / "report.html", text


def test_nothing_in_the_file_is_markup_that_the_report_did_not_write(attacked):
    _, text = attacked
    page = Page(text)
    assert page.tags.keys() <= set(WRITTEN.split())
    assert page.tags["script"] == text.count('<script type="application/gzip" id="') + 1
    assert not any(name.startswith("on") for _, name, _ in page.attributes)
    assert all(href.startswith("#") for href in page.values("href"))


def test_every_payload_is_shown_as_the_text_it_is(attacked):
    _, text = attacked
    shown = Page(text).text
    assert all(" ".join(visible(payload).split()) in shown for payload in PAYLOADS)
    answers = [
        a for d in details(text).values() for run in d["runs"] if run for a in run["answers"]
    ]
    for field in ("raw", "detail", "error", "status"):
        said = {a[field] for a in answers}
        # What an engine says of an error has the names of files without their folders.
        payloads = (
            set(map(places.text, PAYLOADS)) if field in ("detail", "error") else set(PAYLOADS)
        )
        assert said <= payloads
        assert len(said) == (len(payloads) if len(gathered(text)) > 1 else len(answers))


def gathered(text):
    return json.loads(packed(text, "index"))["runs"]


def test_nothing_runs_in_the_overview_nor_in_any_decision(browser, attacked):
    file, text = attacked
    context = browser.new_context(offline=True)
    context.add_init_script(WATCH)
    page, heard = context.new_page(), []
    page.on("dialog", lambda dialog: (heard.append(dialog.message), dialog.dismiss()))
    page.on("pageerror", lambda error: heard.append(str(error)))
    page.on("console", lambda message: heard.append(message.text))
    page.on("framenavigated", lambda frame: heard.append(frame.url) if frame.parent_frame else None)
    page.goto(f"file://{file}")
    wait(page)
    assert page.evaluate(TOUCH, "#report") > 10
    foreign = page.evaluate(FOREIGN)
    # Every fourth run: a scene's four answers say eleven payloads each, so that every field still
    # says all.
    scene, runs = next(iter(details(text))), len(gathered(text))
    for n in range(0, runs, 4) if runs > 1 else range(0, len(PAYLOADS), 12):
        where = {"scene": scene, "run": str(n % runs), "condition": PAYLOADS[n if runs == 1 else 0]}
        page.evaluate(GO, where)
        page.wait_for_selector("#decision[data-drawn]")
        page.evaluate(TOUCH, "#decision")
        foreign += page.evaluate(FOREIGN)
    ran = page.evaluate("window.ran")
    context.close()
    assert (ran, foreign, heard) == ([], [], [])


def test_a_copied_cell_is_no_formula_in_a_spreadsheet(opened, attacked):
    file, text = attacked
    if len(gathered(text)) == 1:
        pytest.skip("the table is of several runs")
    page = opened(file, "#matrix")
    page.evaluate("navigator.clipboard.writeText = async (text) => { window.copied = text; }")
    page.locator("#matrix .fold > div.scroll + button").click()
    cells = [
        cell for row in csv.reader(page.evaluate("window.copied").splitlines()) for cell in row
    ]
    assert any("cmd|" in cell for cell in cells)
    assert not any(cell.startswith(("=", "@", "+c", "-2+")) for cell in cells)
