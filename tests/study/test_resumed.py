"""A study that was killed and typed again is, byte for byte, one that ran through; and asks nothing twice."""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from killed_study import COMMANDS

from harness.studies.replayed_run import MORE

SCRIPT = Path(__file__).parents[1] / "killed_study.py"


@pytest.fixture(scope="module")
def studies(small_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("studies")
    subprocess.run([sys.executable, str(SCRIPT), str(small_path), str(folder)], check=True)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_resumed_study_has_the_files_of_one_that_ran_through(name: str, studies: Path) -> None:
    whole, resumed = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (studies / kind / name for kind in ("whole", "resumed"))
    )
    assert whole.keys() == resumed.keys()
    assert [path for path in whole if whole[path] != resumed[path]] == []


@pytest.mark.slow
def test_no_study_keeps_an_answer_twice(studies: Path) -> None:
    kept = list(studies.glob(f"*/*/run/{MORE}"))
    assert {path.parts[-3] for path in kept} >= {"trust", "schedule", "attribute"}
    for path in kept:
        asked = Counter(
            (a["scene"], a["viewer"], a["role"], tuple(a.get("heard", ())))
            for a in map(json.loads, path.read_text().splitlines())
        )
        assert max(asked.values()) == 1, path
