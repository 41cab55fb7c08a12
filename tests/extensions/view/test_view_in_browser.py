"""`harness view` in a real browser: what is picked is compared,
and a run's page works in its sandbox.
"""

import re
import shutil
import subprocess
import sys
from threading import Event, Thread

import pytest

pytest.importorskip("playwright", reason="needs the dev extra")
pytest.importorskip("axe_playwright_python", reason="needs the dev extra")

from axe_playwright_python.sync_playwright import Axe
from evaluating import run as evaluate
from evaluating import spec_of
from opening import NARROW, SCROLLS, WIDE, picture, wait
from playwright.sync_api import expect

from harness.coordination.named_points import POINTS
from harness.core.work import tidy
from harness.evaluate.run import evaluate as evaluation
from harness.extensions.view.export import export
from harness.extensions.view.notes import notes
from harness.report.page import write_report
from harness.report.runs import gather

SPY = """<title>not told</title><script>
fetch("/").then(() => { document.title = "read" }, () => { document.title = "refused at " + self.origin })
</script>"""


@pytest.fixture(scope="module")
def folder(small, tmp_path_factory):
    """Two runs and a page that spies."""
    folder = tmp_path_factory.mktemp("viewed") / "reports"
    for name, model in (("first", "proxy"), ("second", "cruise"), ("spy", "brake")):
        evaluate(spec_of(small, model, points=(POINTS["6g"],), tag=(name,)), folder / name)
    write_report(gather([folder / "first"]), folder / "first/report.html")
    (folder / "spy/report.html").write_text(SPY)
    return folder


@pytest.fixture(scope="module")
def address(folder):
    """Where the real command serves them."""
    command = [sys.executable, "-m", "harness", "view", str(folder), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            # with its token, as whoever ran it copies it
            yield process.stdout.readline().split()[0]
        finally:
            process.kill()


@pytest.fixture
def page(browser):
    context = browser.new_context(viewport=WIDE, accept_downloads=True)
    heard = []
    page = context.new_page()
    page.on("console", lambda message: heard.append(message.text))
    page.on("pageerror", lambda error: heard.append(str(error)))
    yield page
    context.close()
    assert heard == []


@pytest.mark.exhaustive
def test_two_runs_are_picked_and_compared_by_keyboard_alone(page, address):
    page.goto(address)
    page.get_by_label("Pick first").focus()
    page.keyboard.press("Space")
    page.get_by_label("Pick second").focus()
    page.keyboard.press("Space")
    page.get_by_role("button", name="Compare two").focus()
    page.keyboard.press("Enter")
    page.wait_for_url("**/compare?path=*")
    assert page.locator("h1").inner_text() == "B compared with A"
    page.go_back()
    page.get_by_role("searchbox").fill("second")
    page.keyboard.press("Enter")
    page.wait_for_url("**/?q=second*")
    assert page.locator("tbody th").all_inner_texts() == ["second second"]


@pytest.mark.exhaustive
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_list_fits_a_telephone_and_is_read_aloud(page, address, scheme):
    page.set_viewport_size(NARROW)
    page.emulate_media(color_scheme=scheme)
    page.goto(address)
    assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"]
    assert Axe().run(page).response["violations"] == []
    page.set_viewport_size(WIDE)
    assert Axe().run(page).response["violations"] == []
    page.set_viewport_size(NARROW)
    picture(page, f"view-{scheme}")


@pytest.mark.slow
def test_a_report_works_in_its_sandbox(page, address):
    page.goto(address)
    page.get_by_role("link", name="first").click()
    wait(page)
    assert page.evaluate("self.origin") == "null"
    with page.expect_download() as saved:
        page.get_by_text("Save as SVG").first.click()
    assert saved.value.path().read_text().startswith("<svg")
    page.get_by_text("The list of all decisions").click()
    said, search = page.locator("#list > p[aria-live]"), page.locator("input[name=q]")
    search.fill("no such scene")
    expect(said).to_have_text(re.compile("^0 of "))
    search.fill("action_distribution")
    search.press("Enter")
    expect(said).to_have_text(re.compile(r"^[1-9]\d* of "))


def open_whole_decision(page, address):
    """Open the second decision of the first run, with what the run's page leaves out."""
    page.goto(address)
    page.get_by_role("link", name="first").click()
    wait(page)
    page.get_by_text("The list of all decisions").click()
    page.locator("#list a[data-n]").nth(1).click()
    page.get_by_role("link", name="Show them").click()
    page.wait_for_url("**/run?path=first&scene=*#scene=*")


@pytest.mark.exhaustive
def test_a_decision_opens_with_what_its_page_leaves_out(page, address):
    open_whole_decision(page, address)
    wait(page)
    assert page.locator(".cameras .frame").count() == 4
    assert page.locator(".answer details").count() > 0
    assert page.get_by_text("Not in this page").count() == 0
    page.get_by_role("link", name="next →").click()
    expect(page.get_by_role("link", name="Show them")).to_be_visible()


@pytest.mark.exhaustive
def test_links_lead_out_of_a_sandbox_and_the_token_stays_out_of_addresses(page, address):
    """A page in a sandbox is another site to its own server."""
    page.goto(address)
    list_of_runs = address.partition("?")[0]
    assert page.url == list_of_runs
    page.get_by_role("link", name="first").click()
    wait(page)
    page.get_by_role("link", name="All runs").focus()
    page.keyboard.press("Enter")
    page.wait_for_url(list_of_runs)
    for path in (
        "run?path=first",
        "report?path=first&path=second",
        "compare?path=first&path=second",
    ):
        page.goto(f"{list_of_runs}{path}")
        # fails if something lies over it
        page.get_by_role("link", name="All runs").click(timeout=5000)
        page.wait_for_url(list_of_runs)
    assert page.locator("tbody th").count() == 3
    page.reload()
    assert page.locator("tbody th").count() == 3
    page.goto(f"{list_of_runs}compare?path=first&path=second")
    link = page.locator("a[href*='#scene=']").first
    link.click()
    page.wait_for_url("**/run?path=*#scene=*")
    page.go_back()
    assert page.locator("h1").inner_text() == "B compared with A"


@pytest.mark.exhaustive
def test_the_token_is_needed_and_a_file_may_lead_to_it(browser, address, tmp_path):
    context = browser.new_context()
    page = context.new_page()
    page.goto(address.partition("?")[0])
    assert "with its token" in page.locator("main").inner_text()
    # The page that --open leads a browser to, from a file.
    (tmp_path / "open.html").write_text(f'<meta http-equiv="refresh" content="0; url={address}">')
    page.goto((tmp_path / "open.html").as_uri())
    page.wait_for_url(address.partition("?")[0])
    assert page.locator("tbody th").count() == 3
    context.close()


@pytest.mark.exhaustive
def test_a_page_that_spies_reads_nothing_else(browser, address):
    page = browser.new_page()
    page.goto(address)
    page.get_by_role("link", name="spy").click()
    page.wait_for_function("document.title != 'not told'")
    assert page.title() == "refused at null"
    page.close()


@pytest.mark.exhaustive
def test_the_list_follows_a_run_to_its_end_without_a_new_page(page, address, folder, small):
    """A real run that waits in the middle, in the folder that the real command serves."""
    seen, go_on = Event(), Event()

    def wait_for_the_page(done):
        seen.set()
        assert go_on.wait(60)

    def go():
        spec = spec_of(small, points=(POINTS["6g"],), tag=("goes on",), batch_size=1)
        evaluation(spec, folder / "third", wait_for_the_page)
        tidy(folder / "third")

    going = Thread(target=go, daemon=True)
    going.start()
    try:
        assert seen.wait(60)
        page.goto(address)
        row = page.locator("tr", has_text="third")
        expect(row).to_contain_text(
            re.compile(r"unfinished going on now: 0 of 4 episodes, \d+ answers for the")
        )
        assert Axe().run(page).response["violations"] == []
        for size, name in ((WIDE, "view-going"), (NARROW, "view-going-narrow")):
            page.set_viewport_size(size)
            assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
            picture(page, name)
        page.get_by_label("Pick second").check()
        page.get_by_label("Pick first").focus()
        page.evaluate("self.kept = true")
        go_on.set()
        expect(row.get_by_role("link", name="third")).to_be_visible(timeout=60_000)
        expect(row).to_contain_text(" %")
        expect(page.get_by_role("status")).to_have_text(re.compile("^No run is going on"))
        assert page.evaluate("self.kept"), "the page is the same"
        assert page.get_by_label("Pick second").is_checked()
        expect(page.get_by_label("Pick first")).to_be_focused()
        requests = []
        page.on("request", lambda request: requests.append(request.url))
        page.wait_for_timeout(2500)
        assert requests == [], "nothing is asked once no run goes on"
    finally:
        go_on.set()
        going.join(60)
        shutil.rmtree(folder / "third")


@pytest.mark.exhaustive
def test_a_note_is_written_from_a_runs_page_and_stands_on_it(page, address, folder):
    open_whole_decision(page, address)
    page.get_by_role("link", name="Note on this decision").click()
    page.wait_for_url("**/notes?path=first&scene=*")
    scene = page.get_by_label("Decision point").input_value()
    page.get_by_label("Note", exact=True).fill("brakes too late\nfor what it was told")
    assert Axe().run(page).response["violations"] == []
    for size, name in ((WIDE, "view-notes"), (NARROW, "view-notes-narrow")):
        page.set_viewport_size(size)
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
        picture(page, name)
    page.get_by_role("button", name="Keep note").click()
    expect(page.locator(".noted")).to_contain_text("brakes too late")
    assert [note.scene for note in notes(folder / "first")] == [scene]
    page.get_by_role("link", name="first").click()
    wait(page)
    noted = page.locator("#decisions p", has_text="Noted on")
    expect(noted).to_contain_text(f"{scene}: brakes too late")
    noted.get_by_role("link").click()
    page.wait_for_url(f"**#scene={scene}*")
    (folder / "first/notes.json").unlink()


@pytest.mark.exhaustive
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_an_exported_list_fits_a_telephone_and_is_read_aloud(browser, folder, tmp_path, scheme):
    export(folder, tmp_path / "site", lambda done: None)
    page = browser.new_page(viewport=NARROW, color_scheme=scheme)
    page.goto((tmp_path / "site/index.html").as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"]
    said = page.evaluate(SCROLLS)
    assert [label for label, wider, sign in said if wider != sign] == []
    assert any(sign for _, _, sign in said)
    assert Axe().run(page).response["violations"] == []
    picture(page, f"export-narrow-{scheme}")
    page.close()
