import shutil
from pathlib import Path

import pytest
from evaluating import run as evaluate
from evaluating import spec_of
from starlette.testclient import TestClient
from viewing import SECRET, TOKEN, configure

from harness.coordination.operating_point import POINTS
from harness.dataset.load import Dataset
from harness.report.page import write_report
from harness.report.runs import gather
from harness.report.view.access import cookie
from harness.report.view.app import app


@pytest.fixture(scope="session")
def made(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frozen runs, `first` with a report, and a sweep in it."""
    folder = tmp_path_factory.mktemp("viewed") / "reports"
    points = (POINTS["single-local"], POINTS["6g"])
    for name, model in (("first", "proxy"), ("second", "cruise")):
        evaluate(spec_of(small, model, points=points, tags=(f"tag of {name}",)), folder / name)
    write_report(gather([folder / "first"]), folder / "first/report.html")
    (folder / "first/sweep-tau").mkdir()
    (folder / "first/sweep-tau/sweep.json").write_text('{"sources": [{"name": "proxy · v2 · json"}]}')
    for name in ("sweep.svg", "sweep.png", "more.png", "sweep.pdf", "sweep.csv"):
        (folder / "first/sweep-tau" / name).write_text(f"<svg>{name}</svg>")
    return folder


@pytest.fixture
def reports(made: Path, tmp_path: Path) -> Path:
    folder = shutil.copytree(made, tmp_path / "reports")
    for name, day in (("first", 1), ("second", 2)):
        configure(folder / name, created=f"2026-01-0{day}T12:00:00+00:00")
    (tmp_path / "secret").mkdir()
    for file in ("run.json", "report.html", "index.html", "sweep.svg", "secret.txt"):
        (tmp_path / "secret" / file).write_text(SECRET)
    return folder


@pytest.fixture
def browser(reports: Path) -> TestClient:
    """Who has opened the address that `harness view` printed."""
    return TestClient(
        app(reports, TOKEN), base_url="http://127.0.0.1:7654", raise_server_exceptions=False,
        cookies={cookie(7654): TOKEN},
    )  # fmt: skip
