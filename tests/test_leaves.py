"""A sample of the campaign of changed leaves; `benchmarks/campaigns/README.md` has all of it."""

import subprocess
import sys
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).parents[1] / "benchmarks/campaigns/leaves.py"
PROJECT = ("network", "device", "card", "prompt", "suite", "curves")  # what is read in milliseconds

pytestmark = pytest.mark.exhaustive


def test_a_changed_leaf_of_a_project_is_one_line(tmp_path: Path) -> None:
    kinds = [word for kind in PROJECT for word in ("--kind", kind)]
    command = [sys.executable, str(CAMPAIGN), "--count", "100", "--seed", "7", *kinds]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert '"faults": 0}' in done.stdout
