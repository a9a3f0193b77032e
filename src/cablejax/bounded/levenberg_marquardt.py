"""Levenberg-Marquardt steps that stay inside a feasible set."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree, Scalar

from cablejax.bounded.gain_ratio import GainRatio
from cablejax.bounded.least_squares import AbstractBoundedLeastSquares
from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.bounded.secant import convex_part
from cablejax.bounded.sets import ConvexSet


class ModelState(eqx.Module):
    """The model at a point, as a descent keeps it.

    Attributes:
        gradient: shape [P].
        hessian: positive semi-definite, shape [P, P].
    """

    gradient: Float[Array, " P"]
    hessian: Float[Array, "P P"]


class DampedQuadratic(optx.AbstractDescent):
    """`step(s)` minimises `g'd + d'(H + damping / s diag H) d / 2` over the d with y + d feasible.

    Attributes:
        damping: at s = 1, relative to the diagonal of H.
        secant: whether H may have negative eigenvalues; these are cut off.
        feasible: the convex set; None until a solver has put in that of its options.
        y: where the model is made, in the set's own shape; likewise.
    """

    damping: float
    secant: bool = eqx.field(static=True)
    feasible: ConvexSet | None = None
    y: Array | None = None

    def within(self, feasible: ConvexSet, y: Array) -> DampedQuadratic:
        """The same descent on a set, around a point."""
        return DampedQuadratic(self.damping, self.secant, feasible, y)

    def init(self, y, f_info_struct):
        """A model with the identity as its Hessian."""
        del f_info_struct
        return ModelState(jnp.zeros_like(y), jnp.eye(y.size, dtype=y.dtype))

    def query(self, y, f_info, state):
        """Keeps gradient and Hessian of the model at a new point."""
        del y, state
        hessian = f_info.hessian.as_matrix()
        return ModelState(f_info.grad, convex_part(hessian) if self.secant else hessian)

    def step(self, step_size, state):
        """The minimum over the set of the model with damping `damping / step_size` on its diagonal."""
        diagonal = jnp.diag(state.hessian)
        # no more than keeps what the model does not see at all from being singular: scales differ by as much as 1e10
        floor = jnp.finfo(diagonal.dtype).eps * diagonal.max() + jnp.finfo(diagonal.dtype).tiny
        damped = state.hessian + jnp.diag(self.damping / step_size * jnp.maximum(diagonal, floor))
        found = minimise_quadratic(damped, state.gradient, self.feasible, self.y)  # pyright: ignore[reportArgumentType]
        return found.point - self.y.ravel(), optx.RESULTS.successful  # pyright: ignore[reportOptionalMemberAccess]


class BoundedLevenbergMarquardt(AbstractBoundedLeastSquares):
    """Damped Gauss-Newton models, each minimised over the feasible set, so that active bounds are part of the model.

    A plain Levenberg-Marquardt step projected back onto the set need not be a descent (Bertsekas, SIAM J. Control
    Optim. 20, 1982). Singular Jacobians do no harm.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    descent: DampedQuadratic
    search: optx.AbstractSearch
    secant: bool = eqx.field(static=True)
    trials_per_linearisation: int = eqx.field(static=True)

    def __init__(
        self,
        rtol: float = 0.0,
        atol: float = 1e-8,
        damping: float = 1e-3,
        secant: bool = True,
        trials_per_linearisation: int = 1,
        search: Any = None,
    ):
        """Makes the solver.

        Args:
            rtol: relative tolerance on the projected gradient.
            atol: absolute tolerance on it.
            damping: at the start, relative to the diagonal of the model's Hessian.
            secant: whether the curvature of the residuals is learned.
            trials_per_linearisation: trial points of one step, the Jacobian being updated in between.
            search: how the damping follows the reductions; None = `GainRatio()`.
        """
        self.rtol, self.atol, self.norm = rtol, atol, optx.max_norm
        self.descent = DampedQuadratic(damping, secant)
        self.search = GainRatio() if search is None else search
        self.secant = secant
        self.trials_per_linearisation = trials_per_linearisation
