"""A real browser, Debian's chromium, and pages opened in it from disk without a network."""

import shutil

import pytest
from opening import FLAGS, WIDE, wait

CHROMIUM = shutil.which("chromium")
RUNNING = pytest.StashKey["Running"]()


class Running:
    """One browser for all tests with it that follow each other, which count it together."""

    def __init__(self, counted):
        self.counted, self.engine, self.browser = counted, None, None

    def started(self):
        if self.browser is None:
            from playwright.sync_api import sync_playwright

            self.engine = sync_playwright().start()
            self.browser = self.engine.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        return self.browser

    def end(self):
        if self.browser is not None:
            with self.counted():
                self.browser.close()
                self.engine.stop()
            self.browser = None


@pytest.fixture(scope="session")
def running(shared_work, request):
    made = Running(shared_work)
    request.config.stash[RUNNING] = made
    yield made
    made.end()


# While Playwright runs, so does its event loop, and other tests have their own.
@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    if "running" not in getattr(nextitem, "fixturenames", ()):
        made = item.config.stash.get(RUNNING, None)
        if made is not None:
            made.end()


@pytest.fixture
def browser(running):
    pytest.importorskip("playwright", reason="needs the dev extra")
    if CHROMIUM is None:
        pytest.skip("no chromium here; `make test` installs it from Debian's packages")
    return running.started()


@pytest.fixture
def opened(browser):
    """Opens a page from disk; a console message, an exception or a request in it fails the test."""
    heard, contexts = [], []

    def asked(url):
        if not url.startswith(("file:", "blob:", "data:")):
            heard.append(("request", url))

    def open_page(file, where="", size=WIDE, scheme="light"):
        context = browser.new_context(
            viewport=size, color_scheme=scheme, offline=True, accept_downloads=True
        )
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: heard.append(("console", message.text)))
        page.on("pageerror", lambda error: heard.append(("error", str(error))))
        page.on(
            "dialog", lambda dialog: (heard.append(("dialog", dialog.message)), dialog.dismiss())
        )
        page.on("request", lambda request: asked(request.url))
        page.goto(f"file://{file}{where}")
        wait(page)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert heard == []
