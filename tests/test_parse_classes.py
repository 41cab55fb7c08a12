"""Characters that the parser takes out or makes spaces, by their definition in Unicode."""

import re
import sys

import pytest

from harness.parsing import parse

NO_WIDTH = re.compile(r"[\u200b-\u200f\u2060-\u2064\u202a-\u202e\ufeff\u00ad]")


@pytest.mark.slow
def test_the_lists_of_characters_are_all_spaces_but_those_of_json_and_all_without_width():
    every = list(map(chr, range(sys.maxunicode + 1)))
    spaces = {c for c in every if c.isspace()} - set(" \t\r\n")
    assert {c for c in every if parse._SPACE.search(c)} == spaces
    assert {c for c in every if parse._INVISIBLE.search(c)} == spaces | {
        c for c in every if NO_WIDTH.search(c)
    }
