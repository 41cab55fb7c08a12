"""Six frozen episodes, built once a session: dangers from the left, the right and oncoming, and none."""

from pathlib import Path

import pytest

from harness.dataset.build import build
from harness.dataset.load import Dataset, load
from harness.world.scenarios.occluded_intersection import SCENARIO

FIRST_SEED = 178  # left, none, left, right, left, oncoming


@pytest.fixture(scope="session")
def small_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("built") / "small-v1"
    build(SCENARIO, folder, 6, FIRST_SEED, 1, lambda done: None)
    return folder


@pytest.fixture(scope="session")
def small(small_folder: Path) -> Dataset:
    return load(small_folder)
