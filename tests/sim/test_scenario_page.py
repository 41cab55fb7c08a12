"""The page on scenarios says what the code does."""

import re
from pathlib import Path

import pytest

from harness.core.resources import DATASET
from harness.dataset.load import find, load
from harness.world.parameters import DIALS, SCENES

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/scenarios.md").read_text()
SHIPPED = sorted(path.stem for path in (ROOT / "harness/world/scenarios").glob("[a-z]*.py"))


@pytest.mark.parametrize("module", SHIPPED)
def test_every_scenario_has_a_row_and_a_page_of_what_was_measured(module: str):
    name = module.replace("_", "-")
    assert f"| [{name}](#{name}) |" in PAGE or f"| `{name}` |" in PAGE
    measured = (ROOT / f"benchmarks/measured/scenarios/{name}.md").read_text()
    assert measured.startswith(f"# Scenario `{name}`: measured\n")


def test_the_dials_that_the_page_names_are_those_of_every_scenario():
    named = set(re.findall(r"`((?:beacon|perfect)_[a-z_]+|ambient|radio_share|witnesses)\b", PAGE))
    assert len(named) > 4
    assert named <= {*DIALS, *SCENES}


def test_the_page_counts_the_shipped_episodes_with_a_danger():
    trees = load(find(DATASET)).trees
    dangerous = sum(tree.danger.sector is not None for tree in trees)
    assert f"`danger_share`; {dangerous} of the {len(trees)} shipped" in " ".join(PAGE.split())
    assert "In three quarters of episodes" in " ".join(PAGE.split())
