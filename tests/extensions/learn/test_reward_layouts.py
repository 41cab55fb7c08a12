"""Which layouts may be learnt from: by their seeds,
however they are given and whatever they are called.
"""

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gymnasium", reason="needs the sim extra")

import harness
from harness import UserError
from harness.dataset.load import find
from harness.extensions.learn.rewards.trips import Roads
from harness.world import scenarios


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"seeds": 100_000.5}, "seeds 100000.5: give a whole number"),
        ({"seeds": None}, "seeds None: give a whole number"),
        ({"layouts": 1.5}, "layouts 1.5: give a whole number"),
    ],
)
def test_what_is_no_range_of_seeds_is_one_line(options: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=f"^{re.escape(said)}$"):
        harness.environment("occluded-intersection", **options)


@pytest.mark.parametrize(
    ("seed", "said"),
    [
        (-1, "layout seed -1: give 0 to"),
        (2**31, "2147483648: give 0 to"),
        ("x", "x: give a whole number"),
    ],
)
def test_what_is_no_layout_is_one_line(seed: Any, said: str) -> None:
    driven = harness.environment("occluded-intersection", driven=True, reward="success")
    with pytest.raises(UserError, match=said):
        driven.reset(options={"layout_seed": seed})


@pytest.mark.slow
def test_report_layouts_are_refused_whatever_their_manifest_calls_them(tmp_path: Path) -> None:
    folder = tmp_path / "renamed"
    shutil.copytree(find("occluded-intersection-v2"), folder)
    file = folder / "manifest.json"
    file.write_text(file.read_text().replace('"purpose": "report"', '"purpose": "train"'))
    with pytest.raises(UserError, match=r"\[purpose\] is train, but it is of layout seeds 200000"):
        harness.environment(dataset=folder)


def test_a_scenario_of_several_agents_is_refused() -> None:
    scenario = scenarios.get("all-way-crossing:agent_share=1")
    with pytest.raises(
        UserError, match="agent_share is 1, and an environment to learn in has one ego"
    ):
        Roads(scenario, (100,))
