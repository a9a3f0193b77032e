"""Whole rollouts against recorded windows: predictions, costs and their derivatives.

Distances between simulated and recorded markers count as pseudo-Huber, 2 d^2 (sqrt(1 + (r/d)^2) - 1): a window in which
the cable swings over another way must not decide alone. They stay the same for tenths of a second, so the sum over
samples is divided by the samples of a correlation time before it is held against the prior.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import os

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cablejax.simulate.compile import compiler_options
from cablejax.simulate.rod import Rod
from cablejax.spatial.effects import Layout
from cablejax.spatial.values import Values, shared_by_all
from cablejax.spatial.windows import Windows

_CHUNK = 8
_ROBUST = 0.02  # d [m]
GOOD_FIT = 0.01
"""What is left of a good fit [m]: unit of the residuals."""
_CORRELATION = 0.3  # [s]
_EVERY = 4
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

    def finer(self, factor: int) -> Simulator:
        """With so many times as many time steps."""
        return dataclasses.replace(self, rod=dataclasses.replace(self.rod, substeps=factor * self.rod.substeps))

    def predict(self, values: Values | Float[np.ndarray, "P"], windows: Windows) -> Float[np.ndarray, "W T F 3"]:
        """Free markers of every window from its first two samples on [m]."""
        run, values = _compiled(self, windows.interval)[0], _as_values(values)
        return np.concatenate(
            _in_parallel(lambda part, count: np.asarray(run(values.of(part.group), *_inputs(part)))[:count], windows)
        )

    def sums(self, values: Values, windows: Windows) -> Sums:
        """Costs of every window, and their derivatives by the values that the window has."""
        run = _compiled(self, windows.interval)[1]

        def rows_of(part, count):
            predicted, derivative = (np.asarray(a) for a in run(values.of(part.group), *_inputs(part)))
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


def bounded(off: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Sizes of errors [m]; what a simulation has lost, NaN included, is off by `_LOST`."""
    return np.minimum(np.nan_to_num(np.abs(off), nan=_LOST, posinf=_LOST), _LOST)


def errors(predicted: Float[np.ndarray, "W T F 3"], windows: Windows) -> Float[np.ndarray, "W"]:
    """Mean absolute error of a coordinate of the free markers, from the third sample on [m]."""
    off = bounded(predicted - windows.keypoints)[:, 2:]
    seen = np.isfinite(windows.keypoints[:, 2:]) & windows.valid[:, 2:, None, None]
    return (off * seen).sum(axis=(1, 2, 3)) / seen.sum(axis=(1, 2, 3))


def over_all_markers(error: Float[np.ndarray, "W"], windows: Windows) -> Float[np.ndarray, "W"]:
    """The same with the held markers counted as predicted without error, as Chen et al. (2024) count [m]."""
    return error * windows.keypoints.shape[2] / windows.n_keypoints


def _window_sums(predicted, derivative, target, seen, interval):
    count = derivative.shape[-1]
    lost = ~np.isfinite(predicted).all(axis=-1) | ~(np.abs(derivative).max(axis=(-2, -1)) < 1e3)
    miss = np.where((seen & ~lost)[..., None], predicted - np.where(seen[..., None], target, 0.0), 0.0)
    use = seen & ~lost
    ratio = np.sqrt((miss**2).sum(axis=-1)) / _ROBUST
    root = np.sqrt(1 + ratio**2)
    # weight of correlated samples, in units of the error of a good fit
    unit = _EVERY * interval / _CORRELATION / GOOD_FIT**2 / 3
    cost = unit * _ROBUST**2 * (np.where(use, root - 1, 0.0).sum() + (seen & lost).sum() * (_LOST / _ROBUST))
    weight = np.where(use, unit / root, 0.0)[..., None]
    flat = np.where(use[..., None, None], derivative, 0.0).reshape(-1, count)
    weighted = (np.broadcast_to(weight, miss.shape).reshape(-1, 1)) * flat
    off = np.where(lost[..., None], _LOST, np.minimum(np.abs(miss), _LOST))[seen]
    return cost, weighted.T @ miss.reshape(-1), weighted.T @ flat, float(off.mean()) if off.size else np.nan


def _as_values(values) -> Values:
    return values if isinstance(values, Values) else shared_by_all(values, np.zeros(0, int))


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
        return jax.vmap(one)(values, *inputs)

    def both(values, *inputs):
        def tangent(direction):
            return jax.jvp(lambda v: batch(v, *inputs), (values,), (jnp.broadcast_to(direction, values.shape),))

        predicted, derivative = jax.vmap(tangent, out_axes=(None, 0))(jnp.eye(values.shape[1]))
        return predicted, derivative

    options = compiler_options()
    return _double(jax.jit(batch, compiler_options=options)), _double(jax.jit(both, compiler_options=options))


def _double(run):
    def call(*arguments):
        with jax.enable_x64(True):
            return run(*(jnp.asarray(np.asarray(a, float)) for a in arguments))

    return call
