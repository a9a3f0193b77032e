"""What surrounds a command: Ctrl-C, a full disk, a folder that cannot be written, two writers, a closed pipe."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import test_dataset_store as stores
import test_recordings_csv as tables
from cablejax.cli import main
from cablejax.commands.resuming import unfinished
from cablejax.dataset import generate as generation
from cablejax.dataset.opening import open_or_create, open_store
from cablejax.dynamics.run_folder import claim_folder
from cablejax.gaplog import read_gap_log, write_gap_log
from cablejax.whole_file import sole_writer, whole_file
from cli_cases import small_model
from diagnose_cases import record

# a shell starts what it runs in the background deaf to Ctrl-C
LISTENING = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from cablejax.cli import main
print("ready", flush=True)
sys.exit(main())
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "store"
    assert main(["simulate", "--trajectories", "4", "--steps", "20", "--links", "5", "--out", str(path)]) == 0
    return path


def long_table(folder):
    """A recording that takes a while to be read."""
    table = {name: np.tile(np.asarray(column), 400) for name, column in tables.in_space().items()}
    return tables.written(folder, table | {"t": 1000 * tables.DT * np.arange(len(table["t"]))}, tables.PAIRS)


INTERRUPTED = {
    "simulate": lambda folder, store: ["simulate", "--engine", "chain"],
    "train": lambda folder, store: ["train", "--preset", "released", "--data", str(store)],
    "shape": lambda folder, store: ["shape", "--target", "S"],
    "demo": lambda folder, store: ["demo"],
    "study": lambda folder, store: ["study"],
    "diagnose": lambda folder, store: [
        "diagnose",
        str(write_gap_log(folder / "log.npz", record(("gripper_rotation_offset", 0, (0.08,))))),
    ],
    "bench": lambda folder, store: ["bench", "simulate", "--rounds", "1000"],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "seconds"), [(name, seconds) for name in INTERRUPTED for seconds in (4.0, 10.0)] + [("import", 0.5)]
)
def test_ctrl_c_is_answered_at_once(command, seconds, store, tmp_path):
    if command == "import":
        table, layout = long_table(tmp_path)
        arguments = ["import", "csv", str(table), "--layout", str(layout)]
    else:
        arguments = INTERRUPTED[command](tmp_path, store)
    if command != "bench":  # which writes nothing
        arguments += ["--out", str(tmp_path / ("out.npz" if command == "import" else "out"))]
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    process = subprocess.Popen(
        [sys.executable, "-c", LISTENING, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment | {"CABLEJAX_CACHE": str(tmp_path / "cache")},
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        time.sleep(seconds)
        began = time.monotonic()
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[1]
        took = time.monotonic() - began
    finally:
        process.kill()
    assert process.returncode == 130 and b"again" in said and b"Traceback" not in said
    assert took < 3, f"answered after {took:.1f} s, expected two on an idle machine"
    if command == "import":
        assert not (tmp_path / "out.npz").exists()


@contextlib.contextmanager
def disk_with(most: int):
    """No file may become larger: what a full disk is to a program."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_leaves_what_was_there(tmp_path, capsys):
    table, layout = tables.written(tmp_path, tables.in_space(), tables.PAIRS)
    imports = ["import", "csv", str(table), "--layout", str(layout)]
    for number, arguments in enumerate((["cable"], imports)):
        out = tmp_path / f"{number}.npz"
        out.write_text("mine")
        before = sorted(tmp_path.iterdir())
        with disk_with(400):
            assert main([*arguments, "--out", str(out), "--overwrite"]) == 2
        shown = capsys.readouterr().err
        assert "File too large" in shown and "Traceback" not in shown
        assert sorted(tmp_path.iterdir()) == before and out.read_text() == "mine"


def test_a_full_disk_costs_a_store_one_shard(tmp_path):
    data = open_or_create(tmp_path / "data", stores.SMALL)
    data.write_shard(0, stores.block(stores.SMALL, 0))
    with disk_with(0), pytest.raises(OSError, match="File too large"):
        data.write_shard(1, stores.block(stores.SMALL, 1))
    assert [data.status(shard) for shard in range(3)] == ["complete", "missing", "missing"]
    with disk_with(0), pytest.raises(OSError, match="File too large"):
        open_or_create(tmp_path / "other", stores.SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "shape"])
def test_a_full_disk_is_reported_and_the_same_command_goes_on(command, store, tmp_path, capfd):
    small = ["--preset", "smoke", "--latent", "8", "--message-passing", "1", "--steps", "4", "--held-out", "0.5"]
    arguments, most = {
        "train": (["train", "--data", str(store), *small], 40_000),
        "shape": (["shape", "--weights", str(small_model(tmp_path / "model")), "--steps", "2", "--links", "8"], 6_000),
    }[command]

    def run(folder):
        return main([*arguments, "--out", str(tmp_path / folder)])

    def result(folder):
        if command == "train":
            return (tmp_path / folder / "weights.safetensors").read_bytes().partition(b"__metadata__")[2]
        log = read_gap_log(tmp_path / folder / "log.npz")
        return log.keypoints.tobytes() + log.gripper_command.tobytes()

    assert run("whole") == 0  # and keeps what it compiled, which has its own place on the disk
    capfd.readouterr()
    with disk_with(most):
        assert run("full") == 2
    shown = capfd.readouterr().err
    assert f"cablejax: {tmp_path}/full" in shown and "File too large" in shown and "Traceback" not in shown
    assert run("full") == 0 and result("full") == result("whole")


@pytest.mark.parametrize("command", ["cable", "simulate", "diagnose"])
def test_a_folder_that_cannot_be_written_is_reported(command, tmp_path, capsys):
    log = write_gap_log(tmp_path / "log.npz", record())
    arguments = {"cable": [], "simulate": ["--links", "5"], "diagnose": [str(log)]}[command]
    assert main([command, *arguments, "--out", "/sys/cablejax"]) == 2
    shown = capsys.readouterr().err
    assert "cablejax: /sys/" in shown and ("not permitted" in shown or "denied" in shown)
    assert "Errno" not in shown and ".part" not in shown and "Traceback" not in shown


def test_a_second_writer_is_refused_and_the_first_loses_nothing(tmp_path, store, capsys):
    again = ["simulate", "--trajectories", "4", "--steps", "20", "--links", "5", "--out", str(store)]
    digest = open_store(store).info().digest
    writer = store / f"{generation.WRITER}0-of-1"
    writer.mkdir(exist_ok=True)
    with sole_writer(writer):
        assert main(again) == 2 and "Another process is writing" in capsys.readouterr().err
        assert main([*again, "--seed", "1", "--overwrite"]) == 2
    assert main([*again, "--json"]) == 0 and json.loads(capsys.readouterr().out)["digest"] == digest
    with whole_file(tmp_path / "a") as first:
        first.write(b"one")
        with pytest.raises(ValueError, match="Another process"), whole_file(tmp_path / "a") as second:
            second.write(b"two")
    assert (tmp_path / "a").read_bytes() == b"one"
    with unfinished(tmp_path / "out", {"steps": 2}, overwrite=False) as parts:
        parts.state.write_text("kept")
        for steps in (2, 3):
            other = unfinished(tmp_path / "out", {"steps": steps}, overwrite=True)
            with pytest.raises(ValueError, match="Another process"), other:
                pass
        assert parts.state.read_text() == "kept" and parts.differing() == []
    claim_folder(tmp_path / "train", {"config": {}, "data": "a"}, overwrite=False)
    with sole_writer(tmp_path / "train"), pytest.raises(ValueError, match="Another process"):
        claim_folder(tmp_path / "train", {"config": {}, "data": "b"}, overwrite=True)
    assert (tmp_path / "train" / "run.json").exists()


OFFLINE = """
import os, sys

def refuse(event, given):
    if event in ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto"):
        print(event, given[1:], file=sys.stderr, flush=True)
        os._exit(7)

sys.addaudithook(refuse)
"""
ONLINE = "import socket; socket.create_connection(('localhost', 9))"
COMMANDS = "import json; from cablejax.cli import main; sys.exit(max(map(main, json.loads(sys.argv[1]))))"


@pytest.mark.slow
def test_no_command_uses_the_network(tmp_path):
    """An audit hook, which no import can get around, ends the process at the first look-up of a name or connection."""
    table, layout = tables.written(tmp_path, tables.in_space(), tables.PAIRS)
    cable, data, log = (str(tmp_path / name) for name in ("cable.toml", "data", "log.npz"))
    small = ["--trajectories", "2", "--steps", "2", "--links", "13"]
    words = [
        ["cable", "--out", cable],
        ["simulate", "--cable", cable, "--engine", "chain", "--out", data, *small],
        ["import", "csv", str(table), "--layout", str(layout), "--out", log],
        *(["view", made] for made in (cable, data, log)),
    ]

    def run(program, *arguments):
        return subprocess.run([sys.executable, "-c", OFFLINE + program, *arguments], capture_output=True, text=True)

    offline = run(COMMANDS, json.dumps(words))
    assert offline.returncode == 0, offline.stderr
    assert all((tmp_path / f"{name}.html").exists() for name in ("cable", "data", "log"))
    assert run(ONLINE).returncode == 7, "this test has to notice what uses the network"


@pytest.mark.parametrize("arguments", ["diagnose --help", "cable"])
def test_a_closed_pipe_is_no_error(arguments):
    line = f"'{sys.executable}' -m cablejax {arguments} | true"
    run = subprocess.run(["bash", "-o", "pipefail", "-c", line], capture_output=True, text=True, timeout=120)
    assert run.returncode == 141 and run.stderr == ""


def test_the_bar_moves_before_a_shard_is_done(monkeypatch):
    monkeypatch.setattr(generation, "available_cores", lambda: 1)
    config = dataclasses.replace(stores.SMALL, engine="threaded")
    moved: list[int] = []
    generation.simulate(config, generation.make_engine(config), [0], moved.append)
    assert moved == [2, 1]
