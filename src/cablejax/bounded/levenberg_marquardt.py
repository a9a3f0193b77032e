"""Levenberg-Marquardt steps that stay inside a feasible set."""

from __future__ import annotations

import jax.numpy as jnp
import optimistix as optx

from cablejax.bounded.gain_ratio import GainRatio
from cablejax.bounded.least_squares import AbstractBoundedLeastSquares, ModelDescent

_DAMPING = 1e-3
"""At a step size of 1, relative to the diagonal of the model's Hessian."""


class DampedQuadratic(ModelDescent):
    """`step(s)` minimises `g'd + d'(H + diag H / 1000 s) d / 2` over the d with y + d feasible.

    Its state is the gradient [P] and the positive semi-definite Hessian [P, P] of the model.
    """

    def init(self, y, f_info_struct):
        """A model with the identity as its Hessian."""
        del f_info_struct
        return jnp.zeros_like(y), jnp.eye(y.size, dtype=y.dtype)

    def query(self, y, f_info, state):
        """Keeps gradient and Hessian of the model at a new point."""
        del y, state
        return f_info.grad, self.convex(f_info)

    def step(self, step_size, state):
        """The minimum over the set of the model, damped less the larger the step size."""
        gradient, hessian = state
        diagonal = jnp.diag(hessian)
        # no more than keeps what the model does not see at all from being singular: scales differ by as much as 1e10
        floor = jnp.finfo(diagonal.dtype).eps * diagonal.max() + jnp.finfo(diagonal.dtype).tiny
        damped = hessian + jnp.diag(_DAMPING / step_size * jnp.maximum(diagonal, floor))
        return self.minimum(damped, gradient), optx.RESULTS.successful


class BoundedLevenbergMarquardt(AbstractBoundedLeastSquares):
    """Damped Gauss-Newton models, each minimised over the feasible set, so that active bounds are part of the model.

    A plain Levenberg-Marquardt step projected back onto the set need not be a descent (Bertsekas, SIAM J. Control
    Optim. 20, 1982). Singular Jacobians do no harm.
    """

    @property
    def descent(self) -> DampedQuadratic:
        """The minimum of the damped model over the set."""
        return DampedQuadratic(self.secant)

    @property
    def search(self) -> GainRatio:
        """The damping follows the reductions."""
        return GainRatio()
