"""The notebook on the solvers' paths: what it shows, and that it runs."""

import pathlib

import nbformat
import pytest
from nbclient import NotebookClient

PATH = pathlib.Path(__file__).parents[1] / "notebooks" / "03_solvers.ipynb"
SOLVERS = ("Levenberg-Marquardt", "dogleg", "Gauss-Newton", "quasi-Newton", "spectral gradient")


def printed(notebook) -> str:
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return "".join(output.get("text", "") for output in outputs if output.get("name") == "stdout")


def tells_the_story(notebook):
    """Every solver ends in the plane at the same value, and there are two pictures."""
    lines = printed(notebook).splitlines()
    ends = [float(line.split(" to ")[1].split()[0]) for line in lines if line.startswith(SOLVERS)]
    assert len(ends) == len(SOLVERS)
    assert max(ends) <= min(ends) * (1 + 1e-3)
    steps = [float(line.split(": ")[1].split()[0]) for line in lines if line.startswith("step ")]
    assert len(steps) > 2 and steps[-1] < 0.5 * steps[0] and steps == sorted(steps, reverse=True)
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2


def test_notebook_was_run_before_it_was_kept():
    tells_the_story(nbformat.read(PATH, as_version=4))


@pytest.mark.slow
def test_notebook_runs():
    notebook = nbformat.read(PATH, as_version=4)
    NotebookClient(notebook, timeout=500, kernel_name="python3").execute()
    tells_the_story(notebook)
