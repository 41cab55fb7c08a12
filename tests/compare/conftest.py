import shutil
from pathlib import Path

import pytest
from changing import SEEDS, ends
from evaluating import run as evaluate
from evaluating import spec_of

from harness.coordination.named_points import POINTS
from harness.dataset.load import Dataset


@pytest.fixture(scope="session")
def evaluated(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The proxy on four episodes, alone and under 6g, with two seeds; every helper is asked."""
    points = (POINTS["single-local"], POINTS["6g"])
    return evaluate(
        spec_of(small, points=points, seeds=SEEDS, ask="all"),
        tmp_path_factory.mktemp("compare") / "run",
    ).out


@pytest.fixture(scope="session")
def worse_once(evaluated: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    (
        """Under 6g one success of four is lost in every seed; alone nothing changes; nor do tests."""
        ""
    )
    base = tmp_path_factory.mktemp("worse")
    one, other = (Path(shutil.copytree(evaluated, base / name)) for name in ("a", "b"))
    ends(one, "6g", [["", "", "", ""]] * 2)
    ends(other, "6g", [["", "late", "", ""]] * 2)
    return one, other


@pytest.fixture
def runs(evaluated: Path, tmp_path: Path) -> tuple[Path, Path]:
    """The same run twice, each to be changed by a test."""
    return shutil.copytree(evaluated, tmp_path / "a"), shutil.copytree(evaluated, tmp_path / "b")
