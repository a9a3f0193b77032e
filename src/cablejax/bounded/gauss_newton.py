"""Gauss-Newton with a line search inside a feasible set."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree, Scalar

from cablejax.bounded.least_squares import AbstractProjectedLeastSquares
from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.bounded.sets import AbstractSet


class _DirectionState(eqx.Module):
    direction: Float[Array, " P"]
    result: optx.RESULTS


class ConstrainedNewton(optx.AbstractDescent):
    """`step(s) = s d`, where d minimises `g'd + d'H d / 2` over the d with y + d feasible.

    On a convex set every step between 0 and 1 ends inside. Without damping the model must be bounded from below: a
    Hessian that is singular to rounding ends the solve with `RESULTS.singular`.

    Attributes:
        feasible: the set.
        iterations: see `quadratic.minimise_quadratic`.
    """

    feasible: AbstractSet
    iterations: int = eqx.field(static=True)

    def init(self, y, f_info_struct):
        del f_info_struct
        return _DirectionState(jnp.zeros_like(y), optx.RESULTS.successful)

    def query(self, y, f_info, state):
        del state
        hessian = f_info.hessian.as_matrix()
        eigenvalues = jnp.linalg.eigvalsh(hessian)
        singular = ~(eigenvalues[0] > y.size * jnp.finfo(y.dtype).eps * jnp.abs(eigenvalues[-1]))
        safe = jnp.where(singular, jnp.eye(y.size, dtype=y.dtype), hessian)
        found = minimise_quadratic(self.feasible, y, f_info.grad, safe, self.iterations)
        result = optx.RESULTS.where(singular, optx.RESULTS.singular, optx.RESULTS.successful)
        return _DirectionState(self.feasible.restore(y + found.step) - y, result)

    def step(self, step_size, state):
        return step_size * state.direction, state.result


class ProjectedGaussNewton(AbstractProjectedLeastSquares):
    """Gauss-Newton models without damping, each minimised over the feasible set, and backtracking towards the minimum.

    The fewest settings, and the fastest where the residuals are small and the Jacobian has full rank.
    """

    feasible: AbstractSet
    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    descent: ConstrainedNewton
    search: optx.BacktrackingArmijo
    secant: bool = eqx.field(static=True)

    def __init__(
        self,
        feasible: AbstractSet,
        rtol: float,
        atol: float,
        norm: Callable[[PyTree], Scalar] = optx.max_norm,
        inner_iterations: int = 100,
    ):
        """**Arguments:**

        - `feasible`: the set to minimise over.
        - `rtol`, `atol`, `norm`: tolerance on the projected gradient, see `AbstractProjectedLeastSquares`.
        - `inner_iterations`: of the splitting, on each model.
        """
        self.feasible, self.rtol, self.atol, self.norm = feasible, rtol, atol, norm
        self.descent = ConstrainedNewton(feasible, inner_iterations)
        self.search = optx.BacktrackingArmijo(slope=1e-4)
        self.secant = False
