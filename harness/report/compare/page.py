"""A comparison as one HTML file: needs no network and runs no script."""

from collections.abc import Sequence
from pathlib import Path

from harness.report.compare import words
from harness.report.compare.difference import Comparison
from harness.report.compare.gate import Verdict
from harness.report.page import environment

TEMPLATES = Path(__file__).parent / "templates"


def render(comparison: Comparison, verdicts: Sequence[Verdict], most: int) -> str:
    """The page; `most` episodes and requests are listed of each kind."""
    template = environment(TEMPLATES).get_template("compare.html.j2")
    return template.render(found=comparison, pair=comparison.pair, verdicts=verdicts, most=most, words=words)
