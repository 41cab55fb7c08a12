"""What is said of the project outside its code: version, licence and authors are the same everywhere."""

import tomllib
from pathlib import Path

import yaml

from harness.backends import cards

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {key: citation[key] for key in ("version", "license", "authors")} == {
        key: PROJECT[key] for key in ("version", "license", "authors")
    }
    assert [paper["url"] for paper in citation["references"]] == [PROJECT["urls"]["Paper"]]


def test_code_dataset_and_weights_have_one_licence() -> None:
    licence = PROJECT["license"]
    assert "Apache License" in (ROOT / "LICENSE").read_text()
    for model in ("swarm-tiny", "swarm-tiny-six", "swarm-tiny-vl"):
        assert cards.load(model).licence == licence
        assert f"Licence: {licence}" in (ROOT / "models" / model / "README.md").read_text()
    for manifest in (ROOT / "datasets").glob("*/manifest.json"):
        [row] = [
            line for line in (ROOT / "datasets/README.md").read_text().splitlines()
            if line.startswith(f"| `{manifest.parent.name}` |")
        ]  # fmt: skip
        assert licence in row
