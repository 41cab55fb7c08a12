"""The paper's numbers, which studies of ours are held against."""

import csv
from pathlib import Path

from harness.core.files import text_of


def paper_numbers() -> list[dict[str, str]]:
    """Return the numbers that the repeated paper states, the rows of `paper_numbers.csv`.

    The paper is the one whose study this harness follows. A row is one number of its text or
    figures: the text of each cell, such as `id`, `metric` and `paper_value`, by its column.
    """
    text = text_of(Path(__file__).with_name("paper_numbers.csv"))
    return list(csv.DictReader(text.splitlines()))
