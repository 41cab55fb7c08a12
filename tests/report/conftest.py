import pytest
from sample_run import write_run

from harness.dataset.build import build
from harness.dataset.load import load
from harness.world.scenarios.occluded_intersection import SCENARIO


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """Two episodes."""
    out = tmp_path_factory.mktemp("report") / "two"
    build(SCENARIO, out, episodes=2, seed=5, workers=1, progress=lambda done: None)
    return load(out)


@pytest.fixture(scope="session")
def run(dataset, tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("report") / "sample", dataset)
