import pytest
from sample_run import write_run

from harness.dataset.load import load


@pytest.fixture(scope="session")
def dataset(two_path):
    """Two episodes."""
    return load(two_path)


@pytest.fixture(scope="session")
def run(dataset, tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("report") / "sample", dataset)
