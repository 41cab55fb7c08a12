"""The example notebook runs from top to bottom, as someone would who has just opened it."""

from pathlib import Path

import pytest

pytest.importorskip("nbclient", reason="needs the dev extra")
pytest.importorskip("ipykernel", reason="needs the dev extra")

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parent.parent / "examples/from-python.ipynb"
pytestmark = pytest.mark.exhaustive


def test_the_example_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code)
    code[0].source = code[0].source.replace("LIMIT = 40", "LIMIT = 4")
    NotebookClient(notebook, resources={"metadata": {"path": str(tmp_path)}}).execute()
    results, picture = code[:-1], code[-1]
    assert [cell.outputs[-1].output_type for cell in results] == ["execute_result"] * len(results)
    assert all("text/html" in cell.outputs[-1].data for cell in results[:4])
    assert picture.outputs[0].output_type == "display_data"
