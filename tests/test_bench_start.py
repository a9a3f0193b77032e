"""`cablejax bench start`: processes are timed with an empty and then a filled folder for compiled programs."""

import json
import pathlib

import pytest

from cablejax.cli import main
from cablejax.commands.bench_start import staged_log, twice
from cablejax.compiled_programs import FOLDER
from cablejax.gaplog import read_gap_log, write_gap_log
from cli_cases import small_model
from diagnose_cases import record

KINDS = {"wall_s", "cpu_s"}


def test_start_up_is_timed_without_jax(capsys):
    assert main(["bench", "start", "--parts", "import", "help", "--repeats", "1", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert {"device", "machine"} < set(result) and not {"control", "verdict"} & set(result)
    for part in ("import", "help"):
        assert set(result[part]) == KINDS and all(seconds > 0 for seconds in result[part].values())
    assert result["import"]["cpu_s"] < result["help"]["cpu_s"] < 10


def test_the_second_run_finds_what_the_first_kept(tmp_path, monkeypatch):
    """And nothing that the user's own settings name."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "users"))
    program = (
        "import json, os, pathlib\n"
        f"folder = pathlib.Path(os.environ['{FOLDER}'])\n"
        "filled = folder.exists()\n"
        "folder.mkdir(exist_ok=True)\n"
        "print(json.dumps([filled, 'JAX_COMPILATION_CACHE_DIR' in os.environ]))"
    )
    assert twice(["-c", program], tmp_path / "programs", own=True) == {"empty": [False, False], "filled": [True, False]}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--parts"], "expected some of import, help, control, verdict"),
        (["--horizon", "-1"], "--horizon is -1"),
        (["--repeats", "0"], "--repeats is 0"),
        (["none.npz"], "none.npz"),
        (["--parts", "control", "--weights", "nowhere"], "nowhere"),
    ],
    ids=" ".join,
)
def test_what_cannot_be_timed_is_said(words, message, capsys):
    assert main(["bench", "start", *words]) == 2
    said = capsys.readouterr()
    assert message in said.err and said.out == ""


@pytest.mark.slow
def test_first_call_and_verdict_of_a_log(tmp_path, capsys):
    """A log without a gap and a small model: programs that were kept are not compiled again."""
    log, model = write_gap_log(tmp_path / "quiet.npz", record()), small_model(tmp_path)
    words = ["--parts", "control", "verdict", "--weights", str(model), "--horizon", "1", "--json"]
    assert main(["bench", "start", str(log), *words]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["verdict"]["logs"]) == {"quiet"} and "import" not in result
    assert result["verdict"]["logs"]["quiet"] == {state: result["verdict"][state] for state in ("empty", "filled")}
    for part in ("control", "verdict"):
        empty, filled = (result[part][state] for state in ("empty", "filled"))
        assert set(empty) == set(filled) == KINDS
        assert 0 < filled["cpu_s"] < empty["cpu_s"]


@pytest.mark.slow
def test_a_log_is_staged_where_none_is_given(tmp_path):
    log = read_gap_log(staged_log(pathlib.Path(tmp_path / "staged.npz"), seed=1))
    assert log.meta["source"] == "contact plant" and log.keypoints.shape[0] >= 2
