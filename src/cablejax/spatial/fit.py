"""Whole rollouts against recorded windows: predictions, their derivatives, and damped Gauss-Newton.

Distances between simulated and recorded markers count as pseudo-Huber, 2 d^2 (sqrt(1 + (r/d)^2) - 1): a window in which
the cable swings over another way must not decide alone. They stay the same for tenths of a second, so the sum over
samples is divided by the samples of a correlation time before it is held against the prior.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import os
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from cablejax.simulate.compile import compiler_options
from cablejax.spatial.effects import Layout
from cablejax.spatial.rod import Rod
from cablejax.spatial.windows import Windows

_CHUNK = 8
_ROBUST = 0.02  # d [m]
_ERROR = 0.01  # what is left of a good fit [m]: unit of the residuals
_CORRELATION = 0.3  # [s]
_EVERY = 4
_LARGEST_STEP = 1.0
# A marker further off than this is off by this: a simulation that broke down is one bad window, not infinity [m].
_LOST = 1.0


@dataclasses.dataclass(frozen=True)
class Sums:
    """A fit's sums over the residuals of every window, in values rather than prior units.

    Attributes:
        cost: robust cost, shape [W].
        gradient: of the cost, shape [W, P].
        curvature: Gauss-Newton's, shape [W, P, P].
        error: mean absolute error of a coordinate of the free markers [m], shape [W].
    """

    cost: Float[np.ndarray, "W"]
    gradient: Float[np.ndarray, "W P"]
    curvature: Float[np.ndarray, "W P P"]
    error: Float[np.ndarray, "W"]


@dataclasses.dataclass(frozen=True)
class Simulator:
    """The rod of one layout, compiled once for windows of one shape.

    Attributes:
        rod: resolution.
        layout: what its parameters mean.
    """

    rod: Rod
    layout: Layout

    def predict(self, values: Float[np.ndarray, "P"], windows: Windows) -> Float[np.ndarray, "W T F 3"]:
        """Free markers of every window from its first two samples on [m]."""
        run = _compiled(self, windows.interval)[0]
        return np.concatenate(
            _in_parallel(lambda part, count: np.asarray(run(values, *_inputs(part)))[:count], windows)
        )

    def sums(self, values: Float[np.ndarray, "P"], windows: Windows) -> Sums:
        """Costs and derivatives of every window."""
        run = _compiled(self, windows.interval)[1]

        def rows_of(part, count):
            predicted, derivative = (np.asarray(a) for a in run(values, *_inputs(part)))
            # by window, not by parameter: the sums are over all others
            derivative = np.moveaxis(derivative[:, :, 2::_EVERY], 0, -1)
            target = part.keypoints[:, 2::_EVERY]
            seen = np.isfinite(target).all(axis=-1) & part.valid[:, 2::_EVERY, None]
            return [
                _window_sums(predicted[w, 2::_EVERY], derivative[w], target[w], seen[w], part.interval)
                for w in range(count)
            ]

        rows = [row for rows in _in_parallel(rows_of, windows) for row in rows]
        return Sums(*(np.array([row[k] for row in rows]) for k in range(4)))


def errors(predicted: Float[np.ndarray, "W T F 3"], windows: Windows) -> Float[np.ndarray, "W"]:
    """Mean absolute error of a coordinate of the free markers, from the third sample on [m]."""
    off = np.abs(predicted - windows.keypoints)[:, 2:]
    off = np.where(np.isfinite(off), np.minimum(off, _LOST), _LOST)
    seen = np.isfinite(windows.keypoints[:, 2:]) & windows.valid[:, 2:, None, None]
    return (off * seen).sum(axis=(1, 2, 3)) / seen.sum(axis=(1, 2, 3))


def over_all_markers(error: Float[np.ndarray, "W"], windows: Windows) -> Float[np.ndarray, "W"]:
    """The same with the held markers counted as predicted without error, as Chen et al. (2024) count [m]."""
    return error * windows.keypoints.shape[2] / windows.n_keypoints


@dataclasses.dataclass(frozen=True)
class Fit:
    """Fitted values.

    Attributes:
        values: shape [P].
        active: which were fitted, shape [P].
        sums: at the values, over the windows of the fit and whatever else was asked for.
    """

    values: Float[np.ndarray, "P"]
    active: Bool[np.ndarray, "P"]
    sums: Sums


def improve(
    simulator: Simulator,
    values: Float[np.ndarray, "P"],
    effects: Sequence[str],
    windows: Windows,
    *,
    use: Bool[np.ndarray, "W"] | None = None,
    iterations: int = 4,
    sums: Sums | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Fit:
    """Damped Gauss-Newton on some effects' values.

    Args:
        simulator: of the cable.
        values: to start from.
        effects: whose values are free.
        windows: of the recording.
        use: which of them are fitted; the sums are of all. By default all.
        iterations: steps, accepted or not.
        sums: at the start, if known.
        progress: called with a line of text after each step.
    """
    layout = simulator.layout
    active, use = layout.active(effects), np.ones(len(windows), bool) if use is None else use
    sums = simulator.sums(values, windows) if sums is None else sums
    fit, damping = Fit(values, active, sums), 1e-3
    best = _objective(fit, layout, use)
    for iteration in range(iterations):
        step = newton_step(fit, layout, use, damping=damping)
        moved = moved_by(layout, fit.values, active, step)
        trial = Fit(moved, active, simulator.sums(moved, windows))
        cost = _objective(trial, layout, use)
        progress(f"    step {iteration + 1}: {1e3 * trial.sums.error[use].mean():.2f} mm")
        if cost < best:
            done = best - cost < 2e-3 * best
            fit, best, damping = trial, cost, max(damping / 5, 1e-5)
            if done:
                break
        else:
            damping = max(damping * 20, 3e-2)
    return fit


def coordinates(layout: Layout, values: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """Values in prior standard deviations; what is switched off is at 0."""
    starts = layout.starts
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(np.where(values > 0, values, 1.0) / starts)
    return np.where(np.isnan(starts), values, np.where(values > 0, logs, 0.0)) / layout.scales


def slopes(layout: Layout, values: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """Derivative of the values by their coordinates; what is switched off moves by its start."""
    starts = layout.starts
    return layout.scales * np.where(np.isnan(starts), 1.0, np.where(values > 0, values, np.nan_to_num(starts)))


def moved_by(layout: Layout, values, active, step):
    """The values after a step in their coordinates."""
    positive = active & ~np.isnan(layout.starts) & (values > 0)
    moved = values + np.where(active, slopes(layout, values) * step, 0.0)
    return np.where(positive, values * np.exp(np.where(positive, layout.scales * step, 0.0)), moved)


def newton_step(fit: Fit, layout: Layout, use: Bool[np.ndarray, "W"], *, damping: float = 0.0, active=None):
    """Gauss-Newton's step of the active values in their coordinates, shape [P]."""
    active = fit.active if active is None else active
    gradient, curvature = posterior(fit, layout, use)
    a = np.flatnonzero(active)
    matrix = curvature[np.ix_(a, a)]
    matrix = matrix + damping * np.diag(np.diagonal(matrix))
    step = np.zeros(len(active))
    step[a] = -np.linalg.solve(matrix, gradient[a])
    return step * min(1.0, _LARGEST_STEP / max(np.abs(step).max(), 1e-12))


def posterior(fit: Fit, layout: Layout, use: Bool[np.ndarray, "W"]):
    """Gradient and curvature of cost and prior in coordinates, over some windows."""
    slope = slopes(layout, fit.values)
    gradient = fit.sums.gradient[use].sum(axis=0) * slope + coordinates(layout, fit.values)
    curvature = fit.sums.curvature[use].sum(axis=0) * np.outer(slope, slope) + np.eye(len(slope))
    return gradient, curvature


def _objective(fit, layout, use):
    cost = float(fit.sums.cost[use].sum()) + 0.5 * float(np.sum(coordinates(layout, fit.values)[fit.active] ** 2))
    return cost if np.isfinite(cost) else np.inf


def _window_sums(predicted, derivative, target, seen, interval):
    count = derivative.shape[-1]
    lost = ~np.isfinite(predicted).all(axis=-1) | ~(np.abs(derivative).max(axis=(-2, -1)) < 1e3)
    miss = np.where((seen & ~lost)[..., None], predicted - np.where(seen[..., None], target, 0.0), 0.0)
    use = seen & ~lost
    ratio = np.sqrt((miss**2).sum(axis=-1)) / _ROBUST
    root = np.sqrt(1 + ratio**2)
    # weight of correlated samples, in units of the error of a good fit
    unit = _EVERY * interval / _CORRELATION / _ERROR**2 / 3
    cost = unit * _ROBUST**2 * (np.where(use, root - 1, 0.0).sum() + (seen & lost).sum() * (_LOST / _ROBUST))
    weight = np.where(use, unit / root, 0.0)[..., None]
    flat = np.where(use[..., None, None], derivative, 0.0).reshape(-1, count)
    weighted = (np.broadcast_to(weight, miss.shape).reshape(-1, 1)) * flat
    off = np.where(lost[..., None], _LOST, np.minimum(np.abs(miss), _LOST))[seen]
    return cost, weighted.T @ miss.reshape(-1), weighted.T @ flat, float(off.mean()) if off.size else np.nan


def _inputs(windows):
    return windows.position, windows.frames, windows.keypoints[:, :2]


def _chunks(windows):
    # batches of one size, so that one compilation serves; a window alone is not worth a batch
    size = _CHUNK if len(windows) > 1 else 1
    for begin in range(0, len(windows), size):
        index = np.arange(begin, min(begin + size, len(windows)))
        full = np.concatenate([index, np.full(size - len(index), index[0])])
        yield windows.chosen(full), len(index)


def _in_parallel(function, windows):
    """Chunks by as many threads as there are cores: one rollout's operations are too small to share."""
    with concurrent.futures.ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return list(pool.map(lambda item: function(*item), _chunks(windows)))


@functools.lru_cache(maxsize=8)
def _compiled(simulator, interval):
    def one(values, position, frames, seen):
        return simulator.rod.rollout(simulator.layout.physics(values), position, frames, seen, interval)

    def batch(values, *inputs):
        return jax.vmap(one, in_axes=(None, 0, 0, 0))(values, *inputs)

    def both(values, *inputs):
        def tangent(direction):
            return jax.jvp(lambda v: batch(v, *inputs), (values,), (direction,))

        predicted, derivative = jax.vmap(tangent, out_axes=(None, 0))(jnp.eye(values.shape[0]))
        return predicted, derivative

    options = compiler_options()
    return _double(jax.jit(batch, compiler_options=options)), _double(jax.jit(both, compiler_options=options))


def _double(run):
    def call(*arguments):
        with jax.enable_x64(True):
            return run(*(jnp.asarray(np.asarray(a, float)) for a in arguments))

    return call
