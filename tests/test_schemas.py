"""The JSON Schemas that leave with a run: what a run has fits them, and a broken field does not."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fitting import faults, unfit
from msgspec import structs

from harness.core.files import canonical_bytes
from harness.evaluate.answer_arrays import payload_bits
from harness.runs.folder import Run, read
from harness.runs.records import Answer
from harness.runs.schemas import schemas

Harness = Callable[..., tuple[int, str, str]]
AT_M = (-12.3, 40.0)


@pytest.fixture(scope="module")
def run(two_run: Path) -> Run:
    return read(two_run)


def sent(answer: Answer) -> dict[str, Any]:
    """A helper's answer as its message."""
    intent = answer.intent and [round(share, 2) for share in answer.intent]
    return {"from": answer.viewer, "intent": intent, "says": answer.message, "xy_m": [*AT_M]}


def test_a_run_fits_its_schemas_as_they_leave(run: Run, harness: Harness) -> None:
    code, said, _ = harness("run", "export", run.path, "--schema", "here")
    names = [f"{name}.schema.json" for name in ("run", "answer", "message")]
    assert (code, said.split()) == (0, [f"here/{name}" for name in names])
    written = {name: json.loads((Path("here") / name).read_text()) for name in names}
    assert written == json.loads(json.dumps(schemas(run.actions)))
    assert list(unfit(run.path)) == []


def test_a_message_that_fits_is_the_one_whose_bits_are_counted(run: Run) -> None:
    schema = schemas(run.actions)["message.schema.json"]
    helpers = [answer for answer in run.answers if answer.role == "helper"]
    lost = structs.replace(helpers[0], intent=None, message=None)
    for answer in (*helpers[:8], lost):
        assert payload_bits(AT_M, answer) == 8 * len(canonical_bytes(sent(answer)))
        assert faults(schema, sent(answer)) == []


BROKEN: list[tuple[str, tuple[str | int, ...], Any]] = [
    ("run", ("seeds",), "0:5"),
    ("run", ("world", "kind"), "dreamt"),
    ("run", ("latency", "ego_s"), "fast"),
    ("run", ("ask",), "some"),
    ("answer", ("intent",), [0.5, 0.5]),
    ("answer", ("verdict",), "fine"),
    ("answer", ("prompt_tokens",), -1),
    ("answer", ("role",), "Ego\n"),
    ("message", ("intent", 0), 1.5),
    ("message", ("from",), "v0"),
    ("message", ("says", "risk"), "none"),
    ("message", ("says", "recommended_maneuver"), "JUMP"),
    ("message", ("xy_m",), [1.0]),
    ("message", ("more",), 1),
]


@pytest.mark.parametrize(("kind", "place", "value"), BROKEN)
def test_a_broken_field_does_not_fit(
    kind: str, place: tuple[str | int, ...], value: Any, run: Run
) -> None:
    [helper, *_] = [answer for answer in run.answers if answer.role == "helper"]
    instances = {
        "run": json.loads((run.path / "run.json").read_text()),
        "answer": json.loads((run.path / "answers.jsonl").read_text().splitlines()[0]),
        "message": json.loads(json.dumps(sent(helper))),
    }
    instance = instances[kind]
    schema = schemas(run.actions)[f"{kind}.schema.json"]
    assert faults(schema, instance) == []
    *above, last = place
    table = instance
    for key in above:
        table = table[key]
    table[last] = value
    assert faults(schema, instance)
