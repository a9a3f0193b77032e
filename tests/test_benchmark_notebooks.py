"""The run of all notebooks: what it executes, keeps and prints, and what their pages say of the tests."""

import pathlib
import sys

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))

import notebook_pages
import notebooks


def test_notebooks_are_executed_kept_and_timed(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv(notebooks.RECORDED, raising=False)
    for name, code in {"01_sum": "print(1 + 1)", "02_real": "import os; os.environ['CABLEJAX_DATA']"}.items():
        nbformat.write(new_notebook(cells=[new_code_cell(code)]), tmp_path / f"{name}.ipynb")
    assert notebooks.main(["--folder", str(tmp_path), "--keep", "--most", "0"]) == 1
    shown = capsys.readouterr().out
    assert "| 01_sum |" in shown and "without 02_real, which needs $CABLEJAX_DATA" in shown
    [cell] = nbformat.read(tmp_path / "01_sum.ipynb", as_version=4).cells
    assert [output["text"] for output in cell.outputs] == ["2\n"] and "execution" not in cell.metadata
    monkeypatch.setenv(notebooks.RECORDED, str(tmp_path))
    assert [path.stem for path in notebooks.chosen(tmp_path, ["02"])[0]] == ["02_real"]
    with pytest.raises(SystemExit, match=r"no notebook in .* begins with 3"):
        notebooks.chosen(tmp_path, ["3"])


def test_every_notebook_page_says_what_the_tests_execute():
    assert {path.stem for path in notebooks.FOLDER.glob("*.ipynb")} == set(notebook_pages.TESTS)
    page, _ = notebook_pages.notebook_page({"cells": [{"cell_type": "markdown", "source": ["# A"]}]}, "04_real_cable")
    assert "The tests execute it up to the diagnosis" in page
