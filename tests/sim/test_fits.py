"""The quick yes to a record is never a yes that JSON Schema would not give."""

import copy
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.dataset.load import Dataset
from harness.dataset.schema import fits_record, record_validator

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


def test_it_says_yes_to_every_frozen_record(small: Dataset):
    assert all(map(fits_record(small.scenario), (scene.record for scene in small.scenes)))


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_where_it_says_yes_to_a_changed_record_so_does_json_schema(small: Dataset, data: st.DataObject):
    record = copy.deepcopy(data.draw(st.sampled_from(small.scenes)).record)
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
    if fits_record(small.scenario)(record):
        assert record_validator(small.scenario).is_valid(record)
