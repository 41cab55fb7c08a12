from pathlib import Path

import pytest
from evaluating import run as evaluate
from evaluating import spec_of
from starlette.testclient import TestClient
from viewing import laid_out, visitor

from harness.coordination.named_points import POINTS
from harness.dataset.load import Dataset
from harness.report.page import write_report
from harness.report.runs import gather


@pytest.fixture(scope="session")
def made(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frozen runs, `first` with a report, and a sweep in it."""
    folder = tmp_path_factory.mktemp("viewed") / "reports"
    points = (POINTS["single-local"], POINTS["6g"])
    for name, model in (("first", "proxy"), ("second", "cruise")):
        evaluate(spec_of(small, model, points=points, tag=(f"tag of {name}",)), folder / name)
    write_report(gather([folder / "first"]), folder / "first/report.html")
    (folder / "first/sweep-tau").mkdir()
    (folder / "first/sweep-tau/sweep.json").write_text(
        '{"sources": [{"name": "proxy · v2 · json"}]}'
    )
    for name in ("sweep.svg", "sweep.png", "more.png", "sweep.pdf", "sweep.csv"):
        (folder / "first/sweep-tau" / name).write_text(f"<svg>{name}</svg>")
    return folder


@pytest.fixture
def reports(made: Path, tmp_path: Path) -> Path:
    return laid_out(made, tmp_path)


@pytest.fixture
def client(reports: Path) -> TestClient:
    return visitor(reports)


@pytest.fixture(scope="session")
def kept_reports(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `reports`, for tests that change nothing of it."""
    return laid_out(made, tmp_path_factory.mktemp("kept"))


@pytest.fixture(scope="session")
def reader(kept_reports: Path) -> TestClient:
    """As `client`, of who changes nothing."""
    return visitor(kept_reports)
