"""The notebook that tells the story, executed at smoke size."""

import pathlib

import nbformat
import pytest
from nbclient import NotebookClient

from cli_cases import small_model

ROOT = pathlib.Path(__file__).parents[1]


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return small_model(tmp_path_factory.mktemp("model"))


@pytest.mark.slow
def test_notebook_shapes_a_cable(weights, monkeypatch):
    monkeypatch.setenv("CABLEJAX_NOTEBOOK_STEPS", "1")
    monkeypatch.setenv("CABLEJAX_NOTEBOOK_LINKS", "12")
    monkeypatch.setenv("CABLEJAX_NOTEBOOK_WEIGHTS", str(weights))
    notebook = nbformat.read(ROOT / "notebooks" / "01_shape_a_cable.ipynb", as_version=4)
    NotebookClient(notebook, timeout=500, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 4
    assert any("U:" in text or "S:" in text for text in (output.get("text", "") for output in outputs))
