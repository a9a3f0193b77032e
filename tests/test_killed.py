"""Kill -9 at random moments: a long command loses nothing that was complete, goes on, and ends in the same result."""

from __future__ import annotations

import csv
import dataclasses
import functools
import json
import multiprocessing
import pathlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import test_closed_loop_suite as suites
import test_dataset_generate as stores
import test_dynamics_train as trainings
from cablejax.cli import main
from cablejax.dataset.generate import generate
from cablejax.dataset.opening import open_store
from cablejax.dynamics.run_folder import CHECKPOINTS, METRICS
from cablejax.dynamics.train import train
from cablejax.gaplog import read_gap_log, write_gap_log
from cli_cases import small_model
from closed_loop.suite import read_suite, run_suite
from diagnose_cases import record

SERVER = multiprocessing.get_context("forkserver")
# Imported once, before JAX starts its threads: a child is at work at once, so that kills hit the work.
SERVER.set_forkserver_preload(
    [
        *(
            "pytest",
            "hypothesis",
            "cablejax.commands.diagnose",
            "cablejax.control.shaping",
            "cablejax.dataset.generate",
        ),
        *("cablejax.diagnose", "cablejax.dynamics.train", "cablejax.report.page", "cablejax.spatial.diagnose"),
    ]
)

SHARDS = dataclasses.replace(stores.TINY, n_trajectories=16, n_steps=10)


@dataclasses.dataclass(frozen=True)
class Command:
    """A long command: how it is started in a folder, how many of its parts are complete, and its result."""

    start: Callable[[pathlib.Path], None]
    complete: Callable[[pathlib.Path], int]
    result: Callable[[pathlib.Path], Any]


def simulate(folder):
    generate(SHARDS, folder, progress=False)


def complete_trajectories(folder):
    return open_store(folder).info().n_complete if (folder / "zarr.json").exists() else 0


def run_training(folder):
    train(trainings.LONG, trainings.DATA, folder, progress=False)


def latest_checkpoint(folder):
    return max((int(path.name) for path in (folder / CHECKPOINTS).glob("[0-9]*") if path.name.isdigit()), default=0)


def trained(folder):
    """The weights' bits, from a training that has ended, and its curve without the clock."""
    result = train(trainings.LONG, trainings.DATA, folder, progress=False)
    assert result.steps == trainings.LONG.total_steps
    with (folder / METRICS).open() as file:
        curve = [row | {"seconds": "", "waited": ""} for row in csv.DictReader(file)]
    return [np.asarray(leaf).tobytes() for leaf in trainings.jax.tree.leaves(result.weights)], curve


def end(arguments) -> None:
    """As the command line would, but for the exit of an interpreter."""
    if main(arguments) != 0:
        raise SystemExit(f"{arguments} failed")


def shape(folder):
    model, words = folder.parent / "model", ["--target", "U", "--steps", "3", "--links", "8"]
    if not (folder / "summary.json").exists():
        end(["shape", "--weights", str(model), "--out", str(folder), *words])


def kept_runs(folder):
    return 2 if (folder / "summary.json").exists() else len(list(folder.glob("parts/*.run.npz")))


def shaped(folder):
    log, summary = read_gap_log(folder / "log.npz"), json.loads((folder / "summary.json").read_text())
    assert not (folder / "parts").exists() and (folder / "report.html").exists()
    return log.keypoints.tobytes(), log.gripper_command.tobytes(), sorted(summary)


def diagnose(folder):
    if not (folder / "report.html").exists() or (folder / "parts").exists():
        end(["diagnose", str(folder.parent / "log.npz"), "--only", "bending_stiffness", "--out", str(folder)])


def diagnosed(folder):
    verdict = json.loads((folder / "verdict.json").read_text())
    assert not (folder / "parts").exists() and (folder / "report.html").exists()
    return {name: value for name, value in verdict.items() if name != "seconds"}


def ended(folder):
    return (folder / "summary.json").exists() and not (folder / "parts" / "settings.json").exists()


def demo(folder):
    if not ended(folder):
        model, words = folder.parent / "model", ["--shapes", "U", "--steps", "3", "--links", "8"]
        end(["demo", "--weights", str(model), "--out", str(folder), *words])


def study(folder):
    if not ended(folder):
        end(["study", "--rounds", "1", "--links", "8", "--out", str(folder)])


def kept_rounds(folder):
    state = folder / "parts" / "state.json"
    return 2 if ended(folder) else json.loads(state.read_text())["rounds"] if state.exists() else 0


def studied(folder):
    log, summary = read_gap_log(folder / "recording_1.npz"), json.loads((folder / "summary.json").read_text())
    verdict = {name: value for name, value in summary["verdict"].items() if name != "seconds"}
    return log.keypoints.tobytes(), summary["ended"], summary["rounds"], verdict, (folder / "report.html").exists()


def closed_loops(folder):
    cases = [suites.case(seed) for seed in range(4)]
    run_suite(cases, [suites.SERVO], folder, fine_tuned=suites.no_model, progress=False)


def trials(folder):
    made, snapshots = read_suite(folder)
    assert {trial.key for trial in made} == {snapshot.key for snapshot in snapshots}
    return [(trial.key, trial.errors_cm, trial.stopped) for trial in made]


COMMANDS = {
    "simulate": Command(simulate, complete_trajectories, lambda folder: open_store(folder).info().digest),
    "train": Command(run_training, latest_checkpoint, trained),
    "shape": Command(shape, kept_runs, shaped),
    "diagnose": Command(diagnose, lambda folder: 0, diagnosed),
    "demo": Command(demo, kept_runs, shaped),
    "study": Command(study, kept_rounds, studied),
    "closed loops": Command(closed_loops, lambda folder: len(read_suite(folder)[0]), trials),
}
KILLS = {"study": 5}
"""Of those commands that take minutes."""
PREPARED = ["shape", "diagnose", "demo"]


def run(command: Command, folder: pathlib.Path, moment: float | None = None) -> bool:
    """Runs the command in a process of its own, kills it at a moment [s], and says whether it had ended before."""
    process = SERVER.Process(target=command.start, args=(folder,))
    process.start()
    process.join(moment)
    ended = process.exitcode is not None
    process.kill()
    process.join()
    assert not ended or process.exitcode == 0
    return ended


@functools.cache
def prepared(folder: pathlib.Path) -> None:
    small_model(folder / "model")
    write_gap_log(folder / "log.npz", record(("gripper_rotation_offset", 0, (0.08,))))


@pytest.mark.timeout(3000)
@pytest.mark.parametrize(
    ("name", "kills"),
    [("simulate", 1), *(pytest.param(name, KILLS.get(name, 20), marks=pytest.mark.slow) for name in COMMANDS)],
)
def test_a_killed_command_loses_nothing_and_ends_in_the_same(name, kills, tmp_path):
    command, rng = COMMANDS[name], np.random.default_rng(0)
    if name in PREPARED:
        prepared(tmp_path)
    run(command, tmp_path / "warm")  # compiles
    began = time.monotonic()
    run(command, tmp_path / "whole")
    seconds = time.monotonic() - began
    expected, killed, complete, folder = command.result(tmp_path / "whole"), 0, 0, tmp_path / "0"
    while True:
        if run(command, folder, rng.uniform(0, seconds) if killed < kills else None):
            assert command.result(folder) == expected
            if killed == kills:
                break
            folder, complete = tmp_path / str(killed), 0
            continue
        killed += 1
        before, complete = complete, command.complete(folder)
        assert complete >= before
