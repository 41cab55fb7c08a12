"""Which episodes of a dataset are evaluated: by number, by danger, drawn;
and that a run says so.
"""

import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core import resources
from harness.core.errors import UserError
from harness.dataset.load import Dataset, load
from harness.dataset.select import Selection
from harness.evaluate.resolve import driven
from harness.runs.settings import DriveSettings


@pytest.fixture(scope="module")
def shipped() -> Dataset:
    return load(resources.folder("datasets") / resources.DATASET, 60)


def test_numbers_ranges_dangers_and_the_first_are_joined(shipped: Dataset) -> None:
    assert Selection().of(shipped).episodes == tuple(range(60))
    assert Selection(only="59,3,10:13").of(shipped).episodes == (3, 10, 11, 12, 59)
    of = {tree.episode: tree.danger.sector for tree in shipped.trees}
    left = tuple(n for n in of if of[n] == "left")
    assert left
    assert Selection(danger="left").of(shipped).episodes == left
    assert Selection(danger="left", limit=2).of(shipped).episodes == left[:2]
    some = Selection(danger="none", only="0:30").of(shipped).episodes
    assert some == tuple(n for n in range(30) if of[n] is None)


@given(st.integers(0, 50), st.integers(1, 59))
def test_a_larger_sample_has_the_smaller_in_it(shipped: Dataset, seed: int, size: int) -> None:
    small, large = (
        set(Selection(sample=n, sample_seed=seed).of(shipped).episodes) for n in (size, size + 1)
    )
    assert small < large
    assert len(small) == size


def test_a_seed_draws_what_another_does_not(shipped: Dataset) -> None:
    drawn = {Selection(sample=10, sample_seed=seed).of(shipped).episodes for seed in range(5)}
    assert len(drawn) == 5


@pytest.mark.slow
def test_a_run_says_which_and_its_command_selects_them_again(harness: Callable[..., Any]) -> None:
    words = (
        "--danger",
        "left",
        "--sample",
        "2",
        "--sample-seed",
        "7",
        "--condition",
        "6g",
        "--seeds",
        "3:4",
    )
    code, out, _ = harness("eval", *words, "--out", "a")
    assert code == 0
    assert "n = 2 episodes × 1 channel seed; of layout seeds 200000 to 200199 (report);" in out
    made = json.loads(Path("a/run.json").read_text())
    assert made["world"]["selection"] == {"danger": "left", "sample": 2, "sample_seed": 7}
    again = shlex.split(made["command"])
    again[again.index("a")] = "b"
    assert harness(*again[1:])[0] == 0
    assert Path("a/episodes.csv").read_text() == Path("b/episodes.csv").read_text()


@pytest.mark.parametrize("seed", [-1, 2**31, 10**30])
def test_the_seed_of_a_draw_is_one_that_layouts_may_have(seed: int) -> None:
    said = r"^--sample-seed -?\d{1,31} is out of range; give 0 to 2147483647$"
    with pytest.raises(UserError, match=said):
        Selection(sample=1, sample_seed=seed)
    with pytest.raises(UserError, match=said):
        driven(DriveSettings(sample=1, sample_seed=seed))
