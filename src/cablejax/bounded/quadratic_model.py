"""A quadratic model of a function around a point."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Float, Scalar


def quadratic_info(value: Scalar, gradient: Float[Array, " P"], hessian: Float[Array, "P P"]):
    """The model as optimistix's descents and searches take it."""
    return optx.FunctionInfo.EvalGradHessian(value, gradient, lx.MatrixLinearOperator(hessian))


def promised_decrease(info: Any, move: Float[Array, " P"]) -> Scalar:
    """By how much the model, from `quadratic_info`, falls over a move."""
    return -(jnp.sum(info.grad * move) + 0.5 * move @ info.hessian.as_matrix() @ move)
