"""The notebook and the experiments on the planner's solvers, executed at smoke size."""

import json

import nbformat
import pytest
from nbclient import NotebookClient

from cablejax.cli import main
from cli_cases import small_model
from test_story import ROOT, load

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return small_model(tmp_path_factory.mktemp("model"))


def test_notebook_draws_the_path(weights, monkeypatch):
    monkeypatch.setenv("CABLEJAX_NOTEBOOK_STEPS", "2")
    monkeypatch.setenv("CABLEJAX_NOTEBOOK_POINTS", "5")
    monkeypatch.setenv("CABLEJAX_NOTEBOOK_WEIGHTS", str(weights))
    notebook = nbformat.read(ROOT / "notebooks" / "02_solvers.ipynb", as_version=4)
    NotebookClient(notebook, timeout=500, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 1
    assert any("bounds hold the plan back" in output.get("text", "") for output in outputs)


def test_ipopt_agrees_on_the_problems_of_a_small_model(weights, tmp_path, capsys):
    arguments = ["--weights", str(weights), "--problems", "2", "--exact-every", "1", "--work", str(tmp_path)]
    load("10_solvers.py").main(arguments)
    assert "2 of 2 solved" in capsys.readouterr().out
    rows = [json.loads(line) for line in next(tmp_path.glob("*.jsonl")).read_text().splitlines()]
    assert all(row["ours"]["value"] <= row["start_value"] and row["exact"]["calls"]["hessian"] > 0 for row in rows)
    # what is done is not done again
    load("10_solvers.py").main([*arguments, "--out", str(tmp_path / "page.md")])
    assert "2 planning problems" in (tmp_path / "page.md").read_text()


def test_horizons_are_compared_in_closed_loop(weights, tmp_path, capsys):
    arguments = ["--weights", str(weights), "--solvers", "deadline", "--horizons", "1", "--letters", "U"]
    arguments += ["--stiffness", "1", "--steps", "1", "--work", str(tmp_path), "--out", str(tmp_path / "page.md")]
    load("11_horizon.py").main(arguments)
    assert "| deadline | 1 | 1 |" in capsys.readouterr().out
    assert (tmp_path / "page.png").stat().st_size > 1000


def test_bench_times_solvers_and_batches(weights, capsys):
    arguments = ["--weights", str(weights), "--solver", "deadline", "--batches", "1", "2", "--repeats", "2"]
    assert main(["bench", "mpc", "--json", *arguments]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["solvers"]["deadline"]["p50_ms"] == result["p50_ms"] > 0
    assert set(result["batches"]) == {"1", "2"}
    assert all(batch["p50_ms"] > 0 and batch["cables_per_second"] > 0 for batch in result["batches"].values())
    assert main(["bench", "mpc", "--batches", "0"]) == 2
