"""The scenario's page says what the code does."""

from dataclasses import asdict
from pathlib import Path

from harness.core.resources import DATASET
from harness.dataset.load import find, load
from harness.world.scenarios.occluded_intersection import SCENARIO

PAGE = (Path(__file__).parents[2] / "docs/scenarios/occluded-intersection.md").read_text()


def test_the_pages_table_has_every_parameter_with_its_value():
    rows = dict(line.strip("| ").split(" | ")[:2] for line in PAGE.splitlines() if line.count(" | ") == 2)
    stated = {name.strip("`"): value for name, value in rows.items() if name.startswith("`")}
    values = {
        name: ", ".join(f"{v:g}" for v in value) if isinstance(value, tuple) else f"{value:g}"
        for name, value in asdict(SCENARIO.parameters).items()
    }
    assert stated == values


def test_the_page_counts_the_shipped_episodes_with_a_danger():
    trees = load(find(DATASET)).trees
    dangerous = sum(tree.danger.sector is not None for tree in trees)
    assert f"`danger_share`; {dangerous} of the {len(trees)} shipped" in " ".join(PAGE.split())


def test_the_page_names_the_actions():
    assert all(f"`{action}`" in PAGE for action in SCENARIO.actions)
