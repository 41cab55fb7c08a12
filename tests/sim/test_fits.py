"""What is read of a dataset is what its published JSON Schemas allow,
as released and as written today.
"""

import copy
import json
from typing import Any
from zipfile import ZipFile

import msgspec
import pytest
from evaluating import scenes_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from jsonschema.validators import extend

from harness.core.resources import DATASET
from harness.dataset.load import Dataset, find
from harness.dataset.schema import (
    Manifest,
    Record,
    Tree,
    manifest_schema,
    record_schema,
    record_type,
    tree_schema,
)
from harness.dataset.verify import level_name, tree_name

FINITE = st.floats(allow_nan=False, allow_infinity=False)  # JSON has no other
LEAF = st.none() | st.booleans() | st.integers() | FINITE | st.sampled_from(["v1", "left"])


def around(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """The same, and lists and objects of it."""
    keys = st.sampled_from(["id", "v1", "x"])
    return inner | st.lists(inner, max_size=3) | st.dictionaries(keys, inner)


ANY_JSON = around(around(LEAF))


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path of every member and item, however deep."""
    pairs = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return [p for key, inner in pairs for p in ((*path, key), *places(inner, (*path, key)))]


RELEASED = find(DATASET)
TYPES = Draft202012Validator.TYPE_CHECKER.redefine("integer", lambda _, value: type(value) is int)
WholeNumbers: Any = extend(Draft202012Validator, type_checker=TYPES)  # to which 1.0 is no integer


def released_schema(name: str) -> Any:
    return json.loads((RELEASED / f"{name}.schema.json").read_text())


def plain(record: Record) -> Any:
    return json.loads(msgspec.json.encode(record))


def fits(value: Any, kind: type) -> bool:
    try:
        msgspec.json.decode(json.dumps(value), type=kind)
    except msgspec.ValidationError:
        return False
    return True


@pytest.fixture(scope="module")
def released() -> dict[str, Any]:
    """The first of each that is released, by the name of its schema."""
    with ZipFile(RELEASED / "layouts.zip") as file:
        return {
            "scene": json.loads(file.read(level_name(0, 1)).partition(b"\n")[0]),
            "tree": json.loads(file.read(tree_name(0))),
            "manifest": json.loads((RELEASED / "manifest.json").read_text()),
        }


@pytest.mark.slow
def test_the_published_schemas_are_schemas_and_allow_what_is_released(
    small: Dataset, released: dict[str, Any]
):
    now = {
        "scene": record_schema(small.scenario),
        "tree": tree_schema(),
        "manifest": manifest_schema(),
    }
    for name, value in released.items():
        for schema in (now[name], released_schema(name)):
            Draft202012Validator.check_schema(schema)
            WholeNumbers(schema).validate(value)


def test_every_frozen_record_and_tree_fits(small: Dataset):
    records = [plain(scene.record) for scene in scenes_of(small)]
    assert all(fits(record, record_type(small.scenario)) for record in records)
    assert all(fits(msgspec.to_builtins(tree), Tree) for tree in small.trees)


@pytest.mark.slow
@settings(
    max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(data=st.data())
def test_a_changed_record_fits_where_the_published_schema_says_so(
    small: Dataset, data: st.DataObject
):
    record = changed(plain(data.draw(st.sampled_from(scenes_of(small))).record), data)
    valid = WholeNumbers(record_schema(small.scenario)).is_valid(record)
    if WholeNumbers(released_schema("scene")).is_valid(record):
        assert valid
    assert fits(record, record_type(small.scenario)) == valid


@pytest.mark.slow
@settings(
    max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(data=st.data())
def test_a_changed_tree_fits_where_the_published_schema_says_so(
    small: Dataset, data: st.DataObject
):
    tree = msgspec.to_builtins(data.draw(st.sampled_from(small.trees)))
    # So that not every draw is of the middle of a large one.
    tree["levels"] = [level[:3] for level in tree["levels"][-2:]]
    tree = changed(tree, data)
    valid = WholeNumbers(tree_schema()).is_valid(tree)
    if WholeNumbers(released_schema("tree")).is_valid(tree):
        assert valid
    assert fits(tree, Tree) == valid


@pytest.mark.slow
@settings(
    max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(data=st.data())
def test_a_changed_manifest_fits_where_the_published_schema_says_so(
    released: dict[str, Any], data: st.DataObject
):
    manifest = changed(released["manifest"], data)
    valid = WholeNumbers(manifest_schema()).is_valid(manifest)
    if WholeNumbers(released_schema("manifest")).is_valid(manifest):
        assert valid
    repeated = isinstance(manifest.get("actions"), list) and len(manifest["actions"]) > len(
        set(map(str, manifest["actions"]))
    )
    if not repeated:
        assert fits(manifest, Manifest) == valid


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
