"""The notebook that adds an effect: what it shows, and that it runs."""

import pathlib

import nbformat
import pytest
from nbclient import NotebookClient

PATH = pathlib.Path(__file__).parents[1] / "notebooks" / "02_an_effect_of_your_own.ipynb"


def printed(notebook) -> list[str]:
    """What each cell of code printed, without those that printed nothing, or what MJX prints on import."""
    texts = [
        "".join(output.get("text", "") for output in cell.outputs if output.get("name") == "stdout")
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]
    return [text for text in texts if text and "warp" not in text]


def pictures(notebook) -> int:
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return sum("image/png" in output.get("data", {}) for output in outputs)


def tells_the_story(notebook):
    without, mine = printed(notebook)
    assert "intrinsic curvature" in without and "figure of eight" not in without
    assert mine.startswith("named -") and "figure_of_eight: curvature_per_m = 1." in mine
    assert pictures(notebook) == 1


@pytest.mark.slow
def test_notebook_runs(monkeypatch):
    monkeypatch.setenv("CABLEJAX_NOTEBOOK_EFFECTS", "bending_stiffness,intrinsic_curvature")
    notebook = nbformat.read(PATH, as_version=4)
    NotebookClient(notebook, timeout=500, kernel_name="python3").execute()
    tells_the_story(notebook)
