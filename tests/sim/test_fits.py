"""What is read of a dataset is what its published JSON Schemas allow, as released and as written today."""

import copy
import json
from typing import Any

import msgspec
from evaluating import scenes_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from jsonschema.validators import extend

from harness.dataset.load import Dataset, find
from harness.dataset.schema import Manifest, manifest_schema, record_schema, record_type

LEAF = (
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.sampled_from(["v1", "left"])
)
ANY_JSON = st.recursive(
    LEAF,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["id", "v1", "x"]), inner),
    max_leaves=6,
)  # fmt: skip


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path of every member and item, however deep."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [p for key, inner in pairs for p in ((*path, key), *places(inner, (*path, key)))]


RELEASED = find("occluded-intersection-v2")
TYPES = Draft202012Validator.TYPE_CHECKER.redefine("integer", lambda _, value: type(value) is int)
WholeNumbers: Any = extend(Draft202012Validator, type_checker=TYPES)  # to which 1.0 is no integer


def released_schema(name: str) -> Any:
    return json.loads((RELEASED / f"{name}.schema.json").read_text())


def fits(value: Any, kind: type) -> bool:
    try:
        msgspec.json.decode(json.dumps(value), type=kind)
    except msgspec.ValidationError:
        return False
    return True


def test_the_published_schemas_are_schemas_and_allow_what_is_released(small: Dataset):
    record = json.loads((RELEASED / "scenes.jsonl").read_text().partition("\n")[0])
    manifest = json.loads((RELEASED / "manifest.json").read_text())
    for schema, value in ((record_schema(small.scenario), record), (manifest_schema(), manifest)):
        Draft202012Validator.check_schema(schema)
        WholeNumbers(schema).validate(value)


def test_every_frozen_record_fits(small: Dataset):
    assert all(fits(scene.record, record_type(small.scenario)) for scene in scenes_of(small))


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_a_changed_record_fits_where_the_published_schema_says_so(small: Dataset, data: st.DataObject):
    record = changed(data.draw(st.sampled_from(scenes_of(small))).record, data)
    now = WholeNumbers(record_schema(small.scenario))
    if WholeNumbers(released_schema("scene")).is_valid(record):
        assert now.is_valid(record)
    if now.is_valid(record):
        assert fits(record, record_type(small.scenario))
    whose = (record.get("behaviour"), record.get("outcomes"))
    if fits(record, record_type(small.scenario)):  # what the actions are stands in the manifest
        actions = {whose[0]["action"], *whose[1]}
        assert now.is_valid(record) == (actions == set(small.actions))


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_changed_manifest_fits_where_the_published_schema_says_so(data: st.DataObject):
    manifest = changed(json.loads((RELEASED / "manifest.json").read_text()), data)
    valid = WholeNumbers(manifest_schema()).is_valid(manifest)
    if WholeNumbers(released_schema("manifest")).is_valid(manifest):
        assert valid
    repeated = isinstance(manifest.get("actions"), list) and len(manifest["actions"]) > len(
        set(map(str, manifest["actions"]))
    )
    if not repeated and "scenes.jsonl" in files_of(manifest):
        assert fits(manifest, Manifest) == valid


def files_of(manifest: dict[str, Any]) -> Any:
    files = manifest.get("files")
    return files if isinstance(files, dict) else ()


def changed(value: Any, data: st.DataObject) -> Any:
    """A copy with one value changed, taken out or added."""
    record = copy.deepcopy(value)
    *way, last = data.draw(st.sampled_from(places(record)))
    holder = record
    for key in way:
        holder = holder[key]
    change = data.draw(st.sampled_from(["value", "missing", "extra"]))
    if change == "missing":
        del holder[last]
    elif change == "extra" and isinstance(holder, dict):
        holder["unknown"] = data.draw(ANY_JSON)
    else:
        holder[last] = data.draw(ANY_JSON)
    return record
