"""How what SmolLM2-135M-Instruct wrote is parsed; benchmarks/answer_corpus.py asked it.

`UPDATE_GOLDEN=1` writes what the parser says now; look at what changed before you keep it.
"""

import json
import lzma
import os
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from harness.parsing.parse import Parsed, Status, parse

FILE = Path(__file__).parent / "golden" / "real-answers.jsonl.xz"
SAID = ("status", "faults", "repairs", "mass")


def corpus() -> list[dict[str, Any]]:
    return [json.loads(line) for line in lzma.decompress(FILE.read_bytes()).decode().splitlines()]


def parsed(record: dict[str, Any], divides: bool = False) -> Parsed:
    return parse(
        record["text"], role=record["role"], actions=record["actions"], divides=divides,
        reasons_first=record["reasons_first"], finish_reason=record["finish_reason"],
    )  # fmt: skip


@pytest.mark.slow
def test_each_answer_is_parsed_as_it_was() -> None:
    records = corpus()
    found = [
        record | json.loads(json.dumps({name: getattr(parsed(record), name) for name in SAID}))
        for record in records
    ]
    if os.environ.get("UPDATE_GOLDEN"):
        lines = "".join(json.dumps(record, ensure_ascii=False) + "\n" for record in found)
        FILE.write_bytes(lzma.compress(lines.encode(), preset=9))
    changed = [
        (
            one["id"],
            {name: (before.get(name), one[name]) for name in SAID if before.get(name) != one[name]},
        )
        for before, one in zip(records, found, strict=True)
        if before != one
    ]
    assert not changed or os.environ.get("UPDATE_GOLDEN"), changed[:5]


def test_it_holds_answers_of_every_kind_of_question() -> None:
    records = corpus()
    assert len({record["id"] for record in records}) == len(records) >= 1000
    kinds = Counter((record["prompt"], record["role"], record["temperature"]) for record in records)
    assert len(kinds) == 11 * 2 * 3
    assert len({record["text"] for record in records}) > 500
    assert len({record["status"] for record in records}) >= 10


def test_a_declared_division_reads_what_failed_by_its_sum_alone() -> None:
    for record in corpus():
        before, after = parsed(record), parsed(record, divides=True)
        divided = "divided" in after.repairs
        assert divided == (before.faults == (Status.BAD_SUM,) and bool(before.mass))
        assert divided or after.intent == before.intent
        if divided:
            assert (after.mass, after.intent is None) == (before.mass, False)
