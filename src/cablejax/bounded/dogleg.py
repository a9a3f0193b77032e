"""Powell's dogleg inside a feasible set."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree, Scalar

from cablejax.bounded.least_squares import AbstractProjectedLeastSquares
from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.bounded.sets import AbstractSet


class _LegsState(eqx.Module):
    cauchy: Float[Array, " P"]
    newton: Float[Array, " P"]


class ProjectedDoglegDescent(optx.AbstractDescent):
    """`step(s)` goes along two legs, to the projected Cauchy point and on to the model's minimum over the set.

    It stops at the length `s |newton|`, the trust region; s = 1 is the whole way (as in `optimistix.DoglegDescent`).
    The corners are feasible, so on a convex set the legs are.

    Attributes:
        feasible: the set.
        iterations: see `quadratic.minimise_quadratic`.
    """

    feasible: AbstractSet
    iterations: int = eqx.field(static=True)

    def init(self, y, f_info_struct):
        del f_info_struct
        return _LegsState(jnp.zeros_like(y), jnp.zeros_like(y))

    def query(self, y, f_info, state):
        del state
        gradient, hessian = f_info.grad, f_info.hessian.as_matrix()
        tiny = jnp.finfo(y.dtype).tiny
        eigenvalues, basis = jnp.linalg.eigh(hessian)
        # Directions that the model does not see at all are bounded by the trust region only: a floor keeps them finite.
        floor = y.size * jnp.finfo(y.dtype).eps * jnp.abs(eigenvalues[-1]) + tiny
        model = (basis * jnp.maximum(eigenvalues, floor)) @ basis.T
        length = jnp.sum(gradient**2) / (gradient @ model @ gradient + tiny)
        cauchy = self.feasible.project(y - length * gradient) - y
        # the projection bends the ray: along the chord the model may have its minimum before the end
        slope, curvature = jnp.sum(gradient * cauchy), cauchy @ model @ cauchy
        cauchy = cauchy * jnp.clip(-slope / (curvature + tiny), 0.0, 1.0)
        found = minimise_quadratic(self.feasible, y, gradient, model, self.iterations)
        return _LegsState(cauchy, self.feasible.restore(y + found.step) - y)

    def step(self, step_size, state):
        tiny = jnp.finfo(step_size.dtype).tiny
        cauchy, leg = state.cauchy, state.newton - state.cauchy
        reach = step_size * jnp.linalg.norm(state.newton)
        near = jnp.linalg.norm(cauchy)
        first = cauchy * jnp.minimum(reach / (near + tiny), 1.0)
        # |cauchy + t leg| = reach, by the greater root, written without cancellation
        a, b, c = jnp.sum(leg**2), jnp.sum(cauchy * leg), near**2 - reach**2
        root = jnp.sqrt(jnp.maximum(b**2 - a * c, 0.0))
        t = jnp.where(b > 0, -c / (b + root + tiny), (root - b) / (a + tiny))
        second = cauchy + jnp.clip(t, 0.0, 1.0) * leg
        return jnp.where(reach <= near, first, second), optx.RESULTS.successful


class ProjectedDogleg(AbstractProjectedLeastSquares):
    """A trust region around Gauss-Newton models, its steps along the dogleg inside the feasible set.

    One quadratic is minimised per linearisation, whatever happens to the trust region. A rank-deficient Jacobian does
    no harm.
    """

    feasible: AbstractSet
    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    descent: ProjectedDoglegDescent
    search: optx.ClassicalTrustRegion
    secant: bool = eqx.field(static=True)

    def __init__(
        self,
        feasible: AbstractSet,
        rtol: float,
        atol: float,
        norm: Callable[[PyTree], Scalar] = optx.max_norm,
        secant: bool = True,
        inner_iterations: int = 100,
    ):
        """**Arguments:**

        - `feasible`: the set to minimise over.
        - `rtol`, `atol`, `norm`: tolerance on the projected gradient, see `AbstractProjectedLeastSquares`.
        - `secant`: whether the curvature of the residuals is learned.
        - `inner_iterations`: of the splitting, on each model.
        """
        self.feasible, self.rtol, self.atol, self.norm = feasible, rtol, atol, norm
        self.descent = ProjectedDoglegDescent(feasible, inner_iterations)
        self.search = optx.ClassicalTrustRegion(high_cutoff=0.75)
        self.secant = secant
