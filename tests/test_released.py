"""What is released is pinned, and is what it was."""

import json
import tomllib
from pathlib import Path
from shutil import copyfile
from typing import Any

import pytest

from harness.core import resources
from harness.core.errors import UserError
from harness.core.files import sha256_file
from harness.dataset import suites
from harness.dataset.load import find, load
from harness.dataset.schema import manifest_schema, record_schema, tree_schema
from harness.dataset.verify import check
from harness.prompts import versions as prompts

ROOT = Path(__file__).parent.parent
DATASETS = tomllib.loads((ROOT / "datasets/released.toml").read_text())


SHIPPED = [path.parent.name for path in (ROOT / "datasets").glob("*/manifest.json")]


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_dataset_has_the_digest_it_was_released_with_and_its_first_layout_is_sound(
    name: str,
) -> None:
    """Whatever is read is verified."""
    assert sha256_file(ROOT / "datasets" / name / "manifest.json") == DATASETS[name]
    first = load(ROOT / "datasets" / name, 1)
    names = first.forest.ids
    assert [scene.id for scene in first.scenes(names)] == list(names)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_dataset_is_sound(name: str) -> None:
    assert check(ROOT / "datasets" / name) == []


@pytest.mark.parametrize("name", tomllib.loads((ROOT / "datasets/suites.toml").read_text()))
def test_a_shipped_suite_has_one_released_dataset_of_each_family(name: str) -> None:
    suite = suites.named(f"suite:{name}")
    assert suite
    families = [
        json.loads((ROOT / "datasets" / d / "manifest.json").read_text())["scenario"]
        for d in suite.datasets
    ]
    assert set(suite.datasets) <= set(DATASETS)
    assert len(set(families)) == len(families)


@pytest.mark.parametrize("version", prompts.names())
def test_a_shipped_prompt_is_released(version: str) -> None:
    assert prompts.load(version).released


def test_a_wheel_holds_the_newest_of_each_family() -> None:
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"][
        "targets"
    ]["wheel"]
    held = {
        Path(source).name for source in wheel["force-include"] if source.startswith("datasets/")
    }
    suite = suites.named("suite:v2v-safety-2")
    assert suite
    assert held & {*DATASETS} == {*suite.datasets}


def test_a_released_dataset_that_an_installation_lacks_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "datasets").mkdir()
    copyfile(ROOT / "datasets/released.toml", tmp_path / "datasets/released.toml")
    monkeypatch.setattr(resources, "root", lambda: tmp_path)
    with pytest.raises(UserError, match="dataset blind-merge-v1 is not in this installation"):
        find("blind-merge-v1")


NEWEST = tomllib.loads((ROOT / "datasets/suites.toml").read_text())["v2v-safety-2"]["datasets"]
LATER_KINDS, LATER_FIELDS = ("bicycle", "motorcycle", "pedestrian"), ("source", "licence")


@pytest.mark.parametrize("name", NEWEST)
def test_the_newest_datasets_would_be_built_with_the_schemas_that_they_have(name: str) -> None:
    """Descriptions are docstrings: rewording one changes what a rebuild has."""
    dataset = load(ROOT / "datasets" / name, 1)
    for file, schema in (
        ("scene", record_schema(dataset.scenario)),
        ("tree", tree_schema()),
        ("manifest", manifest_schema()),
    ):
        released = json.loads((ROOT / "datasets" / name / f"{file}.schema.json").read_text())
        assert _as_released(json.loads(json.dumps(schema))) == released, file


def _as_released(schema: Any) -> Any:
    """Return a schema without what it has learnt since: kinds of road users, and where traffic is
    from.
    """
    if isinstance(schema, list):
        return [_as_released(each) for each in schema if each not in LATER_KINDS]
    if isinstance(schema, dict):
        return {key: _as_released(each) for key, each in schema.items() if key not in LATER_FIELDS}
    return schema
