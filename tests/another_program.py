"""Another program, which answers the questions that an evaluation wrote."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluating import says

from harness.core.formats import QUESTIONS

Line = dict[str, Any]


def text_of(role: str, messages: Sequence[Mapping[str, str]]) -> str:
    """What some model says: it depends on all that it is asked."""
    slower = (sum(map(ord, json.dumps([dict(each) for each in messages]))) % 90) / 100
    return says([slower, 0.1, round(0.9 - slower, 2)], role)


def answered(out: Path) -> list[Line]:
    """The lines of a program that answers the questions in a folder."""
    lines = map(json.loads, (out / QUESTIONS).read_text().splitlines())
    return [
        {"id": q["id"], "text": text_of(q["role"], q["messages"]), "tokens": 30, "seconds": 0.5}
        for q in lines
    ]


def write(file: Path, lines: Sequence[Line]) -> None:
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
