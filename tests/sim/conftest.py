"""Six frozen episodes: dangers from the left, the right and oncoming, and none."""

from collections.abc import Callable
from pathlib import Path

import pytest
from former import SCENARIO

from harness.dataset.build import build
from harness.dataset.load import Dataset, load

FIRST_SEED = 178  # left, none, left, right, left, oncoming


@pytest.fixture(scope="session")
def small_folder(once: Callable[..., Path]) -> Path:
    return once("small-v1", lambda out: build(SCENARIO, out, 6, FIRST_SEED, 1, lambda done: None))


@pytest.fixture(scope="session")
def small(small_folder: Path) -> Dataset:
    return load(small_folder)
