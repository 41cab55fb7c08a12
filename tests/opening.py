"""Pages in a browser: when they are drawn, and what they look like."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "test-pictures"  # for people to look at; nothing compares them
WIDE, NARROW = {"width": 1440, "height": 1000}, {"width": 390, "height": 844}
SHEETS = 6  # that a page prints on at most, unless more is asked for
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
]
# Of what may be wider than its place: whether it is, and whether it says so.
SCROLLS = """() => [...document.querySelectorAll(".scroll")].filter((e) => e.checkVisibility()).map((e) => [
  e.ariaLabel, e.scrollWidth > e.clientWidth, getComputedStyle(e, "::before").maxHeight !== "0px"])"""


def wait(page):
    """Until what the address asks for is drawn."""
    page.wait_for_selector("body[data-ready]", state="attached")
    one = page.evaluate("new URLSearchParams(location.hash.slice(1)).has('scene')")
    page.wait_for_selector("#decision[data-drawn]" if one else "body[data-drawn]", state="attached")


def sheets(page):
    """How many sheets a page prints on, of the size that its style sheet names."""
    return len(re.findall(rb"/Type\s*/Page\b", page.pdf(prefer_css_page_size=True)))


def picture(page, name):
    """Keep what the page looks like."""
    PICTURES.mkdir(exist_ok=True)
    page.screenshot(path=PICTURES / f"{name}.png", full_page=True)
