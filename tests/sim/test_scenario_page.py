"""The scenario's page says what the code does."""

from dataclasses import asdict
from pathlib import Path

from harness.core.resources import DATASET
from harness.dataset.load import find, load
from harness.world.parameters import DIALS, SCENES
from harness.world.scenarios.occluded_intersection import SCENARIO

PAGE = (Path(__file__).parents[2] / f"docs/scenarios/{SCENARIO.name}.md").read_text()


def test_the_pages_table_has_the_dials_of_every_scenario_with_their_values():
    rows = dict(
        line.strip("| ").split(" | ")[:2] for line in PAGE.splitlines() if line.count(" | ") == 2
    )
    stated = {
        name.strip("`"): value.strip() for name, value in rows.items() if name.startswith("`")
    }
    values = {
        name: ", ".join(v if isinstance(v, str) else f"{v:g}" for v in value)
        for name, stated_value in asdict(SCENARIO.parameters).items()
        for value in [stated_value if isinstance(stated_value, tuple) else (stated_value,)]
    }
    assert {*DIALS, *SCENES} <= set(stated)
    assert stated == {name: values[name] for name in stated}


def test_the_page_counts_the_shipped_episodes_with_a_danger():
    trees = load(find(DATASET)).trees
    dangerous = sum(tree.danger.sector is not None for tree in trees)
    assert f"`danger_share`; {dangerous} of the {len(trees)} shipped" in " ".join(PAGE.split())


def test_the_page_names_the_actions():
    assert all(f"`{action}`" in PAGE for action in SCENARIO.actions)
