"""A real browser, Debian's chromium, and pages opened in it from disk without a network."""

import shutil

import pytest
from opening import FLAGS, WIDE, wait


# A module's and no longer: while Playwright runs, so does its event loop, and other tests have their own.
@pytest.fixture(scope="module")
def browser():
    pytest.importorskip("playwright", reason="needs the dev extra")
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium here; `make test` installs it from Debian's packages")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        yield started
        started.close()


@pytest.fixture
def opened(browser):
    """Opens a page from disk; a console message, an exception or a request in it fails the test."""
    heard, contexts = [], []

    def asked(url):
        if not url.startswith(("file:", "blob:", "data:")):
            heard.append(("request", url))

    def open_page(file, where="", size=WIDE, scheme="light"):
        context = browser.new_context(viewport=size, color_scheme=scheme, offline=True, accept_downloads=True)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: heard.append(("console", message.text)))
        page.on("pageerror", lambda error: heard.append(("error", str(error))))
        page.on("dialog", lambda dialog: (heard.append(("dialog", dialog.message)), dialog.dismiss()))
        page.on("request", lambda request: asked(request.url))
        page.goto(f"file://{file}{where}")
        wait(page)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert heard == []
