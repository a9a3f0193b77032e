"""The command line as a person or a script meets it."""

import importlib.metadata
import itertools
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import time
import types
from typing import Any

import pytest

from cablejax.cable import Cable
from cablejax.cable_file import write_cable
from cablejax.cli import main
from cablejax.commands import options
from cablejax.commands.train import _names
from cablejax.dynamics.weights import weights_path

COMMANDS = ["bench", "cable", "demo", "diagnose", "export", "import", "shape", "simulate", "study", "train", "view"]
TAKING = ["export"], ["view"], ["import", "csv"]
"""Commands that do not run without a file."""
SUBCOMMANDS = (
    *([name] for name in COMMANDS if name not in ("bench", "import", "export", "view")),
    ["bench", "simulate"],
    ["bench", "mpc"],
    *TAKING,
)


def help_of(command: list[str], capsys) -> str:
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_help_names_every_command(capsys):
    rows = [line.strip("│•| ").split() for line in help_of([], capsys).splitlines() if "•" in line]
    rows = [row for row in rows if len(row) > 1]
    # each with what it does
    assert {row[0] for row in rows} >= {*COMMANDS}


def test_version_is_that_of_the_package(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"cablejax {importlib.metadata.version('cablejax')}\n"


def test_two_threads_are_refused(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("NPROC", "2")
    assert main(["cable", "--out", str(tmp_path / "never.toml")]) == 2
    assert "NPROC is 2" in capsys.readouterr().err and not any(tmp_path.iterdir())


@pytest.mark.parametrize("command", SUBCOMMANDS, ids=" ".join)
def test_help_explains_every_option(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "2000")
    text = help_of(command, capsys)
    assert "--json" in text and "--device" in text
    assert command in TAKING or "(required)" not in text, "the command runs without options"
    lines = [line.strip("│| ") for line in text[text.index("-h, --help") :].splitlines()]
    options = [(line, below) for line, below in itertools.pairwise(lines) if line.startswith("--")]
    for line, below in options:
        # beside a short option, below a long one
        words = re.sub(r"\(default: .*?\)|\(required\)|\(repeatable\)", "", line.partition("  ")[2] or below)
        assert len(words.split()) > 2, line
    assert len(options) >= 2


@pytest.mark.parametrize("command", SUBCOMMANDS, ids=" ".join)
def test_help_of_an_option_is_wrapped_by_the_terminal_alone(command, capsys, monkeypatch):
    # the line breaks of a docstring once stayed in the middle of a sentence
    monkeypatch.setenv("COLUMNS", "2000")
    text = help_of(command, capsys)
    lines = [line.strip("│| ") for line in text[text.index("--device") :].splitlines()]
    lines = [line for line in lines if any(letter.isalpha() for letter in line)]
    assert len(lines) > 3
    assert all(line.startswith("-") or before.startswith("-") for before, line in itertools.pairwise(lines))


def test_help_is_fast_because_it_loads_neither_jax_nor_mujoco():
    check = (
        "import sys, cablejax.cli\n"
        "try: cablejax.cli.main(['train', '--help'])\n"
        "except SystemExit: pass\n"
        "sys.exit(sorted({'jax', 'mujoco', 'matplotlib', 'flax'} & set(sys.modules)) or 0)"
    )
    run = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["simulate", "--trajectories", "0"], "n_trajectories is 0"),
        (["simulate", "--timestep", "0.03"], "expected a multiple of the time step, 0.03 s"),
        (["simulate", "--timestep", "nan"], "timestep is nan"),
        (["simulate", "--links", "1"], "n_links is 1"),
        (["simulate", "--links", "3"], "n_links 3, expected at least 5"),
        (["simulate", "--links", "4"], "n_links 4, expected at least 5"),
        (["simulate", "--max-amplification", "0"], "max_amplification is 0"),
        (["simulate", "--max-amplification", "-1"], "max_amplification is -1"),
        (["simulate", "--max-amplification", "nan"], "max_amplification is nan"),
        (["simulate", "--max-amplification", "1e-30"], "expected a number from 0.5"),
        (["simulate", "--trajectories", "9" * 30], "n_trajectories is an integer of 100 bits, expected a whole number"),
        (["simulate", "--stiffness-range", "1e308", "1e308"], "each a number from 0.001 to 1000"),
        (["train", "--lr", "1e308"], "--lr is 1e+308, expected a number from 1e-12 to 1"),
        (["shape", "--noise-mm", "1e30"], "expected a number from 0 to 100 mm"),
        (["simulate", "--with", "/dev/zero"], "no regular file"),
        (["train", "--steps", "0"], "--steps is 0"),
        (["train", "--steps", "-1"], "--steps is -1"),
        (["simulate", "--cable", "none.toml"], "There is no file or folder none.toml"),
        (["simulate", "--effect", "magic:x=1"], "no effect 'magic'"),
        (["simulate", "--effect", "bending_stiffness:ratio=-1"], "ratio is -1"),
        (
            ["simulate", "--engine", "mjx", "--effect", "plasticity:yield_curvature_per_m=5"],
            "Simulators that have: chain",
        ),
        (["simulate", "--with", "none.json"], "There is no file none.json"),
        (["simulate", "--seed", "-1"], "--seed is -1"),
        (["train", "--data", "nowhere.zarr"], "holds no data set"),
        (["bench", "simulate", "--batch", "0"], "--batch is 0"),
        (["bench", "simulate", "--trajectories", "-1"], "--trajectories is -1, expected a whole number from 0"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_bad_input_is_reported_without_a_traceback(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    shown = capsys.readouterr()
    assert message in shown.err and "Traceback" not in shown.err
    assert shown.out == ""
    assert list(tmp_path.iterdir()) == []


def test_a_gpu_that_is_not_there_is_said_to_be_missing(tmp_path):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", "cablejax", "simulate", "--device", "gpu", "--out", str(tmp_path / "store")]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 2
    assert "--device gpu was asked for" in run.stderr and "--device cpu" in run.stderr
    assert "Traceback" not in run.stderr and not (tmp_path / "store").exists()


def test_simulate_says_its_result_as_json_and_repeats_it(tmp_path, capsys):
    arguments = ["simulate", "--json", "--trajectories", "2", "--steps", "2", "--links", "5", "--seed", "3"]
    results = []
    for name in ("a", "b"):
        assert main([*arguments, "--out", str(tmp_path / name)]) == 0
        shown = capsys.readouterr()
        results.append(json.loads(shown.out))
        assert "2 trajectories" in shown.err
    assert results[0]["complete"] == results[0]["trajectories"] == 2
    assert results[0]["digest"] == results[1]["digest"]


def test_simulate_advises_to_train_only_where_that_is_possible(tmp_path, capsys):
    arguments = ["simulate", "--trajectories", "2", "--steps", "2", "--links", "5"]
    assert main([*arguments, "--out", str(tmp_path / "even cable")]) == 0
    assert f"cablejax train --data '{tmp_path / 'even cable'}'" in capsys.readouterr().out
    write_cable(tmp_path / "cable.toml", Cable(n_keypoints=4, marks=(0.0, 0.2, 0.7, 1.0)))
    assert main([*arguments, "--cable", str(tmp_path / "cable.toml"), "--out", str(tmp_path / "uneven")]) == 0
    shown = capsys.readouterr()
    assert "cablejax train" not in shown.out and "`keypoints = 4`" in shown.err


def test_simulate_refuses_a_folder_that_holds_something_else(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["simulate", "--out", str(tmp_path), "--overwrite"]) == 2
    assert "holds no data set" in capsys.readouterr().err
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_data_set_is_not_overwritten_with_files_of_the_user_in_it(tmp_path, capsys):
    simulate = ["simulate", "--trajectories", "1", "--links", "5", "--out", str(tmp_path / "data"), "--overwrite"]
    assert main([*simulate, "--steps", "1"]) == 0
    (tmp_path / "data" / "notes.txt").write_text("mine")
    assert main([*simulate, "--steps", "2"]) == 2
    assert "data holds notes.txt besides a data set" in capsys.readouterr().err
    (tmp_path / "data" / "notes.txt").unlink()
    assert main([*simulate, "--steps", "2"]) == 0


def test_overwrite_repairs_or_replaces_a_damaged_data_set(tmp_path, capsys):
    simulate = ["simulate", "--trajectories", "1", "--links", "5", "--out", str(tmp_path / "data"), "--overwrite"]
    for steps in ("1", "1", "2"):
        assert main([*simulate, "--steps", steps]) == 0, capsys.readouterr().err
        (tmp_path / "data" / "attempts" / "zarr.json").write_text("{")


def test_output_folder_that_exists_is_refused_unless_overwritten(tmp_path):
    (tmp_path / "old.txt").write_text("mine")
    with pytest.raises(options.UsageError, match=r"exists and is not empty.*--overwrite"):
        options.output_folder(tmp_path, overwrite=False)
    options.output_folder(tmp_path, overwrite=True)
    assert (tmp_path / "old.txt").exists()
    with pytest.raises(options.UsageError, match="which is a file"):
        options.output_folder(tmp_path / "old.txt", overwrite=True)


@pytest.mark.slow
def test_interrupting_a_long_simulation_tells_how_to_go_on(tmp_path):
    store = tmp_path / "store"
    command = [sys.executable, "-m", "cablejax", "simulate", "--trajectories", "100000", "--steps", "20"]
    process = subprocess.Popen([*command, "--links", "5", "--out", str(store)], stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 120
        while not any((store / "digest" / "c").glob("*")) and time.monotonic() < deadline:
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "Run the same generation again" in said and "Traceback" not in said


@pytest.mark.slow
def test_bench_simulate_relates_the_engines(capsys):
    small = ["--links", "5", "--batch", "4", "--rounds", "2", "--trajectories", "3", "--steps", "4"]
    assert main(["bench", "simulate", "--json", *small]) == 0
    result = json.loads(capsys.readouterr().out)
    micros, steps = result["us_per_simulated_second"], result["us_per_env_step"]
    assert micros["chain"] == pytest.approx(20 * steps["chain"]) and micros["mjx"] == pytest.approx(50 * steps["mjx"])
    assert result["relative_to_c"]["mjx"] == pytest.approx(micros["mjx"] / micros["c_one"])
    for name in ("chain", "mjx", "threaded"):
        assert 0 < result["accuracy"][name]["median_mm"] <= result["accuracy"][name]["largest_mm"] < 10
        per_transition = sum(result["us_per_transition"][name].values())
        assert result["transitions_per_second"][name] == pytest.approx(1e6 / per_transition)
        assert result["two_million_transitions_min"][name] == pytest.approx(per_transition / 30)
    assert result["mjx_memory_per_env_bytes"] > 0 and result["mjx_compile_s"] > 0


def test_importing_the_simulators_prints_nothing():
    words = [sys.executable, "-c", "import cablejax.control.shaping, cablejax.environment"]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout == ""


def test_text_table_lines_up():
    text = options.text_table(["shape", "error"], [["U", "0.5"], ["long name", "12.25"]])
    assert text.splitlines()[1:] == ["---------  -----", "U            0.5", "long name  12.25"]


def test_a_training_does_not_replace_the_weights_that_it_starts_from(tmp_path, capsys):
    out = tmp_path / "model"
    out.mkdir()
    weights = out / "weights.safetensors"
    shutil.copy(weights_path("gns-reference"), weights)
    for start in (out, weights):
        assert main(["train", "--data", "nowhere.zarr", "--start-from", str(start), "--out", str(out)]) == 2
        assert "where the training writes its own weights. Name another folder" in capsys.readouterr().err
    assert weights.read_bytes() == weights_path("gns-reference").read_bytes()


def test_data_sets_of_one_name_are_told_apart():
    stores: list[Any] = [
        types.SimpleNamespace(path=pathlib.Path(place)) for place in ("x/a.zarr", "y/a.zarr", "z/a 1.zarr", "b")
    ]
    assert _names(stores) == ["a 2", "a 3", "a 1", "b"]
