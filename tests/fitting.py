"""Whether what a run has fits the JSON Schemas that leave with it."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema

from harness.runs.folder import read
from harness.runs.schemas import schemas


def faults(schema: dict[str, Any], instance: Any) -> list[str]:
    jsonschema.Draft202012Validator.check_schema(schema)
    found = jsonschema.Draft202012Validator(schema).iter_errors(instance)
    return [f"{list(fault.absolute_path)}: {fault.message[:80]}" for fault in found]


def unfit(run: Path) -> Iterator[str]:
    """What of a run does not fit the schemas."""
    of_run = schemas(read(run).actions)
    yield from faults(of_run["run.schema.json"], json.loads((run / "run.json").read_text()))
    validator = jsonschema.Draft202012Validator(of_run["answer.schema.json"])
    for line in (run / "answers.jsonl").read_text().splitlines():
        yield from (fault.message[:80] for fault in validator.iter_errors(json.loads(line)))
