"""The wheel's check: which commands it runs, in which environment, and what it prints."""

import math
import pathlib
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))

import wheel


def test_the_commands_are_readmes_in_their_order_and_short():
    commands = wheel.readme_commands((wheel.ROOT / "README.md").read_text(encoding="utf-8"))
    named = [words[0] for words in commands]
    assert named == ["cable", "simulate", "train", "shape", "diagnose", "simulate", "import"]
    assert commands[0] == ["cable", "--out", "cable.toml"], "comments are none of it"
    assert all(words[-2:] == ["--trajectories", "100"] for words in commands if words[0] == "simulate")


def test_nothing_of_the_callers_environment_but_the_network_is_left(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "src")
    monkeypatch.setenv("CABLEJAX_CACHE", "warm")
    monkeypatch.setenv("PIP_DEFAULT_TIMEOUT", "60")
    found = wheel.clean_environment(tmp_path)
    assert not {"PYTHONPATH", "CABLEJAX_CACHE", "JAX_COMPILATION_CACHE_DIR", "VIRTUAL_ENV"} & set(found)
    assert found["HOME"] == str(tmp_path) and found["PIP_DEFAULT_TIMEOUT"] == "60"


def test_a_step_that_fails_or_should_ends_the_check(tmp_path):
    stranger = wheel.Stranger(tmp_path / "home")
    assert stranger.run(sys.executable, "-c", "import os; print(os.environ['HOME'])").strip() == str(tmp_path / "home")
    with pytest.raises(SystemExit, match="ended with code 3"):
        stranger.run(sys.executable, "-c", "raise SystemExit(3)")
    with pytest.raises(SystemExit, match="ended with code 0"):
        stranger.run(sys.executable, "-c", "pass", fails=True)
    assert len(stranger.steps) == 1


def test_the_table_has_a_column_for_each_python():
    steps = [wheel.Step("cablejax demo", 100.4, 180.0), wheel.Step(wheel.FIRST, 60.0, math.nan)]
    text = wheel.table({"python3.11": steps, "python3.13": steps})
    assert "| command | Python 3.11 [s] | Python 3.13 [s] |" in text
    assert "| `cablejax demo` | 100 (180) | 100 (180) |" in text and "| 60 | 60 |" in text
