"""The paper's numbers, which studies of ours are held against."""

import csv
from pathlib import Path

from harness.core.files import text_of


def paper_numbers() -> list[dict[str, str]]:
    """Return the rows of `paper_numbers.csv`, the results in the paper's text and figures."""
    text = text_of(Path(__file__).with_name("paper_numbers.csv"))
    return list(csv.DictReader(text.splitlines()))
