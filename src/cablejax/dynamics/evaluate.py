"""Open-loop accuracy of a one-step model: roll it out under known commands and compare with what happened."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from cablejax.dynamics.config import GNSConfig
from cablejax.dynamics.gns import Dynamics, bind
from cablejax.dynamics.graph import prior_of
from cablejax.dynamics.windows import Window, check_trajectories, window_at
from cablejax.types import History, Trajectory, advance

HORIZONS = (1, 5, 10, 20)
"""Steps after which errors are reported unless asked otherwise."""


@dataclasses.dataclass(frozen=True)
class OpenLoopError:
    """Errors of one model over many start points; the error of a shape is the root mean square keypoint distance.

    Attributes:
        horizons: steps k after the start.
        rmse_cm: root of the mean over start points of the squared error, per horizon.
        median_cm: median over start points.
        p95_cm: 95th percentile over start points.
        worst_cm: maximum over start points.
        moved_cm: root mean square distance that the keypoints really moved over k steps.
        starts: number of start points.
    """

    horizons: tuple[int, ...]
    rmse_cm: tuple[float, ...]
    median_cm: tuple[float, ...]
    p95_cm: tuple[float, ...]
    worst_cm: tuple[float, ...]
    moved_cm: tuple[float, ...]
    starts: int

    @property
    def relative(self) -> tuple[float, ...]:
        """Error as a fraction of the movement, per horizon."""
        return tuple(e / m for e, m in zip(self.rmse_cm, self.moved_cm, strict=True))


def predict(
    dynamics: Dynamics, history: History, twist: Float[Array, "K Q 3"], interval: float = 1.0
) -> Float[Array, "K N 2"]:
    """Keypoints [m] after each of K commands, by rolling out the model. Differentiable wherever the model is."""

    def step(history, twist):
        history = advance(history, dynamics(history, twist), twist, interval)
        return history, history.keypoints[-1]

    return jax.lax.scan(step, history, twist)[1]


def no_motion(history: History, twist: Float[Array, "2 3"]) -> Float[Array, "N 2"]:
    """The floor that expects nothing to move."""
    return jnp.zeros_like(history.keypoints[-1])


def prior_motion(config: GNSConfig, prior: Literal["rigid", "static"]) -> Dynamics:
    """The floor that a model's prior is without learning."""
    config = dataclasses.replace(config, prior=prior)
    return lambda history, twist: prior_of(history, twist, config).displacement


def evaluation_windows(data: Trajectory, config: GNSConfig, *, steps: int, stride: int) -> Window:
    """Windows of `steps` steps starting at every `stride`-th sample of every trajectory [M, T, ...]."""
    check_trajectories(data, config, steps=steps, what="evaluation data")
    m, t = data.gripper_twist.shape[:2]
    starts = jnp.arange(0, t - steps + 1, stride)
    cut = jax.vmap(lambda one, start: window_at(one, start, history=config.history, steps=steps), (None, 0))
    windows = jax.vmap(cut, (0, None))(jax.tree.map(jnp.asarray, data), starts)
    return jax.tree.map(lambda x: x.reshape(m * starts.size, *x.shape[2:]), windows)


def make_errors(rollout: Callable[..., Dynamics], interval: float) -> Callable[..., Array]:
    """Compiled `(model arguments, windows) -> error [m] of every window after every step`, shape [W, K]."""

    @jax.jit
    def errors(arguments, windows: Window):
        dynamics = rollout(*arguments)

        def one(window):
            shape = predict(dynamics, window.history, window.twist, interval)
            return jnp.sqrt(jnp.mean(jnp.sum((shape - window.future) ** 2, axis=-1), axis=-1))

        return jax.vmap(one)(windows)

    return errors


def open_loop_error(
    model: Dynamics | tuple[nnx.GraphDef, nnx.State],
    data: Trajectory,
    config: GNSConfig,
    *,
    horizons: Sequence[int] = HORIZONS,
    stride: int = 10,
    batch: int = 64,
) -> OpenLoopError:
    """Rolls `model` from every `stride`-th sample of every trajectory and summarises the errors.

    Args:
        model: one-step model, or a network as `(graphdef, weights)`.
        data: held-out trajectories, arrays [M, T + 1, N, 2], [M, T + 1, 2, 3], [M, T, 2, 3].
        config: of the graph: history, keypoints, interval.
        horizons: steps after which errors are reported.
        stride: samples between start points.
        batch: windows rolled out at once.
    """
    horizons = tuple(horizons)
    steps = max(horizons)
    windows = evaluation_windows(data, config, steps=steps, stride=stride)
    if isinstance(model, tuple):
        graphdef, weights = model
        errors, arguments = make_errors(lambda w: bind(graphdef, w), config.interval), (weights,)
    else:
        errors, arguments = make_errors(lambda: model, config.interval), ()
    n = windows.twist.shape[0]
    parts = [
        np.asarray(errors(arguments, jax.tree.map(lambda x, i=i: x[i : i + batch], windows)), np.float64)
        for i in range(0, n, batch)
    ]
    error = np.concatenate(parts)
    still = windows.future - windows.history.keypoints[:, -1:]
    moved = np.sqrt(np.mean(np.sum(np.asarray(still, np.float64) ** 2, axis=-1), axis=-1))
    pick = [h - 1 for h in horizons]
    error, moved = 100 * error[:, pick], 100 * moved[:, pick]

    def row(values: np.ndarray) -> tuple[float, ...]:
        return tuple(float(v) for v in values)

    return OpenLoopError(
        horizons=horizons,
        rmse_cm=row(np.sqrt(np.mean(error**2, axis=0))),
        median_cm=row(np.median(error, axis=0)),
        p95_cm=row(np.percentile(error, 95, axis=0)),
        worst_cm=row(error.max(axis=0)),
        moved_cm=row(np.sqrt(np.mean(moved**2, axis=0))),
        starts=n,
    )
