"""Gauss-Newton with a line search inside a feasible set."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree, Scalar

from cablejax.bounded.least_squares import AbstractBoundedLeastSquares
from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.bounded.secant import convex_part
from cablejax.bounded.sets import ConvexSet


class ConstrainedNewton(optx.AbstractDescent):
    """`step(s) = s d`, where d minimises `g'd + d'H d / 2` over the d with y + d feasible.

    On a convex set every step between 0 and 1 ends inside. Directions that H does not see are left alone.

    Attributes:
        secant: whether H may have negative eigenvalues; these are cut off.
        feasible: the convex set; None until a solver has put in that of its options.
        y: where the model is made, in the set's own shape; likewise.
    """

    secant: bool = eqx.field(static=True)
    feasible: ConvexSet | None = None
    y: Array | None = None

    def within(self, feasible: ConvexSet, y: Array) -> ConstrainedNewton:
        """The same descent on a set, around a point."""
        return ConstrainedNewton(self.secant, feasible, y)

    def init(self, y, f_info_struct):
        """A direction of zeros."""
        del f_info_struct
        return jnp.zeros_like(y)

    def query(self, y, f_info, state):
        """The direction to the minimum of the model over the feasible set."""
        del state
        hessian = f_info.hessian.as_matrix()
        regular = regularised(convex_part(hessian) if self.secant else hessian)
        return minimise_quadratic(regular, f_info.grad, self.feasible, self.y).point - y  # pyright: ignore[reportArgumentType]

    def step(self, step_size, state):
        """The direction, shortened to `step_size` of it."""
        return step_size * state, optx.RESULTS.successful


class BoundedGaussNewton(AbstractBoundedLeastSquares):
    """Gauss-Newton models without damping, each minimised over the feasible set, and backtracking towards the minimum.

    The fewest settings, and the fastest where the residuals are small and the Jacobian has full rank.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    descent: ConstrainedNewton
    search: optx.AbstractSearch
    secant: bool = eqx.field(static=True)
    trials_per_linearisation: int = eqx.field(static=True)

    def __init__(self, rtol: float = 0.0, atol: float = 1e-8, secant: bool = False, trials_per_linearisation: int = 1):
        """Makes the solver.

        Args:
            rtol: relative tolerance on the projected gradient.
            atol: absolute tolerance on it.
            secant: whether the curvature of the residuals is learned.
            trials_per_linearisation: trial points of one step, the Jacobian being updated in between.
        """
        self.rtol, self.atol, self.norm = rtol, atol, optx.max_norm
        self.descent = ConstrainedNewton(secant)
        self.search = optx.BacktrackingArmijo(slope=1e-4, decrease_factor=0.3)
        self.secant = secant
        self.trials_per_linearisation = trials_per_linearisation


def regularised(hessian: Float[Array, "P P"]) -> Float[Array, "P P"]:
    """The matrix with as little added to its diagonal as makes it positive definite to rounding."""
    diagonal = jnp.diag(hessian)
    eps, tiny = jnp.finfo(hessian.dtype).eps, jnp.finfo(hessian.dtype).tiny
    return hessian + jnp.diag(100 * eps * jnp.maximum(diagonal, eps**0.5 * diagonal.max()) + tiny)
