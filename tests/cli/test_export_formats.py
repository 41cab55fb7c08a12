"""Formats of `harness run export` that a package adds."""

import inspect
from pathlib import Path
from typing import Any

import pytest

from harness.cli import export
from harness.runs.exports import EXPORTS
from harness.runs.folder import Run


class Names:
    """A format of a package: the conditions' names."""

    help, doing, needs = "Write names.", "writing names", ("no_module_of_an_extra",)

    def write(self, run: Run, file: Path, dataset: Path | None) -> Path:
        file.write_text(" ".join(run.conditions))
        return file


def test_a_package_adds_a_format_as_an_option(monkeypatch: pytest.MonkeyPatch) -> None:
    added = {"names-of": Names(), "csv": Names(), "no name": Names()}
    monkeypatch.setattr(EXPORTS, "built_in", added)
    monkeypatch.setattr(EXPORTS, "_loaded", dict(added))
    monkeypatch.setattr(EXPORTS, "_entries", dict)

    def command(junit: Path | None = None, sft: Path | None = None, added: Any = None) -> Any:
        return junit, sft, added

    typed = export._with_formats(command)
    assert list(inspect.signature(typed).parameters) == ["junit", "names_of", "sft"]
    file = Path("names")
    assert typed(junit=None, names_of=file, sft=None) == (None, None, {"--names-of": file})
