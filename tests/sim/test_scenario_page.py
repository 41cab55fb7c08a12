"""The scenario's page says what the code does."""

from dataclasses import asdict
from pathlib import Path

import pytest

from harness.core.resources import DATASET
from harness.dataset.load import find, load
from harness.world import scenarios
from harness.world.scenarios.occluded_intersection import SCENARIO

PAGES = Path(__file__).parents[2] / "docs/scenarios"
PAGE = (PAGES / f"{SCENARIO.name}.md").read_text()
TABLED = sorted(page.stem for page in PAGES.glob("*.md") if "## Parameters" in page.read_text())


@pytest.mark.parametrize("name", TABLED)
def test_the_pages_table_has_every_parameter_with_its_value(name):
    """The first page has those of every scenario too; the others their own."""
    page, parameters = (PAGES / f"{name}.md").read_text(), scenarios.get(name).parameters
    rows = dict(line.strip("| ").split(" | ")[:2] for line in page.splitlines() if line.count(" | ") == 2)
    stated = {name.strip("`"): value for name, value in rows.items() if name.startswith("`")}
    values = {
        name: ", ".join(v if isinstance(v, str) else f"{v:g}" for v in value)
        for name, stated_value in asdict(parameters).items()
        for value in [stated_value if isinstance(stated_value, tuple) else (stated_value,)]
        if name in type(parameters).__annotations__ or page == PAGE
    }
    assert stated == values


def test_the_page_counts_the_shipped_episodes_with_a_danger():
    trees = load(find(DATASET)).trees
    dangerous = sum(tree.danger.sector is not None for tree in trees)
    assert f"`danger_share`; {dangerous} of the {len(trees)} shipped" in " ".join(PAGE.split())


def test_the_page_names_the_actions():
    assert all(f"`{action}`" in PAGE for action in SCENARIO.actions)
