"""Derivatives of bounded minima, right where bounds are active."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx


class FixedPointAdjoint(optx.AbstractAdjoint):
    """Differentiates a minimum over a set as the fixed point `y = P(y - grad f(y))`.

    `optimistix.ImplicitAdjoint` differentiates `grad f(y) = 0`, which does not hold at an active bound. Here the
    projection's derivative takes away the directions that the bounds forbid, and the solution moves along those only as
    the bounds do. For solvers with an attribute `feasible`, whose arrays are differentiated in as `args` are. Takes one
    Hessian-vector product for every element of y. Where a bound is touched without holding (its multiplier is 0) the
    solution has a kink, and the derivative is that of the inside.

    Attributes:
        linear_solver: of the system `d(P(y - grad f) - y) / dy`.
    """

    linear_solver: lx.AbstractLinearSolver = lx.AutoLinearSolver(well_posed=None)

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        # The tags describe the Hessian, not this system.
        del rewrite_fn, tags
        return optx.ImplicitAdjoint(self.linear_solver).apply(primal_fn, _fixed_point, inputs, frozenset())


def _fixed_point(y, residual, inputs):
    """`P(y - grad f(y)) - y`; `fn` gives f itself or the residuals whose half sum of squares it is."""
    del residual
    fn, solver, _, args, *_ = inputs

    def objective(y):
        out, _ = fn(y, args)
        return out if out.ndim == 0 else 0.5 * jnp.sum(out**2)

    return solver.feasible.project(y - jax.grad(objective)(y)) - y
