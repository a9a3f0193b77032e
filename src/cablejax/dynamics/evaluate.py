"""Open-loop accuracy of a one-step model: roll it out under known commands and compare with what happened."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from cablejax.arrays import rms_length
from cablejax.dataset.windows import Window, window_at
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.graph import prior_of
from cablejax.dynamics.model import OneStepModel, bind
from cablejax.dynamics.normalisation import check_trajectories
from cablejax.simulate.motions import MotionConfig, twist_size
from cablejax.types import History, Trajectory, advance

HORIZONS = (1, 5, 10, 20)
"""Steps after which errors are reported unless asked otherwise."""

SNAP_FACTOR = 2.5
"""A keypoint that moves more than so many times the sum of what both grippers move was not led by them."""

SNAP_MARGIN = 0.01
"""And at least so much further [lengths of the cable]."""


@dataclasses.dataclass(frozen=True)
class OpenLoopError:
    """Errors of one model over many start points; the error of a shape is the root mean square keypoint distance.

    Attributes:
        horizons: steps k after the start.
        starts: number of start points that count, per horizon. Where there is none, the rest is NaN.
        rmse_cm: root of the mean over start points of the squared error, per horizon.
        mean_cm: mean over start points.
        median_cm: median over start points.
        p90_cm: 90th percentile over start points.
        p95_cm: 95th percentile.
        p99_cm: 99th percentile.
        moved_cm: root mean square distance that the keypoints really moved over k steps.
    """

    horizons: tuple[int, ...]
    starts: tuple[int, ...]
    rmse_cm: tuple[float, ...]
    mean_cm: tuple[float, ...]
    median_cm: tuple[float, ...]
    p90_cm: tuple[float, ...]
    p95_cm: tuple[float, ...]
    p99_cm: tuple[float, ...]
    moved_cm: tuple[float, ...]

    @property
    def relative(self) -> tuple[float, ...]:
        """Root mean square error as a fraction of the movement, per horizon; NaN where nothing moved."""
        return tuple(e / m if m else math.nan for e, m in zip(self.rmse_cm, self.moved_cm, strict=True))


def predict(
    dynamics: OneStepModel, history: History, twist: Float[Array, "K Q 3"], interval: float = 1.0
) -> Float[Array, "K N 2"]:
    """Keypoints [m] after each of K commands, by rolling out the model. Differentiable wherever the model is."""

    def step(history, twist):
        history = advance(history, dynamics(history, twist), twist, interval)
        return history, history.keypoints[-1]

    return jax.lax.scan(step, history, twist)[1]


def no_motion(history: History, twist: Float[Array, "2 3"]) -> Float[Array, "N 2"]:
    """The baseline that predicts no motion."""
    return jnp.zeros_like(history.keypoints[-1])


def prior_motion(config: ModelConfig, prior: Literal["static", "rigid", "none"]) -> OneStepModel:
    """The baseline of a model's prior without learning."""
    config = dataclasses.replace(config, prior=prior)
    return lambda history, twist: prior_of(history, twist, config).displacement


def evaluation_windows(data: Trajectory, config: ModelConfig, *, steps: int, stride: int) -> Window:
    """Windows of `steps` steps starting at every `stride`-th sample of every trajectory [M, T, ...]."""
    check_trajectories(data, config, steps=steps, what="evaluation data")
    m, t = data.gripper_twist.shape[:2]
    starts = jnp.arange(0, t - steps + 1, stride)
    cut = jax.vmap(lambda one, start: window_at(one, start, history=config.history, steps=steps), (None, 0))
    windows = jax.vmap(cut, (0, None))(jax.tree.map(jnp.asarray, data), starts)
    return jax.tree.map(lambda x: x.reshape(m * starts.size, *x.shape[2:]), windows)


def make_errors(rollout: Callable[..., OneStepModel], interval: float) -> Callable[..., Array]:
    """Compiled `(model arguments, windows) -> error [m] of every window after every step`, shape [W, K]."""

    @jax.jit
    def errors(arguments, windows: Window):
        dynamics = rollout(*arguments)

        def one(window):
            shape = predict(dynamics, window.history, window.twist, interval)
            return rms_length(shape - window.future)

        return jax.vmap(one)(windows)

    return errors


def window_errors(
    model: OneStepModel | tuple[nnx.GraphDef, nnx.State], windows: Window, config: ModelConfig, *, batch: int = 64
) -> Float[np.ndarray, "W K"]:
    """Error [m] of every window after every step.

    Args:
        model: one-step model, or a network as `(graphdef, weights)`.
        windows: see `evaluation_windows`.
        config: of the graph: history, keypoints, interval.
        batch: windows that are rolled out at once.
    """
    if isinstance(model, tuple):
        graphdef, weights = model
        errors, arguments = make_errors(lambda w: bind(graphdef, w), config.interval), (weights,)
    else:
        errors, arguments = make_errors(lambda: model, config.interval), ()
    parts = [
        np.asarray(errors(arguments, jax.tree.map(lambda x, i=i: x[i : i + batch], windows)), np.float64)
        for i in range(0, windows.twist.shape[0], batch)
    ]
    return np.concatenate(parts)


def summarise(
    error: Float[np.ndarray, "W K"],
    windows: Window,
    *,
    horizons: Sequence[int],
    count: Bool[np.ndarray, "W K"] | None = None,
) -> OpenLoopError:
    """Statistics of errors [m] over windows, those that `count` marks as true or all."""
    truth = np.asarray(windows.future, np.float64) - np.asarray(windows.history.keypoints[:, -1:], np.float64)
    moved = rms_length(truth)
    count = np.ones(error.shape, bool) if count is None else count

    def column(h: int) -> tuple[float, ...]:
        mine = count[:, h - 1]
        if not mine.any():
            return (0, *[np.nan] * 7)
        e, m = 100 * error[mine, h - 1], 100 * moved[mine, h - 1]
        quantiles = np.percentile(e, [50, 90, 95, 99])
        return (mine.sum(), np.sqrt(np.mean(e**2)), float(np.mean(e)), *quantiles, np.sqrt(np.mean(m**2)))

    starts, *rest = zip(*(column(h) for h in horizons), strict=True)
    return OpenLoopError(
        tuple(horizons), tuple(int(n) for n in starts), *(tuple(float(v) for v in row) for row in rest)
    )


def snapping(
    data: Trajectory, *, steps: int, stride: int, interval: float = 1.0, length: float = 1.0
) -> Bool[np.ndarray, "W K"]:
    """Whether the true cable snaps through within the first k steps of a window or in the two steps before it.

    It does in a step in which some keypoint moves further than `SNAP_FACTOR` times the sum of what both grippers move,
    plus `SNAP_MARGIN`. Windows are those of `evaluation_windows`, `length` is the cable's [m].
    """
    moved = np.linalg.norm(np.diff(np.asarray(data.keypoints, np.float64), axis=1), axis=-1).max(axis=-1)
    weight = MotionConfig.for_length(length).rotation_weight
    reach = interval * twist_size(np.asarray(data.gripper_twist, np.float64), weight).sum(-1)
    snaps = moved > SNAP_FACTOR * reach + SNAP_MARGIN * length
    m, t = snaps.shape
    padded = np.concatenate([np.zeros((m, 2), bool), snaps], axis=1)
    starts = np.arange(0, t - steps + 1, stride)
    within = padded[:, starts[:, None] + np.arange(steps + 2)]
    return np.logical_or.accumulate(within, axis=-1)[..., 2:].reshape(m * starts.size, steps)
