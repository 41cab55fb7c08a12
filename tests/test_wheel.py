"""The wheel works where there is no checkout and no extra:
it carries prompts, cards and the dataset.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NO_FIGURES = (
    "harness: drawing figures needs matplotlib, which is not installed; "
    "run `pip install 'swarmdrive-harness[report]'`"
)
FROM_PYTHON = """
import sys
import harness
run, *_ = sys.argv[1:]
episodes, listed = harness.load(run).episodes.episode, harness.ls()
print(len(set(episodes)), len(listed), type(harness.compare(run, run)).__name__)
"""
pytestmark = pytest.mark.exhaustive


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """An environment with the wheel and what it requires, and nothing else."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(folder),
        str(ROOT),
    ]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    bare = folder / "bare"
    subprocess.run([sys.executable, "-m", "venv", str(bare)], check=True)
    python = str(bare / "bin/python")
    for command in (
        [sys.executable, str(ROOT / "requirements.py"), "packages", "base", python, "--no-compile"],
        [python, "-m", "pip", "install", "--quiet", "--no-compile", "--no-index", str(wheel)],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        offline = re.search(r"NewConnectionError|NameResolutionError|ConnectTimeout", done.stderr)
        if offline and "CI" not in os.environ:
            pytest.skip("no package index is reached")
        assert done.returncode == 0, done.stderr
    yield bare
    shutil.rmtree(bare)  # half a gigabyte


def test_a_bare_install_evaluates_and_reports_outside_the_checkout(
    site: Path, tmp_path: Path
) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def typed(*words: str) -> "subprocess.CompletedProcess[str]":
        command = [str(site / "bin/harness"), *words]
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )

    def harness(*words: str) -> str:
        done = typed(*words)
        assert done.returncode == 0, done.stderr
        return done.stdout

    prompts = json.loads(harness("prompt", "list", "--json"))
    assert [p["version"] for p in prompts] == sorted(
        file.parent.name for file in ROOT.glob("prompts/*/prompt.toml")
    )
    assert all(p["released"] for p in prompts)
    lacks = {m["name"]: m["missing"] for m in json.loads(harness("model", "list", "--json"))}
    assert (lacks["proxy"], lacks["qwen3-4b"]) == (None, "torch")
    lost = typed("eval", "--model", "qwen3-8b")
    [card] = re.findall(r"copy its card (\S+) to models/qwen3-8b\.toml", lost.stderr)
    assert (lost.returncode, Path(card).is_relative_to(site)) == (2, True)
    assert Path(card).read_bytes() == (ROOT / "docs/cards/qwen3-8b.toml").read_bytes()

    told = json.loads(harness("eval", "--model", "proxy", "--limit", "2", "--json"))
    assert str(site) in told["manifest"]["world"]["path"]
    run = tmp_path / told["run"]
    files = {
        "run.json",
        "answers.jsonl",
        "decisions.parquet",
        "episodes.csv",
        "summary.csv",
        "report.html",
    }
    assert {p.name for p in run.iterdir()} == {*files, "run.toml", "sources"}
    assert harness("--help").startswith("Usage: harness [OPTIONS] COMMAND")
    over = ("--over", "loss", "--grid", "0,0.4")
    swept = typed("study", "sweep", str(run), *over, "--out", "swept", "--pictures")
    assert (swept.returncode, swept.stderr.splitlines()[-1]) == (0, NO_FIGURES), swept.stderr
    assert re.search(r"^0\.4 +\d", swept.stdout, re.MULTILINE)
    assert (tmp_path / "swept/conditions.csv").read_text().startswith("source,panel,")
    python = [str(site / "bin/python"), "-c", FROM_PYTHON, str(run)]
    done = subprocess.run(
        python, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "2 1 Comparison\n"), done.stderr
    simulated = typed("drive", "--model", "proxy")
    assert (simulated.returncode, simulated.stderr.count("\n")) == (2, 1)
    assert "pip install 'swarmdrive-harness[sim]'" in simulated.stderr
    [metadata] = site.glob("lib/*/site-packages/swarmdrive_harness-*.dist-info")
    assert (metadata / "licenses/LICENSE").read_text() == (ROOT / "LICENSE").read_text()
