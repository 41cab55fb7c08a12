"""Draw the pictures of a report again, from a run of `harness eval --model swarm-tiny --prompt v2`.

    python docs/pictures/report.py reports/swarm-tiny-v2-occluded-intersection-v2

It takes the `dev` extra and Debian's chromium, as the tests of pages do.
"""

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from opening import FLAGS, wait

HERE = Path(__file__).parent
DECISION, CAMERAS = (
    "#scene=00003-3-86ea843fc7e0&condition=v2x",
    "#scene=00156-2-c2bfbec56419&condition=6g",
)

with sync_playwright() as playwright:
    browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
    for name, where, part in (
        ("overview", "", None),
        ("decision", DECISION, None),
        ("cameras", CAMERAS, "section.cameras"),
    ):
        page = browser.new_page(viewport={"width": 1440, "height": 900}, color_scheme="light")
        page.goto(f"file://{Path(sys.argv[1]).absolute()}/report.html{where}")
        wait(page)
        (page.locator(part) if part else page).screenshot(path=HERE / f"report-{name}.png")
    browser.close()
