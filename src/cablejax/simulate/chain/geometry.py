"""Sums along a planar chain, in place of walks through a tree, and the solution of its equations of motion."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def chained(steps: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    """Start of each link if link k leads on by `steps[k]`."""
    return jnp.concatenate([jnp.zeros((1, 2), steps.dtype), jnp.cumsum(steps[:-1], axis=0)])


def beyond(x: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Sums over this link and all that follow."""
    return jnp.cumsum(x[::-1], axis=0)[::-1]


def turned(x: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """A quarter turn to the left."""
    return jnp.stack([-x[..., 1], x[..., 0]], axis=-1)


def cross(a: Float[Array, "n 2"], b: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Component across the plane of the cross product."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def solve_lower(matrix: Float[Array, "n n"], rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solves a positive definite system given by its lower triangle. Differentiable in forward and reverse mode."""
    lower = jnp.tril(matrix)
    symmetric = lower + jnp.tril(matrix, -1).T
    factor = jax.lax.linalg.cholesky(jax.lax.stop_gradient(symmetric), symmetrize_input=False)

    def solve(_, b):
        half = jax.lax.linalg.triangular_solve(factor, b, left_side=True, lower=True)
        return jax.lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)

    return jax.lax.custom_linear_solve(lambda x: symmetric @ x, rhs, solve, symmetric=True)
