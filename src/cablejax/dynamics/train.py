"""Training a graph network simulator on trajectories, resumable to the bit.

Many optimiser steps run in one compiled call. What a step sees depends on `(seed, step)` alone, a checkpoint holds the
whole state, so a training that was killed and resumed ends in the same weights as one that ran through. All devices of
the process share each batch (`dynamics.parallel`); checkpoints do not depend on their number.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array
from tqdm import tqdm

from cablejax.dataset.streaming import StreamedData
from cablejax.dataset.windows import Window, draw_windows
from cablejax.dynamics.checkpoint import Checkpoints
from cablejax.dynamics.config import RECORDED, ModelConfig
from cablejax.dynamics.evaluate import HORIZONS, evaluation_windows, make_errors
from cablejax.dynamics.graph import frame_of
from cablejax.dynamics.loss import random_walk_noise, rollout_loss
from cablejax.dynamics.metrics import MetricsLog
from cablejax.dynamics.model import bind
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.normalisation import check_trajectories, fit_normalisation
from cablejax.dynamics.parallel import loss_and_gradient, on_all_devices, on_one_device, training_mesh
from cablejax.dynamics.run_folder import CHECKPOINTS, claim_folder
from cablejax.dynamics.symmetry import initially_symmetric, symmetrised
from cablejax.dynamics.train_config import Phase, TrainConfig
from cablejax.dynamics.weights import fingerprint
from cablejax.interrupts import interrupt_flag, saving, unless
from cablejax.types import Trajectory
from cablejax.whole_file import sole_writer

_COLUMNS = (
    "phase",
    "learning_rate",
    "loss",
    "gradient_norm",
    *(f"open_loop_{h}_cm" for h in HORIZONS),
    "seconds",
    "waited",
)


class DivergedError(ValueError):
    """A training whose loss is no longer finite: says what to change."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """All that changes while training.

    Attributes:
        weights: of the network.
        average: exponential moving average of the weights.
        optimiser: state of the optimiser.
        step: optimiser steps done, int32, shape [].
    """

    weights: nnx.State
    average: nnx.State
    optimiser: Any
    step: Array


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """Result of `train`.

    Attributes:
        model: configuration of the network, with the normalisation measured on the data.
        graphdef: structure of the network.
        weights: averaged weights.
        steps: optimiser steps done.
        completed: false if Ctrl-C ended it early; calling `train` again goes on from there.
    """

    model: ModelConfig
    graphdef: nnx.GraphDef
    weights: nnx.State
    steps: int
    completed: bool


def train(
    config: TrainConfig,
    data: Trajectory | StreamedData,
    out_dir: Path,
    *,
    validation: Trajectory | None = None,
    initial: tuple[ModelConfig, nnx.State] | None = None,
    network: type = GNS,
    overwrite: bool = False,
    progress: bool = True,
    devices: Sequence[jax.Device] | None = None,  # pyright: ignore[reportInvalidTypeForm]
) -> TrainResult:
    """Trains from scratch, or goes on from the last checkpoint in `out_dir`.

    Args:
        config: decides the outcome, together with `data` and `initial`.
        data: training trajectories, arrays [M, T + 1, N, 2], [M, T + 1, 2, 3], [M, T, 2, 3]; or a data set that is
            streamed, one turn of its buffer per compiled call. Scales are then measured on its first buffer.
        out_dir: receives `run.json`, `metrics.csv`, `tensorboard/`, `checkpoints/`.
        validation: held-out trajectories, evaluated open loop every `config.evaluate_every` chunks.
        initial: a model to start from instead of random weights; its scales stay, without which they mean nothing.
        network: class of the network, made of a `ModelConfig` and `nnx.Rngs`; see `cablejax.dynamics.model.apply`.
        overwrite: another run in the folder is deleted, and other files there may be replaced.
        progress: show a progress bar with remaining time.
        devices: of this process, which share each batch; all that JAX sees by default.

    Raises:
        ValueError: bad data, a batch that the devices cannot share equally, or `out_dir` holds a run of another
            configuration or data, or something else, or another process trains there.
        DivergedError: the loss is no longer finite.
    """
    mesh = training_mesh(config, devices)
    config = dataclasses.replace(config, model=_with_scales(config, data, initial, network))
    identity, out_dir = data.identity if isinstance(data, StreamedData) else data, Path(out_dir)
    run = {"config": dataclasses.asdict(config), "data": fingerprint((identity, initial and initial[1]))}
    run["config"]["model"] |= RECORDED | {"network": network.__name__.lower()}
    report = functools.partial(tqdm.write, file=sys.stderr)
    claim_folder(out_dir, run, overwrite=overwrite, report=report)

    graphdef, weights = nnx.split(network(config.model, nnx.Rngs(config.seed)))
    weights = initially_symmetric(weights, config.model) if initial is None else initial[1]
    optimiser = config.optimiser()
    state = TrainState(weights, weights, optimiser.init(weights), jnp.zeros((), jnp.int32))
    evaluate = None if validation is None else Validation(validation, graphdef, config)

    scores: dict[int, float] = {}
    with sole_writer(out_dir), Checkpoints(out_dir / CHECKPOINTS) as checkpoints, interrupt_flag() as interrupted:
        if checkpoints.latest() is not None:
            state = checkpoints.restore(state, report=report)
        step, total = int(state.step), config.total_steps
        state = on_all_devices(state, mesh)
        buffers = _buffers(data, config.calls_before(step), mesh)
        bar = tqdm(total=total, initial=step, unit="step", disable=not progress, dynamic_ncols=True)
        with MetricsLog(out_dir, _COLUMNS, step) as log, bar:
            while step < total and not interrupted.is_set():
                index, end = config.phase_at(step)
                update = chunk_update(config, index, graphdef, min(config.chunk, end - step), mesh)
                asked, buffer = time.perf_counter(), jax.block_until_ready(next(buffers))
                began, current = time.perf_counter(), state
                made = unless(interrupted, lambda: jax.block_until_ready(update(current, buffer)))  # noqa: B023
                if made is None:
                    break
                state, losses = made
                seconds, done, step = time.perf_counter() - began, int(state.step) - step, int(state.step)
                row = {"phase": index, "seconds": seconds, "waited": began - asked}
                row |= chunk_metrics(config, step, losses, out_dir)
                chunks = -(-step // config.chunk)
                if evaluate is not None and (chunks % config.evaluate_every == 0 or step == total):
                    scores = evaluate(on_one_device(state.average, mesh))
                    row |= {f"open_loop_{h}_cm": score for h, score in scores.items()}
                log.write(step, row)
                if chunks % config.checkpoint_every == 0 or step == total:
                    checkpoints.save(step, on_one_device(state, mesh))
                bar.update(done)
                bar.set_postfix({"loss": f"{row['loss']:.2e}"} | {f"e{h}_cm": f"{s:.3f}" for h, s in scores.items()})
            if interrupted.is_set() and step:
                with saving():
                    checkpoints.save(step, on_one_device(state, mesh))
    average = symmetrised(on_one_device(state.average, mesh), config.model)
    return TrainResult(config.model, graphdef, average, step, step == total)


def _buffers(data: Trajectory | StreamedData, calls: int, mesh: Mesh | None) -> Iterator[Trajectory]:
    """What each compiled call draws its windows from, after so many calls."""

    def on_devices(part: Trajectory) -> Trajectory:
        return on_all_devices(jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), part), mesh)

    return data.turns(calls, on_devices) if isinstance(data, StreamedData) else itertools.repeat(on_devices(data))


def _with_scales(
    config: TrainConfig, data: Trajectory | StreamedData, initial: tuple[ModelConfig, nnx.State] | None, network: type
) -> ModelConfig:
    """The network's configuration with the scales of the data, which are checked, or of the model to start from."""
    model, first = config.model, data.at(0) if isinstance(data, StreamedData) else data
    check_trajectories(first, model, steps=config.longest_rollout, what="training data")
    scales = (
        fit_normalisation(first, model, getattr(network, "frame", frame_of))
        if initial is None
        else initial[0].normalisation
    )
    model = dataclasses.replace(model, normalisation=scales)
    if initial is not None and initial[0] != model:
        raise ValueError(
            "The model to start from is not the one to be trained: use `cablejax.dynamics.fine_tune.starting_from`."
        )
    return model


@functools.lru_cache(maxsize=8)
def chunk_update(config: TrainConfig, phase_index: int, graphdef: nnx.GraphDef, steps: int, mesh: Mesh | None = None):
    """Compiled `(state, data) -> (state, {"loss", "gradient_norm"} each [steps])` for `steps` optimiser steps.

    With a mesh, from `training_mesh`, its devices share each batch; state and data are whole on all of them.
    """
    phase, model, optimiser = config.phases[phase_index], config.model, config.optimiser()

    def loss_of(weights: nnx.State, windows: Window):
        return batch_loss(weights, graphdef, windows, model)

    def update(state: TrainState, data: Trajectory):
        def one(state: TrainState, _):
            key = jax.random.fold_in(jax.random.key(config.seed), state.step)
            windows = noisy_windows(key, data, phase, model, flips=config.flips)
            loss, gradient = loss_and_gradient(loss_of, state.weights, windows, mesh)
            change, inner = optimiser.update(symmetrised(gradient, model), state.optimiser, state.weights)
            weights = optax.apply_updates(state.weights, change)
            # A short memory at first, so that the average does not remember the random start.
            decay = jnp.minimum(config.ema, (1.0 + state.step) / (10.0 + state.step))
            average = jax.tree.map(lambda a, w: a + (1.0 - decay) * (w - a), state.average, weights)
            metrics = {"loss": loss, "gradient_norm": optax.tree.norm(gradient)}
            return TrainState(weights, average, inner, state.step + 1), metrics  # pyright: ignore[reportArgumentType]

        return jax.lax.scan(one, state, length=steps)

    return jax.jit(update, out_shardings=None if mesh is None else NamedSharding(mesh, PartitionSpec()))


def chunk_metrics(config: TrainConfig, step: int, losses: dict[str, Array], out_dir: Path) -> dict[str, float]:
    """Learning rate and mean metrics of the chunk that ended at `step`.

    Raises:
        DivergedError: the loss is no longer finite.
    """
    rate = float(np.asarray(config.learning_rate()(step - 1)))
    row = {"learning_rate": rate} | {name: float(np.mean(values)) for name, values in losses.items()}
    if not np.isfinite(row["loss"]):
        raise DivergedError(
            f"The training diverged: its loss is {row['loss']} after step {step}, at a learning rate of {rate:.3g}. "
            f"Train with a lower one (--lr, now {config.phases[0].lr_start:g}) or larger batches, in another folder or "
            f"with overwriting (--overwrite); {out_dir} keeps the last good checkpoint."
        )
    return row


def noisy_windows(key: Array, data: Trajectory, phase: Phase, model: ModelConfig, *, flips: bool) -> Window:
    """The windows of one optimiser step, with noise on their histories."""
    key_window, key_noise = jax.random.split(key)
    windows = draw_windows(key_window, data, batch=phase.batch, history=model.history, steps=phase.rollout, flips=flips)
    if phase.noise == 0:
        return windows
    noisy = jax.vmap(lambda k, h: random_walk_noise(k, h, phase.noise * model.length))
    return dataclasses.replace(windows, history=noisy(jax.random.split(key_noise, phase.batch), windows.history))


def batch_loss(weights: nnx.State, graphdef: nnx.GraphDef, windows: Window, model: ModelConfig) -> Array:
    """Mean `rollout_loss` of a batch of windows."""
    dynamics = bind(graphdef, weights)
    loss = functools.partial(rollout_loss, dynamics, scale=model.normalisation.residual, interval=model.interval)
    return jnp.mean(jax.vmap(loss)(windows))


class Validation:
    """Median open-loop error by horizon [cm] at fixed start points, spread over the held-out trajectories.

    The median, since a single snap-through among the start points decides the mean.
    """

    def __init__(self, data: Trajectory, graphdef: nnx.GraphDef, config: TrainConfig):
        commands = data.gripper_twist.shape[1]
        self.horizons = tuple(h for h in HORIZONS if h <= commands)
        windows = evaluation_windows(data, config.model, steps=self.horizons[-1], stride=5)
        n = windows.twist.shape[0]
        pick = np.unique(np.linspace(0, n - 1, min(n, config.evaluate_starts)).astype(int))
        self.windows = jax.tree.map(lambda x: x[pick], windows)
        self.errors = make_errors(lambda weights: bind(graphdef, weights), config.model.interval)

    def __call__(self, weights: nnx.State) -> dict[int, float]:
        """Median error over the validation windows by horizon [cm]."""
        error = np.asarray(self.errors((weights,), self.windows), np.float64)
        return {h: float(100 * np.median(error[:, h - 1])) for h in self.horizons}
