"""A wheel carries prompts, cards and the dataset, and works where there is no checkout."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel's content in a folder of its own."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def harness(installed: Path, cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    code = "import harness.cli, sys; sys.argv[0] = 'harness'; harness.cli.main()"
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_an_installed_wheel_evaluates_and_reports_outside_the_checkout(
    installed: Path, tmp_path: Path
) -> None:
    done = harness(installed, tmp_path, "eval", "--limit", "2", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert str(installed) in told["manifest"]["dataset"]["path"]
    run = tmp_path / told["run"]
    files = {"run.json", "rows.jsonl", "episodes.csv", "summary.csv", "report.html"}
    assert {p.name for p in run.iterdir()} == files


@pytest.mark.slow
def test_an_installed_wheel_knows_its_prompts_and_models(installed: Path, tmp_path: Path) -> None:
    prompts = json.loads(harness(installed, tmp_path, "prompt", "list", "--json").stdout)
    assert [p["version"] for p in prompts] == ["v1", "v2"]
    assert all(p["released"] for p in prompts)
    models = json.loads(harness(installed, tmp_path, "model", "list", "--json").stdout)
    assert "qwen3-4b" in {m["name"] for m in models}
