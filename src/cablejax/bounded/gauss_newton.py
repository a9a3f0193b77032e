"""Gauss-Newton with a line search inside a feasible set."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from cablejax.bounded.least_squares import AbstractBoundedLeastSquares, ModelDescent


class ConstrainedNewton(ModelDescent):
    """`step(s) = s d`, where d minimises `g'd + d'H d / 2` over the d with y + d feasible.

    On a convex set every step between 0 and 1 ends inside. Directions that H does not see are left alone.
    """

    def init(self, y, f_info_struct):
        """The initial state: a direction of zeros."""
        del f_info_struct
        return jnp.zeros_like(y)

    def query(self, y, f_info, state):
        """The direction to the minimum of the model over the feasible set."""
        del y, state
        return self.minimum(regularised(self.convex(f_info)), f_info.grad)

    def step(self, step_size, state):
        """The direction, shortened to `step_size` of it."""
        return step_size * state, optx.RESULTS.successful


class BoundedGaussNewton(AbstractBoundedLeastSquares):
    """Gauss-Newton models without damping, each minimised over the feasible set, and backtracking towards the minimum.

    The fewest settings, and the fastest where the residuals are small and the Jacobian has full rank.
    """

    secant: bool = eqx.field(static=True, default=False)

    @property
    def descent(self) -> ConstrainedNewton:
        """The direction to the minimum of the model over the set."""
        return ConstrainedNewton(self.secant)

    @property
    def search(self) -> optx.BacktrackingArmijo:
        """Shortens a step until the function falls enough."""
        return optx.BacktrackingArmijo(slope=1e-4, decrease_factor=0.3)


def regularised(hessian: Float[Array, "P P"]) -> Float[Array, "P P"]:
    """The matrix with as little added to its diagonal as makes it positive definite to rounding."""
    diagonal = jnp.diag(hessian)
    eps, tiny = jnp.finfo(hessian.dtype).eps, jnp.finfo(hessian.dtype).tiny
    return hessian + jnp.diag(100 * eps * jnp.maximum(diagonal, eps**0.5 * diagonal.max()) + tiny)
