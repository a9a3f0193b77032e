"""Sums along a planar chain, in place of walks through a tree, and the solution of its equations of motion."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.cable import Discretisation
from cablejax.simulate.composite import link_lengths, node_offsets

# Sums are products with triangles of ones: on a processor, XLA's `cumsum` takes several times as long.


def summed(x: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Sums over this link and all before."""
    return jnp.asarray(np.tri(len(x)), x.dtype) @ x


def levers(config: Discretisation) -> np.ndarray:
    """How far each link carries each node along its own direction [m], shape [n nodes, n links]."""
    return np.tri(config.n_links, k=-1) * link_lengths(config) + np.diag(node_offsets(config))


def solve_lower(matrix: Float[Array, "n n"], rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solves a positive definite system given by its lower triangle. Differentiable in forward and reverse mode."""
    symmetric = jnp.tril(matrix) + jnp.tril(matrix, -1).T
    # which reads the lower triangle alone: without derivatives, `symmetric` is never made
    factor = jax.lax.linalg.cholesky(jax.lax.stop_gradient(matrix), symmetrize_input=False)

    def solve(_, b):
        half = jax.lax.linalg.triangular_solve(factor, b, left_side=True, lower=True)
        return jax.lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)

    return jax.lax.custom_linear_solve(lambda x: symmetric @ x, rhs, solve, symmetric=True)
