"""The compiled programs of a rod in the windows of a cable, in double precision, and the limit of ever more edges."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cablejax.simulate.compile import compiler_options
from cablejax.simulate.rod import Rod
from cablejax.spatial.effects import Layout


# one for each number of edges and of time steps of a cable
@functools.lru_cache(maxsize=16)
def compiled_rod(rod: Rod, layout: Layout, interval: float) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Programs that simulate a batch of windows, and differentiate it.

    Args:
        rod: resolution.
        layout: of the values.
        interval: between samples [s].

    Returns:
        `(values, wanted, position, frames, seen)` to free markers and `RodResult`s, and `(values, directions, wanted,
        position, frames, seen)` to free markers and their derivatives; see `Rod.rollout`.
    """

    def one(values, wanted, position, frames, seen):
        found = rod.rollout(layout.physics(values), position, frames, seen, interval, wanted)
        reached = jnp.arange(found.points.shape[0]) < found.solved
        return jnp.where(reached[:, None, None], found.points, jnp.nan), found.result

    def batch(values, wanted, *inputs):
        return jax.vmap(one, (0, None, 0, 0, 0))(values, wanted, *inputs)

    def both(values, directions, *inputs):
        def tangent(direction):
            return jax.jvp(lambda v: batch(v, *inputs)[0], (values,), (jnp.broadcast_to(direction, values.shape),))

        return jax.vmap(tangent, out_axes=(None, 1))(directions)

    options = compiler_options()
    return _double(jax.jit(batch, compiler_options=options)), _double(jax.jit(both, compiler_options=options))


def _double(run):
    def call(*arguments):
        with jax.enable_x64(True):
            return run(*(jnp.asarray(np.asarray(a, float)) for a in arguments))

    return call


def limit(numbers: Sequence[int], motions: Sequence[np.ndarray]) -> np.ndarray:
    """Of the polynomial in the squared length of an edge through the motions of these numbers of edges, at zero."""
    weights = [math.prod(n**2 / (n**2 - other**2) for other in numbers if other != n) for n in numbers]
    return sum((weight * motion for weight, motion in zip(weights, motions, strict=True)), np.zeros(()))
