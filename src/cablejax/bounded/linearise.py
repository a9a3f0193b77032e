"""Residuals and their Jacobian by forward mode, the default linearisation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float


def forward(
    residual_fn: Callable[[Array, Any], Array],
) -> Callable[[Array, Any], tuple[Float[Array, " M"], Float[Array, "M P"]]]:
    """`residual_fn(y, args)` and its Jacobian with respect to the flattened y, in forward mode."""

    def linearise(y, args):
        def twice(y):
            residual = residual_fn(y, args)
            return residual, residual

        jacobian, residual = jax.jacfwd(twice, has_aux=True)(y)
        return residual, jacobian.reshape(residual.size, y.size)

    return linearise


def squared_jacobian(
    linearise: Callable[[Array, Any], tuple[Float[Array, " M"], Float[Array, "M P"]]],
) -> Callable[[Array, Any], Float[Array, "P P"]]:
    """`J'J` at a point: Gauss and Newton's model of the Hessian of half the sum of squares."""

    def squared(y, args):
        jacobian = linearise(y, args)[1]
        return jacobian.T @ jacobian

    return squared
