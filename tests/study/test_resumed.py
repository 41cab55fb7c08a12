"""A study that was killed and typed again is, byte for byte, one that ran through; and asks nothing twice."""

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import killed_study
import pytest
from killed_study import COMMANDS

from harness.studies.replayed_run import MORE

Once = Callable[[str, Callable[[Path], object]], Path]
EACH_KIND = ("trust", "grid")  # one reads a run and asks it more, the other makes runs


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in EACH_KIND else pytest.mark.exhaustive)
        for name in COMMANDS
    ],
)
def test_a_resumed_study_has_the_files_of_one_that_ran_through_and_keeps_no_answer_twice(
    name: str, once: Once, small_path: Path, tmp_path: Path
) -> None:
    base = once("studied", lambda folder: killed_study.base(small_path, folder))
    killed_study.study_of(name, base, tmp_path)
    whole, resumed = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (tmp_path / kind for kind in ("whole", "resumed"))
    )
    assert whole.keys() == resumed.keys()
    assert [path for path in whole if whole[path] != resumed[path]] == []
    kept = whole.get(Path("run", MORE))
    assert kept or name not in ("trust", "schedule", "attribute")
    if kept:
        asked = Counter(
            (a["scene"], a["viewer"], a["role"], tuple(a.get("heard", ())))
            for a in map(json.loads, kept.splitlines())
        )
        assert max(asked.values()) == 1
