"""Derivatives of bounded minima, correct where bounds are active."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import optimistix as optx
from jaxtyping import Array

from cablejax.bounded.objective import value_of
from cablejax.bounded.sets import AbstractSet


class FixedPointAdjoint(optx.AbstractAdjoint):
    """Differentiates a minimum over a set as the fixed point `y = P(y - grad f(y))`, in forward and reverse mode.

    `optimistix.ImplicitAdjoint` differentiates `grad f(y) = 0`, which does not hold at an active bound. Here the
    projection's derivative takes away the directions that the bounds forbid, and the solution moves along those only as
    the bounds do. The set comes from `options["feasible"]`; its arrays are differentiated in as `args` are. Takes one
    Hessian-vector product for every element of y. Where a bound is touched without holding (its multiplier is 0) the
    solution has a kink, and no derivative. Where the minimum is not isolated, or the function there is not a number,
    lineax raises as the derivative is taken, under `vmap` for the whole batch.
    """

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        """Solves, then differentiates the solver's fixed point by the implicit function theorem."""
        # The tags describe the Hessian, not this system.
        del rewrite_fn, tags
        return optx.ImplicitAdjoint().apply(primal_fn, _fixed_point, inputs, frozenset())


def _fixed_point(y, residual, inputs):
    """`P(y - grad f(y)) - y`; `fn` gives f itself or the residuals whose half sum of squares it is."""
    del residual
    fn, _, _, args, options, *_ = inputs

    def objective(y):
        return value_of(fn(y, args)[0])

    return options["feasible"].at(y).project(y - jax.grad(objective)(y)) - y


def with_derivatives(y: Array, fn: Callable[[Array, Any], Array], feasible: AbstractSet, args: Any) -> Array:
    """A known minimum `y` of `fn(y, args)` over a set, with its derivatives in `args` and in the set's arrays.

    For a minimum that was found by other means, or long ago; see `FixedPointAdjoint`. `fn` may give the function or
    residuals whose half sum of squares it is.
    """
    with_aux = eqx.filter_closure_convert(lambda y, args: (fn(y, args), None), y, args)
    inputs = (with_aux, None, y, args, {"feasible": feasible})
    value, _ = optx.ImplicitAdjoint().apply(lambda inputs: (inputs[2], None), _fixed_point, inputs, frozenset())
    return value
