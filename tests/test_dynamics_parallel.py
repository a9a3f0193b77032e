"""Training on several devices: the gradient of one, and checkpoints that go on with another number of devices."""

import dataclasses
import os
import pathlib
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.dataset.windows import draw_windows
from cablejax.dynamics.checkpoint import Checkpoints
from cablejax.dynamics.parallel import loss_and_gradient, on_all_devices, training_mesh
from cablejax.dynamics.run_folder import CHECKPOINTS
from cablejax.dynamics.train import TrainState, batch_loss, train
from cablejax.dynamics.train_config import Phase
from cablejax.dynamics.weights import fingerprint
from dynamics_cases import SMALL, TINY_TRAINING, as_float64, network, trajectories

DATA = trajectories()
SHARED = dataclasses.replace(
    TINY_TRAINING, phases=(Phase(steps=4, batch=16), Phase(steps=4, batch=8, rollout=2)), chunk=2
)


def gradient(count: int, double: bool):
    """Loss and gradient of one batch of the second phase on `count` devices, as NumPy arrays."""
    phase, mesh = SHARED.phases[1], training_mesh(SHARED, jax.devices()[:count])
    with jax.enable_x64(double):
        cast = as_float64 if double else lambda tree: tree
        graphdef, weights = network(SMALL)
        windows = cast(draw_windows(jax.random.key(1), DATA, batch=phase.batch, history=3, steps=2))
        weights, windows = on_all_devices((cast(weights), windows), mesh)

        def loss(weights, windows):
            return batch_loss(weights, graphdef, windows, SMALL)

        made = jax.jit(lambda weights, windows: loss_and_gradient(loss, weights, windows, mesh))(weights, windows)
        assert all(len(leaf.devices()) == count for leaf in jax.tree.leaves(made))
        return [np.asarray(leaf) for leaf in jax.tree.leaves(made)]


def compare_gradients(double: bool, tolerance: float):
    one = gradient(1, double)
    size = max(np.abs(leaf).max() for leaf in one[1:])
    assert size > 1e-3 and one[0].dtype == (np.float64 if double else np.float32)
    for count in (2, 8):
        for a, b in zip(one, gradient(count, double), strict=True):
            np.testing.assert_allclose(b, a, rtol=0, atol=10 * tolerance * size)


def train_on(count: int, folder: pathlib.Path) -> np.ndarray:
    """The weights of a training on some devices, as one array, once it has ended."""
    result = train(SHARED, DATA, folder, validation=DATA, devices=jax.devices()[:count], progress=False)
    assert result.completed and all(len(leaf.devices()) == 1 for leaf in jax.tree.leaves(result.weights))
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(result.weights)])


def saved_in(folder: pathlib.Path) -> tuple[list[int], str]:
    """Steps of the checkpoints, and the hash of the newest one."""
    with Checkpoints(folder / CHECKPOINTS) as checkpoints:
        state = fingerprint(checkpoints.restore(_like()))
    return sorted(int(path.name) for path in (folder / CHECKPOINTS).glob("[0-9]*")), state


def go_on_with_other_devices(place: str):
    """Trains on two devices, then from their last but one checkpoint on one, two and eight."""
    whole = pathlib.Path(place) / "two"
    expected, (steps, ended) = train_on(2, whole), saved_in(whole)
    assert steps == [6, 8]
    shutil.rmtree(whole / CHECKPOINTS / "8")
    made = {}
    for count in (1, 2, 8):
        folder = whole.with_name(f"on {count}")
        shutil.copytree(whole, folder)
        made[count] = train_on(count, folder), saved_in(folder)[1]
    assert made[2][1] == ended, "as many devices end in the same bits"
    np.testing.assert_array_equal(made[2][0], expected)
    for count in (1, 8):
        difference = np.abs(made[count][0] - expected).max()
        assert difference < 1e-6, f"{difference} on {count} devices"
    for count in (1, 8):  # what two devices saved at the end, read by others, is what they ended with
        shutil.copytree(whole.with_name("on 2"), whole.with_name(f"read on {count}"))
        np.testing.assert_array_equal(train_on(count, whole.with_name(f"read on {count}")), expected)


def _like() -> TrainState:
    weights = network(SMALL)[1]
    return TrainState(weights, weights, SHARED.optimiser().init(weights), jnp.zeros((), jnp.int32))


def on_eight_devices(call: str) -> None:
    """Calls one of this file's functions in a process that has eight devices."""
    code = f"import sys; sys.path.insert(0, {os.fspath(pathlib.Path(__file__).parent)!r})\n"
    code += f"from test_dynamics_parallel import *\n{call}\nprint(jax.device_count())"
    done = run_on_devices(8, [sys.executable, "-c", code])
    assert done.returncode == 0 and done.stdout.split()[-1] == "8", done.stderr


def run_on_devices(count: int, command: list[str]) -> subprocess.CompletedProcess:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={count}"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)


@pytest.mark.parametrize(
    "precision",
    [pytest.param("False, 1e-6", marks=pytest.mark.slow, id="single"), pytest.param("True, 1e-14", id="double")],
)
def test_two_and_eight_devices_have_the_gradient_of_one(precision):
    on_eight_devices(f"compare_gradients({precision})")


@pytest.mark.slow
def test_a_training_goes_on_with_another_number_of_devices(tmp_path):
    on_eight_devices(f"go_on_with_other_devices({os.fspath(tmp_path)!r})")


def test_a_batch_that_devices_cannot_share_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"Phase 1 .* batches of 16 windows, which 3 devices cannot share .*--batch"):
        train(SHARED, DATA, tmp_path / "run", devices=3 * jax.devices()[:1], progress=False)
    assert not (tmp_path / "run").exists()


def test_processes_of_jax_distributed_are_refused(monkeypatch):
    monkeypatch.setattr("jax.process_count", lambda: 4)
    with pytest.raises(ValueError, match=r"one of 4 processes .* a training is one process"):
        training_mesh(SHARED)


@pytest.mark.slow
def test_the_command_says_so_before_it_reads(tmp_path):
    command = [sys.executable, "-m", "cablejax"]
    data = [*command, "simulate", "--trajectories", "40", "--steps", "24", "--links", "5", "--process-count", "4"]
    assert run_on_devices(1, [*data, "--process-index", "0", "--out", str(tmp_path / "data")]).returncode == 0
    begun = [*command, "train", "--preset", "smoke", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run")]
    assert "which 3 devices cannot share equally" in run_on_devices(3, begun).stderr
    assert "holds" in run_on_devices(1, begun).stderr, "the data are not complete, which reading them finds"
    assert not (tmp_path / "run").exists()
