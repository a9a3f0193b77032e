"""Sums along a planar chain, in place of walks through a tree, and the solution of its equations of motion."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Sums are products with triangles of ones: on a processor, XLA's `cumsum` takes several times as long.


def summed(x: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Sums over this link and all before."""
    return jnp.asarray(np.tri(len(x)), x.dtype) @ x


def chained(steps: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    """Start of each link if link k leads on by `steps[k]`."""
    return jnp.asarray(np.tri(len(steps), k=-1), steps.dtype) @ steps


def beyond(x: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Sums over this link and all that follow."""
    return jnp.asarray(np.tri(len(x)).T, x.dtype) @ x


def cross(a: Float[Array, "n 2"], b: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Component across the plane of the cross product."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def solve_lower(matrix: Float[Array, "n n"], rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solves a positive definite system given by its lower triangle. Differentiable in forward and reverse mode."""
    symmetric = jnp.tril(matrix) + jnp.tril(matrix, -1).T
    # which reads the lower triangle alone: without derivatives, `symmetric` is never made
    factor = jax.lax.linalg.cholesky(jax.lax.stop_gradient(matrix), symmetrize_input=False)

    def solve(_, b):
        half = jax.lax.linalg.triangular_solve(factor, b, left_side=True, lower=True)
        return jax.lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)

    return jax.lax.custom_linear_solve(lambda x: symmetric @ x, rhs, solve, symmetric=True)
