import pytest
from sample_run import write_run

from harness.dataset.build import build
from harness.dataset.load import load
from harness.world.scenarios.occluded_intersection import SCENARIO


@pytest.fixture(scope="session")
def dataset(once):
    """Two episodes."""
    return load(once("two", lambda out: build(SCENARIO, out, 2, 5, 1, lambda done: None)))


@pytest.fixture(scope="session")
def run(dataset, tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("report") / "sample", dataset)
