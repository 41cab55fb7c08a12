"""Alternatives that a template's author marks, one of which a search of wordings chooses.

A mark is part of a template's text and has a name. `{% either greeting %}A{% or %}B{% endeither %}`
is A or B; `{% order parts %}A{% or %}B{% endorder %}` is AB or BA. A mark of one name in both
templates is one choice. As long as nothing is chosen, a mark is its first alternative, so that the
version is an ordinary prompt.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice, permutations
from math import factorial
from types import MappingProxyType
from typing import NamedTuple

BEGIN = re.compile(r"\{%\s*(either|order)\s+(\w+)\s*%\}")
END = {kind: re.compile(rf"\{{%\s*end{kind}\s*%\}}") for kind in ("either", "order")}
OR = re.compile(r"\{%\s*or\s*%\}")
MOST_PARTS = 4  # of an `order`, which has 24 orders
MOST_MARKS = 64  # of a version: each round of a search tries every alternative of each
EXAMPLES = "examples"  # names the choice among `example_sets` of prompt.toml
FIRST: Mapping[str, int] = MappingProxyType({})  # the choice of the first alternative everywhere


class Mark(NamedTuple):
    """Describe a mark in a prompt template: alternatives to choose from, or parts to put in order.

    A search for better wordings chooses among them. A mark is written `{% either name %}A{% or
    %}B{% endeither %}`, or with `order`. `start` and `end` are its span in the template's text, as
    indices of characters; `order` is true where its parts are ordered, and not chosen from; marks
    of one `name` in both templates are one choice; `parts` are the texts between its tags.
    """

    start: int  # where it begins in the template's text
    end: int  # where the text after it begins
    order: bool  # whether its parts are ordered, and not chosen from
    name: str  # marks of one name in both templates are one choice
    parts: list[str]  # the texts between its tags

    @property
    def choices(self) -> int:
        """Return the number of alternatives: that of the parts, or of their permutations."""
        return factorial(len(self.parts)) if self.order else len(self.parts)

    def alternative(self, number: int) -> str:
        if not self.order:
            return self.parts[number]
        return "".join(next(islice(permutations(self.parts), number, None)))


def _marks(text: str) -> Iterator[Mark]:
    """Yield the marks of a text, in one pass; what never ends is none, which Jinja then refuses.

    Raises ValueError for one of too many parts.
    """
    place, endless = 0, set[str]()
    while begin := BEGIN.search(text, place):
        kind, name, place = begin[1], begin[2], begin.end()
        end = None if kind in endless else END[kind].search(text, place)
        if end is None:
            endless.add(kind)
            continue
        parts = OR.split(text[place : end.start()])
        if kind == "order" and len(parts) > MOST_PARTS:
            raise ValueError(f"mark {name} orders {len(parts)} parts; give {MOST_PARTS} at most")
        place = end.end()
        yield Mark(begin.start(), place, kind == "order", name, parts)


def resolved(text: str, choice: Mapping[str, int] = FIRST) -> str:
    """Return a template's text with each mark replaced by one of its alternatives.

    A mark (see `Mark`) is a place in `text` that has alternative texts. `choice` has the index,
    from 0, of the alternative to take, by the mark's name; marks that it lacks take the first.
    """
    pieces, place = [], 0
    for mark in _marks(text):
        pieces += [text[place : mark.start], mark.alternative(choice.get(mark.name, 0))]
        place = mark.end
    return "".join([*pieces, text[place:]])


def counts(texts: Iterable[str]) -> dict[str, int]:
    """Return the number of alternatives of each mark in some templates, by the mark's name.

    A mark (see `Mark`) is a place in a template that has alternative texts; `texts` are the
    templates' texts. Raises ValueError if a mark has one alternative, too many parts, a reserved
    name, or another number of alternatives elsewhere, and if there are more than `MOST_MARKS`
    marks.
    """
    sizes: dict[str, int] = {}
    for text in texts:
        for mark in _marks(text):
            name, n = mark.name, mark.choices
            if name == EXAMPLES:
                raise ValueError(
                    f"a mark is named {EXAMPLES}, which example_sets are; give another name"
                )
            if n < 2:
                raise ValueError(f"mark {name} has one alternative; divide them by {{% or %}}")
            if sizes.setdefault(name, n) != n:
                raise ValueError(
                    f"mark {name} has {sizes[name]} and {n} alternatives; give as many each time"
                )
    if len(sizes) > MOST_MARKS:
        raise ValueError(f"{len(sizes)} marks; give {MOST_MARKS} at most")
    return sizes
