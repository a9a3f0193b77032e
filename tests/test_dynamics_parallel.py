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
from cablejax.dynamics.fingerprint import fingerprint
from cablejax.dynamics.parallel import loss_and_gradient, on_all_devices, training_mesh
from cablejax.dynamics.run_folder import CHECKPOINTS
from cablejax.dynamics.train import TrainState, batch_loss, train
from cablejax.dynamics.train_config import Phase
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
            return batch_loss(weights, graphdef, windows, phase, SMALL)

        made = jax.jit(lambda weights, windows: loss_and_gradient(loss, weights, windows, mesh))(weights, windows)
        assert all(len(leaf.devices()) == count for leaf in jax.tree.leaves(made))
        return [np.asarray(leaf) for leaf in jax.tree.leaves(made)]


def compare_gradients():
    for double, tolerance in ((False, 1e-6), (True, 1e-14)):
        one = gradient(1, double)
        size = max(np.abs(leaf).max() for leaf in one[1:])
        assert size > 1e-3 and one[0].dtype == (np.float64 if double else np.float32)
        for count in (2, 8):
            for a, b in zip(one, gradient(count, double), strict=True):
                np.testing.assert_allclose(b, a, rtol=0, atol=10 * tolerance * size)


def train_in(folder: str, validated: str = ""):
    """Trains in a folder with all devices, and prints hashes of the state that it starts from and of the weights."""
    began = "nothing"
    if (pathlib.Path(folder) / CHECKPOINTS).exists():
        with Checkpoints(pathlib.Path(folder) / CHECKPOINTS) as checkpoints:
            began = fingerprint(checkpoints.restore(_like()))
    result = train(SHARED, DATA, pathlib.Path(folder), validation=DATA if validated else None, progress=False)
    assert result.completed and all(len(leaf.devices()) == 1 for leaf in jax.tree.leaves(result.weights))
    np.save(f"{folder}.npy", np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(result.weights)]))
    print(jax.local_device_count(), began, fingerprint(result.weights))


def _like() -> TrainState:
    weights = network(SMALL)[1]
    return TrainState(weights, weights, SHARED.optimiser().init(weights), jnp.zeros((), jnp.int32))


def on_devices(count: int, call: str) -> list[str]:
    """What a call of this file's functions prints in a process that has `count` devices."""
    code = f"import sys; sys.path.insert(0, {os.fspath(pathlib.Path(__file__).parent)!r})\n"
    done = run_on_devices(count, [sys.executable, "-c", f"{code}from test_dynamics_parallel import *\n{call}"])
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1].split()


def run_on_devices(count: int, command: list[str]) -> subprocess.CompletedProcess:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={count}"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)


def test_two_and_eight_devices_have_the_gradient_of_one():
    assert on_devices(8, "compare_gradients(); print(jax.device_count())") == ["8"]


def test_a_training_goes_on_with_another_number_of_devices(tmp_path):
    whole = tmp_path / "two"
    count, began, trained = on_devices(2, f"train_in({os.fspath(whole)!r}, 'validated')")
    assert (count, began) == ("2", "nothing")
    steps = sorted(int(path.name) for path in (whole / CHECKPOINTS).glob("[0-9]*"))
    assert steps == [6, 8]
    shutil.rmtree(whole / CHECKPOINTS / "8")
    ended, starts = {}, set()
    for devices in (1, 2, 8):
        folder = tmp_path / f"on {devices}"
        shutil.copytree(whole, folder)
        count, began, ended[devices] = on_devices(devices, f"train_in({os.fspath(folder)!r})")
        assert count == str(devices) and began != "nothing"
        starts.add(began)
    assert len(starts) == 1, "all go on from the same bits"
    assert ended[2] == trained, "the same number of devices ends in the same bits"
    expected = np.load(f"{whole}.npy")
    for devices in (1, 8):
        np.testing.assert_allclose(np.load(tmp_path / f"on {devices}.npy"), expected, rtol=0, atol=1e-6)


def test_a_batch_that_devices_cannot_share_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"Phase 1 .* batches of 16 windows, which 3 devices cannot share .*--batch"):
        train(SHARED, DATA, tmp_path / "run", devices=3 * jax.devices()[:1], progress=False)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_the_command_says_so_before_it_reads(tmp_path):
    command = [sys.executable, "-m", "cablejax"]
    data = [*command, "simulate", "--trajectories", "4", "--steps", "24", "--links", "5", "--process-count", "4"]
    assert run_on_devices(1, [*data, "--process-index", "0", "--out", str(tmp_path / "data")]).returncode == 0
    begun = [*command, "train", "--preset", "smoke", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run")]
    assert "which 3 devices cannot share equally" in run_on_devices(3, begun).stderr
    assert "holds" in run_on_devices(1, begun).stderr, "the data are not complete, which reading them finds"
    assert not (tmp_path / "run").exists()
