"""Alternatives that a template's author marks, one of which `harness prompt optimize` chooses.

A mark is part of a template's text and has a name. `{% either greeting %}A{% or %}B{% endeither %}` is A or
B; `{% order parts %}A{% or %}B{% endorder %}` is AB or BA. A mark of one name in both templates is one
choice. As long as nothing is chosen, a mark is its first alternative, so that the version is an ordinary
prompt.
"""

import re
from collections.abc import Iterable, Mapping
from itertools import permutations
from types import MappingProxyType

MARK = re.compile(r"\{%\s*(either|order)\s+(\w+)\s*%\}(.*?)\{%\s*end\1\s*%\}", re.DOTALL)
OR = re.compile(r"\{%\s*or\s*%\}")
MOST_PARTS = 4  # of an `order`, which has 24 orders
EXAMPLES = "examples"  # names the choice among `example_sets` of prompt.toml
FIRST: Mapping[str, int] = MappingProxyType({})  # the choice of the first alternative everywhere


def resolved(text: str, choice: Mapping[str, int] = FIRST) -> str:
    """Return a template's text with each mark replaced by the alternative of this number, from 0."""

    def chosen(mark: re.Match[str]) -> str:
        return _alternatives(mark)[choice.get(mark[2], 0)]

    return MARK.sub(chosen, text)


def counts(texts: Iterable[str]) -> dict[str, int]:
    """Return how many alternatives each mark of some templates has, by name.

    Raises ValueError if a mark cannot be chosen from.
    """
    sizes: dict[str, int] = {}
    for text in texts:
        for mark in MARK.finditer(text):
            name, n = mark[2], len(_alternatives(mark))
            if name == EXAMPLES:
                raise ValueError(f"a mark is named {EXAMPLES}, which example_sets are; give another name")
            if n < 2:
                raise ValueError(f"mark {name} has one alternative; divide them by {{% or %}}")
            if sizes.setdefault(name, n) != n:
                raise ValueError(
                    f"mark {name} has {sizes[name]} and {n} alternatives; give as many each time"
                )
    return sizes


def _alternatives(mark: re.Match[str]) -> list[str]:
    parts = OR.split(mark[3])
    if mark[1] == "either":
        return parts
    if len(parts) > MOST_PARTS:
        raise ValueError(f"mark {mark[2]} orders {len(parts)} parts; give {MOST_PARTS} at most")
    return ["".join(order) for order in permutations(parts)]
