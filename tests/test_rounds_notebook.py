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


def left_open(notebook) -> list[set[str]]:
    return [set(names.split(", ")) for names in re.findall(r"still open: (.*)", printed(notebook))]


def errors_cm(notebook) -> list[float]:
    return [float(number) for number in re.findall(r"(\d+\.\d+) cm in the last 10 s", printed(notebook))]


def assert_narrowed(notebook):
    first, second = left_open(notebook)
    assert "bending_stiffness" in second and len(second) < len(first)


def test_stored_outputs_tell_the_story():
    notebook = nbformat.read(PATH, as_version=4)
    assert_narrowed(notebook)
    before, after = errors_cm(notebook)
    assert after < before


@pytest.mark.slow
def test_notebook_runs(monkeypatch):
    monkeypatch.setenv("CABLEJAX_NOTEBOOK_STEPS", "2")
    notebook = nbformat.read(PATH, as_version=4)
    NotebookClient(notebook, timeout=900, kernel_name="python3").execute()
    assert_narrowed(notebook)
    assert len(errors_cm(notebook)) == 2
