"""Layout seeds are tuned on, trained on or reported, and never two of these."""

import json
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import pages

from harness.core.errors import UserError
from harness.core.seeds import purpose, seeds_text
from harness.dataset import suites

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize(
    ("first", "count", "whose"),
    [
        (0, 1, "tune"),
        (0, 100_000, "tune"),
        (99_999, 1, "tune"),
        (100_000, 1000, "train"),
        (199_999, 1, "train"),
        (200_000, 240, "report"),
        (2**31 - 1, 100_000, "report"),
    ],
)
def test_a_range_of_layouts_is_for_one_purpose(first: int, count: int, whose: str) -> None:
    assert purpose(first, count) == whose
    assert seeds_text(first, count) == f"layout seeds {first} to {first + count - 1} ({whose})"


def test_a_range_across_a_border_is_refused_with_the_borders() -> None:
    with pytest.raises(UserError) as caught:
        purpose(99_990, 20)
    assert str(caught.value) == (
        "layout seeds 99990 to 100009 are for tune and train; keep to one of 0 to 99999 (tune), "
        "100000 to 199999 (train), 200000 and above (report)"
    )
    assert seeds_text(99_990, 200_000) == "layout seeds 99990 to 299989 (tune and train and report)"


@given(st.integers(0, 400_000), st.integers(1, 300_000))
def test_what_is_for_one_purpose_is_so_seed_by_seed(first: int, count: int) -> None:
    ends = {purpose(first, 1), purpose(first + count - 1, 1)}
    if len(ends) == 1:
        assert purpose(first, count) in ends
    else:
        with pytest.raises(UserError):
            purpose(first, count)


@pytest.mark.parametrize(
    "words",
    [
        "drive --model cruise --first-seed 99999 --episodes 2",
        "study closed-loop --model cruise --first-seed 99999 --episodes 2",
        "dataset scenario drive occluded-intersection --seed 199999 --episodes 2",
        "dataset build occluded-intersection --seed 99999 --episodes 2 --out built",
    ],
)
def test_no_command_drives_layouts_for_two_purposes_together(harness, words, tmp_path):
    code, out, err = harness(*words.split())
    assert (code, out) == (2, "")
    assert re.match(r"harness: layout seeds \d+ to \d+ are for t\w+ and \w+; keep to one of", err)
    assert not list(tmp_path.iterdir())


def test_the_models_that_ship_learnt_from_train_seeds():
    data = json.loads((ROOT / "models/swarm-tiny/training.json").read_text())["dataset"]
    assert purpose(data["seed"], data["episodes"]) == "train"
    for model in ("swarm-tiny-six", "swarm-tiny-six-v2", "swarm-tiny-vl", "swarm-smol"):
        data = json.loads((ROOT / "models" / model / "training.json").read_text())
        assert purpose(data["first_seed"], data["layouts"]) == "train"


def test_the_table_of_the_six_families_is_from_report_seeds():
    """Its command names the suite, whose datasets' manifests have the layout seeds."""
    page = (ROOT / "docs/scenarios.md").read_text()
    results = page.partition("## What models gain there")[2].partition("\n## ")[0]
    [suite] = set(re.findall(r"--dataset (suite:[\w-]+)", results))
    for dataset in suites.datasets(suite):
        manifest = json.loads((ROOT / "datasets" / dataset / "manifest.json").read_text())
        assert purpose(manifest["seed"], manifest["episodes"]) == "report", dataset


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_layout_seeds_in_the_documents_are_report_seeds_or_say_what_they_are(page: Path) -> None:
    for first, last, said in re.findall(
        r"\b[Ss]eeds (\d[\d ]*) to (\d[\d ]*\d)(?:\s\((\w+)\))?", page.read_text()
    ):
        low, high = int(first.replace(" ", "")), int(last.replace(" ", ""))
        assert purpose(low, high + 1 - low) == (said or "report"), (
            f"{page.name}: seeds {first} to {last}"
        )
