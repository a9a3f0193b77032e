"""Levenberg-Marquardt steps that stay inside a feasible set."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree, Scalar

from cablejax.bounded.least_squares import AbstractProjectedLeastSquares
from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.bounded.sets import AbstractSet


class _ModelState(eqx.Module):
    y: Float[Array, " P"]
    gradient: Float[Array, " P"]
    hessian: Float[Array, "P P"]
    largest: Scalar


class DampedQuadratic(optx.AbstractDescent):
    """`step(s)` minimises `g'd + d'(H + damping / s) d / 2` over the d with y + d feasible.

    Attributes:
        feasible: the set.
        damping: at s = 1, relative to the largest eigenvalue of H.
        iterations: see `quadratic.minimise_quadratic`.
    """

    feasible: AbstractSet
    damping: float
    iterations: int = eqx.field(static=True)

    def init(self, y, f_info_struct):
        del f_info_struct
        return _ModelState(y, jnp.zeros_like(y), jnp.eye(y.size, dtype=y.dtype), jnp.ones((), y.dtype))

    def query(self, y, f_info, state):
        del state
        eigenvalues, basis = jnp.linalg.eigh(f_info.hessian.as_matrix())
        # A secant term can make the model concave along some directions: there it is flat, and the damping bounds it.
        flat = jnp.maximum(eigenvalues, 0.0)
        largest = flat[-1] + jnp.finfo(y.dtype).tiny
        return _ModelState(y, f_info.grad, (basis * flat) @ basis.T, largest)

    def step(self, step_size, state):
        damped = state.hessian + self.damping / step_size * state.largest * jnp.eye(state.y.size, dtype=state.y.dtype)
        found = minimise_quadratic(self.feasible, state.y, state.gradient, damped, self.iterations)
        return self.feasible.restore(state.y + found.step) - state.y, optx.RESULTS.successful


class ProjectedLevenbergMarquardt(AbstractProjectedLeastSquares):
    """Damped Gauss-Newton models, each minimised over the feasible set, so that active bounds are part of the model.

    A plain Levenberg-Marquardt step projected back onto the set need not be a descent (Bertsekas, SIAM J. Control
    Optim. 20, 1982). The damping follows the ratio of actual to predicted reduction, see
    `optimistix.ClassicalTrustRegion`.
    """

    feasible: AbstractSet
    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    descent: DampedQuadratic
    search: optx.ClassicalTrustRegion
    secant: bool = eqx.field(static=True)

    def __init__(
        self,
        feasible: AbstractSet,
        rtol: float,
        atol: float,
        norm: Callable[[PyTree], Scalar] = optx.max_norm,
        damping: float = 1e-3,
        secant: bool = True,
        inner_iterations: int = 100,
        search: optx.AbstractSearch | None = None,
    ):
        """**Arguments:**

        - `feasible`: the set to minimise over.
        - `rtol`, `atol`, `norm`: tolerance on the projected gradient, see `AbstractProjectedLeastSquares`.
        - `damping`: at the start, relative to the largest eigenvalue of the model's Hessian.
        - `secant`: whether the curvature of the residuals is learned.
        - `inner_iterations`: of the splitting, on each model.
        - `search`: how the damping follows the reductions.
        """
        self.feasible, self.rtol, self.atol, self.norm = feasible, rtol, atol, norm
        self.descent = DampedQuadratic(feasible, damping, inner_iterations)
        self.search = optx.ClassicalTrustRegion(high_cutoff=0.75) if search is None else search
        self.secant = secant
