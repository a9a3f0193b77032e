"""Training: repeatable, resumable to the bit after a kill, and honest about data it cannot use."""

import csv
import dataclasses
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.dataset.opening import open_or_create
from cablejax.dataset.schema import Block, DatasetConfig
from cablejax.dataset.split import read_split
from cablejax.dataset.store import Store
from cablejax.dataset.streaming import StreamedData
from cablejax.dataset.windows import draw_windows
from cablejax.dynamics.checkpoint import Checkpoints
from cablejax.dynamics.loss import random_walk_noise, rollout_loss
from cablejax.dynamics.metrics import MetricsLog
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.normalisation import fit_normalisation
from cablejax.dynamics.run_folder import claim_folder
from cablejax.dynamics.train import DivergedError, noisy_windows, train
from cablejax.dynamics.train_config import PRESETS, Phase, TrainConfig
from cablejax.dynamics.weights import fingerprint
from dynamics_cases import SMALL, TINY_TRAINING, network, resized, trajectories
from open_loop import open_loop_error

DATA = trajectories()
LONG = dataclasses.replace(TINY_TRAINING, phases=(Phase(steps=60, batch=4), Phase(steps=4, batch=2, rollout=2)))

CHILD = """
import sys
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/../experiments"]
from test_dynamics_train import DATA, LONG
from cablejax.dynamics.train import train
train(LONG, DATA, sys.argv[2], progress=False)
"""


def run(config, folder, **options):
    return train(config, DATA, folder, progress=False, **options)


def same(a, b) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.slow
def test_killed_and_resumed_ends_in_the_same_bits(tmp_path):
    folder = tmp_path / "killed"
    here = pathlib.Path(__file__).parent
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(here), str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"NPROC": "4"},
    )
    try:
        deadline = time.monotonic() + 400
        while not any(p.name.isdigit() for p in (folder / "checkpoints").glob("*")) and time.monotonic() < deadline:
            assert child.poll() is None, child.communicate()[0]
            time.sleep(0.01)
    finally:
        child.send_signal(signal.SIGKILL)
        child.communicate()
    with Checkpoints(folder / "checkpoints") as checkpoints:
        reached = checkpoints.latest()
    assert reached is not None and 0 < reached < LONG.total_steps
    resumed = run(LONG, folder)
    whole = run(LONG, tmp_path / "whole")
    assert resumed.completed and resumed.steps == whole.steps == LONG.total_steps
    same(resumed.weights, whole.weights)
    with (folder / "metrics.csv").open() as first, (tmp_path / "whole" / "metrics.csv").open() as second:
        rows = [[row | {"seconds": "", "waited": ""} for row in csv.DictReader(file)] for file in (first, second)]
    assert rows[0] == rows[1]


def test_a_complete_training_is_not_repeated_and_learns(tmp_path):
    config = dataclasses.replace(
        TINY_TRAINING, phases=(Phase(steps=160, batch=16, noise=0.0, lr_start=1e-2),), chunk=40
    )
    result = run(config, tmp_path / "run", validation=DATA)
    untrained = open_loop_error(network(result.model, last=0.0), DATA, result.model, horizons=(1,), stride=2)
    learned = open_loop_error((result.graphdef, result.weights), DATA, result.model, horizons=(1,), stride=2)
    assert learned.rmse_cm[0] < 0.9 * untrained.rmse_cm[0]
    before = (tmp_path / "run" / "metrics.csv").read_text()
    again = run(config, tmp_path / "run", validation=DATA)
    assert again.completed and (tmp_path / "run" / "metrics.csv").read_text() == before
    same(again.weights, result.weights)


def stored(folder: pathlib.Path) -> Store:
    """Twelve trajectories in shards of two."""
    cable = Discretisation(Cable(n_keypoints=5), n_links=5)
    store = open_or_create(folder, DatasetConfig(n_trajectories=12, n_steps=8, shard_size=2, discretisation=cable))
    for shard in range(6):
        one = trajectories(m=2, seed=shard)
        arrays = [np.asarray(a) for a in (one.keypoints, one.gripper_pose, one.gripper_twist)]
        store.write_shard(shard, Block(*arrays, parameters=np.ones((2, 3)), attempts=np.zeros(2, np.int32)))
    return store


@pytest.mark.slow
def test_a_streamed_training_goes_on_where_it_was_and_another_buffer_is_another_training(tmp_path):
    store = stored(tmp_path / "data.zarr")
    streamed, _ = read_split([store], 0.2, buffer=4)
    assert isinstance(streamed, StreamedData)
    whole = train(TINY_TRAINING, streamed, tmp_path / "whole", progress=False)
    with (tmp_path / "whole" / "metrics.csv").open() as file:
        rows = [*csv.DictReader(file)]
    assert [int(row["step"]) for row in rows] == [2, 4, 6, 7]
    assert [TINY_TRAINING.calls_before(step) for step in (0, 2, 4, 6, 7)] == [0, 1, 2, 3, 4]
    shutil.copytree(tmp_path / "whole", tmp_path / "again")
    shutil.rmtree(tmp_path / "again" / "checkpoints" / "7")
    with pytest.raises(ValueError, match=r"differs in .*data"):
        train(TINY_TRAINING, dataclasses.replace(streamed, buffer=3), tmp_path / "again", progress=False)
    resumed = train(TINY_TRAINING, streamed, tmp_path / "again", progress=False)
    same(resumed.weights, whole.weights)
    first = train(TINY_TRAINING, streamed.at(0), tmp_path / "first", progress=False)
    assert first.model == whole.model, "scales are those of the first buffer"
    assert fingerprint(first.weights) != fingerprint(whole.weights)


@pytest.mark.slow
def test_a_folder_with_another_training_is_left_alone(tmp_path):
    run(TINY_TRAINING, tmp_path)
    with pytest.raises(ValueError, match=r"differs in config.seed \(0, now 1\)"):
        run(dataclasses.replace(TINY_TRAINING, seed=1), tmp_path)
    with pytest.raises(ValueError, match=r"differs in .*data"):
        train(TINY_TRAINING, trajectories(seed=3), tmp_path, progress=False)


def test_a_training_is_overwritten_on_request_and_nothing_else(tmp_path):
    first = {"config": {"seed": 0}, "data": "a"}
    claim_folder(tmp_path, first, overwrite=False)
    kept = [tmp_path / "checkpoints" / "20" / "a", tmp_path / "weights.safetensors", tmp_path / "metrics.csv"]
    mine = [tmp_path / "notes.txt", tmp_path / "checkpoints" / "mine.txt"]
    for file in (*kept, *mine):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("")
    claim_folder(tmp_path, first, overwrite=True)
    assert all(file.exists() for file in kept), "the same training is resumed"
    second = {"config": {"seed": 1}, "data": "a"}
    with pytest.raises(ValueError, match=r"differs in config.seed \(0, now 1\)"):
        claim_folder(tmp_path, second, overwrite=False)
    claim_folder(tmp_path, second, overwrite=True)
    assert not any(file.exists() for file in kept) and all(file.exists() for file in mine)
    stored = json.loads((tmp_path / "run.json").read_text())
    assert {name: stored[name] for name in second} == second


def test_a_folder_in_which_checkpoints_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"caf.* is no UTF-8.*Name another folder"):
        claim_folder(tmp_path / "caf\udce9" / "run", {"config": {}, "data": "a"}, overwrite=False)
    assert not any(tmp_path.iterdir())


def test_a_training_that_goes_on_with_other_packages_says_so(tmp_path):
    run, lines = {"config": {"seed": 0}, "data": "a"}, []

    def claim():
        claim_folder(tmp_path, run, overwrite=False, report=lines.append)

    claim(), claim()
    stored = json.loads((tmp_path / "run.json").read_text())
    assert not lines and stored["versions"]["jax"] == jax.__version__ and "optax" in stored["versions"]
    stored["versions"]["jax"] = "0.1.0"
    (tmp_path / "run.json").write_text(json.dumps(stored))
    claim()
    (line,) = lines
    assert f"begun with other packages: jax (0.1.0, now {jax.__version__}). The training continues" in line
    del stored["versions"]  # as trainings were before they recorded them
    (tmp_path / "run.json").write_text(json.dumps(stored))
    claim()
    assert lines == [line]


@pytest.mark.parametrize(
    ("file", "text", "overwrite", "message"),
    [
        ("notes.txt", "", False, "is not empty, and holds no training"),
        ("checkpoints/7", "", True, "checkpoints was not made by a training"),
        ("tensorboard/7", "", True, "tensorboard was not made by a training"),
        ("run.json", "", True, "run.json is no JSON.*delete this one"),
        ("run.json", "[" * 100_000, False, "nested too deep"),
        ("run.json", '{"distance_km": 7}', True, "was not made by a training"),
    ],
)
def test_a_folder_that_is_a_users_own_is_left_alone(file, text, overwrite, message, tmp_path):
    mine = tmp_path / file
    mine.parent.mkdir(exist_ok=True)
    mine.write_text(text)
    with pytest.raises(ValueError, match=message):
        run(TINY_TRAINING, tmp_path, overwrite=overwrite)
    assert mine.read_text() == text and len(list(tmp_path.rglob("*"))) <= 2


def test_a_damaged_checkpoint_is_reported_and_the_one_before_it_used(tmp_path):
    state, lines = {"a": jnp.arange(3000.0)}, []

    def damage(step):
        for file in (tmp_path / str(step)).rglob("*"):
            if file.is_file():
                file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(10, state)
        checkpoints.save(20, {"a": jnp.zeros(3000)})
    damage(20)
    with Checkpoints(tmp_path) as checkpoints:
        same(checkpoints.restore(state, report=lines.append), state)
        assert lines == ["The checkpoint of step 20 is damaged; resuming from the one of step 10."]
        checkpoints.save(20, state)
    damage(10), damage(20)
    with Checkpoints(tmp_path) as checkpoints, pytest.raises(ValueError, match=r"No checkpoint .* Delete this folder"):
        checkpoints.restore(state)


def test_a_training_that_diverges_says_what_to_change(tmp_path, monkeypatch):
    def diverging(config, phase, graphdef, steps, mesh):
        lost = {"loss": np.full(steps, np.nan), "gradient_norm": np.full(steps, np.nan)}
        return lambda state, data: (dataclasses.replace(state, step=state.step + steps), lost)

    monkeypatch.setattr("cablejax.dynamics.train.chunk_update", diverging)
    with pytest.raises(DivergedError, match=r"its loss is nan after step 2, .* \(--lr, now 0.001\) .*--overwrite"):
        run(TINY_TRAINING, tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"keypoints": np.full_like(DATA.keypoints, np.inf)}, "keypoints holds NaN or infinity in 4 of 4"),
        ({"gripper_twist": DATA.gripper_twist[:, :1]}, "Is the data of another cable"),
        ({"keypoints": DATA.keypoints[:, :, ::-1]}, "Keypoint 0 belongs to gripper 0"),
    ],
    ids=["not finite", "too few commands", "reversed"],
)
def test_bad_data_is_refused_before_anything_is_written(change, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        train(TINY_TRAINING, dataclasses.replace(DATA, **change), tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


def test_a_rollout_longer_than_the_data_is_refused(tmp_path):
    config = dataclasses.replace(TINY_TRAINING, phases=(Phase(steps=1, rollout=9),))
    with pytest.raises(ValueError, match="8 commands per trajectory, but 9 are rolled out"):
        run(config, tmp_path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Phase(steps=0), "Phase.steps is 0"),
        (lambda: Phase(steps=1, noise=-1.0), "Phase.noise is -1.0"),
        (lambda: Phase(steps=1, lr_end=0.0), "Phase.lr_end is 0.0"),
        (lambda: TrainConfig(phases=()), "phases is empty"),
        (lambda: TrainConfig(ema=1.0), "ema is 1.0"),
        (lambda: TrainConfig(chunk=0), "chunk is 0"),
    ],
)
def test_impossible_trainings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_phases_follow_each_other():
    config = TINY_TRAINING
    assert [config.phase_at(step) for step in (0, 3, 4, 6, 99)] == [(0, 4), (0, 4), (1, 7), (1, 7), (1, 7)]
    assert config.total_steps == 7 and config.longest_rollout == 2
    rate = PRESETS["released"].learning_rate()
    assert rate(0) == pytest.approx(2e-6, rel=1e-3) and rate(499) == pytest.approx(1e-3, rel=1e-2)
    assert rate(30_000) == pytest.approx(2e-4, rel=1e-4) and rate(41_999) == pytest.approx(1e-6, rel=1e-2)


def test_the_released_training_is_the_default():
    assert PRESETS["released"] == TrainConfig() and TrainConfig().total_steps == 42_000
    assert [phase.rollout for phase in TrainConfig().phases] == [1, 4]


def test_loss_is_quadratic_near_zero_and_linear_far_away():
    window = jax.tree.map(lambda x: x[0], draw_windows(jax.random.key(0), DATA, batch=1, history=3, steps=2))

    def loss(error):
        def dynamics(history, twist):
            """Exact on the first step, off by `error` in every coordinate from then on."""
            step = jnp.argmin(jnp.abs(window.future - history.keypoints[-1]).sum((1, 2)))
            known = jnp.abs(window.history.keypoints[-1] - history.keypoints[-1]).sum() == 0
            truth = jnp.where(known, window.future[0], window.future[jnp.minimum(step + 1, 1)])
            return truth + jnp.where(known, 0.0, error) - history.keypoints[-1]

        return float(rollout_loss(dynamics, window, scale=1e-2, interval=1.0))

    assert loss(0.0) == pytest.approx(0.0, abs=1e-6)
    assert loss(1e-3) == pytest.approx(0.5 * 0.01, rel=1e-2)
    assert loss(1.0) == pytest.approx(0.5 * 2 * (np.sqrt(1 + 100**2) - 1), rel=1e-4)


def test_noise_walks_to_its_size_and_spares_the_held_ends():
    history = jax.tree.map(lambda x: x[0], draw_windows(jax.random.key(2), DATA, batch=1, history=3, steps=1)).history
    keys = jax.random.split(jax.random.key(3), 4000)
    noise = jax.vmap(lambda key: random_walk_noise(key, history, 2e-3).keypoints)(keys) - history.keypoints
    np.testing.assert_allclose(noise[:, -1, 1:-1].std(axis=0), 2e-3, rtol=0.1)
    np.testing.assert_allclose(noise[:, 0, 1:-1].std(axis=0), 2e-3 / 3**0.5, rtol=0.1)
    assert not noise[:, :, [0, -1]].any()


def test_the_noise_of_a_phase_is_in_proportion_to_the_cable():
    """A cable three times as small is learned with noise three times as small."""
    phase, key = Phase(steps=1, batch=64, noise=2e-3), jax.random.key(4)
    clean = noisy_windows(key, DATA, dataclasses.replace(phase, noise=0.0), SMALL, flips=False)

    def added(length: float):
        noisy = noisy_windows(key, DATA, phase, dataclasses.replace(SMALL, length=length), flips=False)
        return np.asarray(noisy.history.keypoints - clean.history.keypoints)

    np.testing.assert_allclose(added(0.3), 0.3 * added(1.0), atol=1e-6)
    assert added(1.0).std() > 5e-4


def test_normalisation_is_measured_and_leaves_out_the_wildest_steps():
    scales = fit_normalisation(DATA, SMALL)
    moved = np.diff(DATA.keypoints, axis=1)
    assert scales.displacement == pytest.approx(np.sqrt(np.mean(moved**2)), rel=1e-3)
    assert scales.linear_speed == pytest.approx(np.sqrt(np.mean(DATA.gripper_twist[..., :2] ** 2)), rel=1e-3)
    assert scales.angular_speed == pytest.approx(np.sqrt(np.mean(DATA.gripper_twist[..., 2] ** 2)), rel=1e-3)
    jump = jax.tree.map(np.copy, DATA)
    jump.keypoints[0, -1:, 2] += 0.5
    assert fit_normalisation(jump, SMALL).residual == pytest.approx(scales.residual, rel=0.2)
    still = jax.tree.map(lambda x: np.zeros_like(x) + x[:, :1], DATA)
    still = dataclasses.replace(still, gripper_twist=np.zeros_like(DATA.gripper_twist))
    assert fit_normalisation(still, SMALL).displacement == 1e-5


def test_metrics_forget_what_was_lost_with_the_process(tmp_path):
    with MetricsLog(tmp_path, ("loss",), 0) as log:
        for step in (10, 20, 30):
            log.write(step, {"loss": step / 100})
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("4")  # killed while writing
    with MetricsLog(tmp_path, ("loss",), 20) as log:
        log.write(30, {})
    assert (tmp_path / "metrics.csv").read_text().split() == ["step,loss", "10,0.1", "20,0.2", "30,"]
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("\0\0\0,0.4\n")
    MetricsLog(tmp_path, ("loss",), 20).__exit__()
    assert (tmp_path / "metrics.csv").read_text().split() == ["step,loss", "10,0.1", "20,0.2"]


def test_sizes_of_the_network_follow_the_configuration():
    from flax import nnx

    config = resized(TINY_TRAINING, latent=6, message_passing=1).model
    model = GNS(config, nnx.Rngs(0))
    assert len(model.processor) == 1
    assert model.node_encoder.first[0].kernel.shape == (config.node_features, config.hidden)
    assert model.decoder.rest[-1].kernel.shape == (config.hidden, 2)
