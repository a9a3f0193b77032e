"""The notebook that records, diagnoses and repeats: its stored outputs, and that it runs."""

import pathlib
import re

import nbformat
import pytest
from nbclient import NotebookClient

PATH = pathlib.Path(__file__).parents[1] / "notebooks" / "06_record_diagnose_repeat.ipynb"


def printed(notebook) -> str:
    return "".join(
        output.get("text", "")
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if output.get("name") == "stdout"
    )


def numbers(notebook, pattern: str) -> list[list[float]]:
    return [[float(group) for group in found.groups()] for found in re.finditer(pattern, printed(notebook))]


def assert_the_cause_is_found_and_narrowed(notebook):
    assert printed(notebook).count("still open: intrinsic_curvature\n") == 2
    first, second = numbers(notebook, r"curvature_per_m = (\S+), 90 % within (\S+) to (\S+)")
    assert second[2] - second[1] < first[2] - first[1]
    assert abs(second[0] - 2.0) < 0.2
    assert "contradict one another: False" in printed(notebook)


def test_stored_outputs_tell_the_story():
    notebook = nbformat.read(PATH, as_version=4)
    assert_the_cause_is_found_and_narrowed(notebook)
    (before,), (after,) = numbers(notebook, r"(\d+\.\d+) cm in the last 10 s")
    assert after < before / 3


@pytest.mark.slow
def test_notebook_runs(monkeypatch):
    monkeypatch.setenv("CABLEJAX_NOTEBOOK_STEPS", "2")
    notebook = nbformat.read(PATH, as_version=4)
    NotebookClient(notebook, timeout=900, kernel_name="python3").execute()
    assert_the_cause_is_found_and_narrowed(notebook)
