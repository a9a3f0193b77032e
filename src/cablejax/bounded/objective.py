"""The objective of a solve: value, Jacobian of the residuals, quadratic model, and auxiliary output."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Scalar


def value_of(out: Array) -> Scalar:
    """The objective from a function's output: a scalar is the value, residuals give half the sum of their squares."""
    return out if out.ndim == 0 else 0.5 * jnp.sum(out**2)


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


def quadratic_info(value: Scalar, gradient: Float[Array, " P"], hessian: Float[Array, "P P"]):
    """The model in the form that optimistix's descents and searches expect."""
    return optx.FunctionInfo.EvalGradHessian(value, gradient, lx.MatrixLinearOperator(hessian))


def promised_decrease(info: Any, move: Float[Array, " P"]) -> Scalar:
    """Decrease of the model, from `quadratic_info`, over a move."""
    return -(jnp.sum(info.grad * move) + 0.5 * move @ info.hessian.as_matrix() @ move)


def derivative_along(fn: Callable[..., Any], primals: tuple, tangents: tuple) -> Any:
    """The derivative of `fn(*primals)` along tangents; None is a zero tangent."""
    # The tangents are those of arrays; what has none stays as it is.
    moving = jax.tree.map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None)
    varying, fixed = eqx.partition(primals, moving)
    return jax.jvp(lambda varying: fn(*eqx.combine(varying, fixed)), (varying,), (tangents,))[1]


def nothing_yet(struct: Any) -> Any:
    """Zeros in place of an aux of this structure, before the function has been called."""
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), struct)


def aux_at(fn: Any, y: Array, args: Any, struct: Any) -> Any:
    """The aux at a point; where there is none the function is not called."""
    return fn(y, args)[1] if jax.tree.leaves(struct) else struct


def chosen(accept: Bool[Array, ""], new: Any, old: Any) -> Any:
    """The aux of a trial that was accepted, or the one before."""
    return jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, old)
