"""What is said of a run: the same sentences, in one order, wherever it is shown."""

from pathlib import Path
from typing import Any

import pytest
from run_on_disk import made_up

from harness.core.plugins import Plugins
from harness.report import caveats, remarks, sections
from harness.report.runs import Runs
from harness.runs.folder import Run, read


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return read(made_up(tmp_path / "run"))


class Broken:
    """Fails, whatever it is asked."""

    def __call__(self, of: Any) -> Any:
        raise ValueError("no\nway")

    sentences = left_out = __call__


def test_a_package_that_fails_is_said_in_the_same_words_wherever_it_would_speak(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, table in ((caveats, "CAVEATS"), (sections, "SECTIONS"), (remarks, "REMARKS")):
        kind = getattr(module, table).kind
        monkeypatch.setattr(module, table, Plugins("swarmdrive.none", kind, {"odd": Broken()}))
    said = "odd: its package failed: no way"
    assert list(caveats.of_extensions(run)) == [said]
    alone = Runs((run,), ("run",), None)
    assert remarks.sentences(alone) == [said]
    [(title, content)] = sections.sections(alone)
    assert (title, said in content) == ("odd", True)
