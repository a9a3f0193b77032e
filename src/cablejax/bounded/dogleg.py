"""Powell's dogleg inside a feasible set."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree, Scalar

from cablejax.bounded.gain_ratio import GainRatio
from cablejax.bounded.gauss_newton import regularised
from cablejax.bounded.least_squares import AbstractBoundedLeastSquares
from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.bounded.secant import convex_part
from cablejax.bounded.sets import ConvexSet


class LegsState(eqx.Module):
    """The corners of the dogleg, as steps from y.

    Attributes:
        cauchy: to the model's minimum along the projected gradient, shape [P].
        newton: to its minimum over the set, shape [P].
    """

    cauchy: Float[Array, " P"]
    newton: Float[Array, " P"]


class BoundedDoglegDescent(optx.AbstractDescent):
    """`step(s)` goes along two legs, to the projected Cauchy point and on to the model's minimum over the set.

    It stops at the length `s |newton|`, the trust region; s = 1 is the whole way (as in `optimistix.DoglegDescent`).
    The corners are feasible, so on a convex set the legs are.

    Attributes:
        secant: whether the model's Hessian may have negative eigenvalues; these are cut off.
        feasible: the convex set; None until a solver has put in that of its options.
        y: where the model is made, in the set's own shape; likewise.
    """

    secant: bool = eqx.field(static=True)
    feasible: ConvexSet | None = None
    y: Array | None = None

    def within(self, feasible: ConvexSet, y: Array) -> BoundedDoglegDescent:
        """The same descent on a set, around a point."""
        return BoundedDoglegDescent(self.secant, feasible, y)

    def init(self, y, f_info_struct):
        """Two legs of length zero."""
        del f_info_struct
        return LegsState(jnp.zeros_like(y), jnp.zeros_like(y))

    def query(self, y, f_info, state):
        """Computes both legs at a new point: to the Cauchy point, and to the minimum of the model in the set."""
        del state
        feasible, at = self.feasible, self.y
        if feasible is None or at is None:
            raise ValueError("The descent has no set yet: call `within` first.")
        gradient, hessian = f_info.grad, f_info.hessian.as_matrix()
        tiny = jnp.finfo(y.dtype).tiny
        model = regularised(convex_part(hessian) if self.secant else hessian)
        length = jnp.sum(gradient**2) / (gradient @ model @ gradient + tiny)
        cauchy = (feasible.project(at - length * gradient.reshape(at.shape)) - at).ravel()
        # the projection bends the ray: along the chord the model may have its minimum before the end
        slope, curvature = jnp.sum(gradient * cauchy), cauchy @ model @ cauchy
        cauchy = cauchy * jnp.clip(-slope / (curvature + tiny), 0.0, 1.0)
        return LegsState(cauchy, minimise_quadratic(model, gradient, feasible, at).point - y)

    def step(self, step_size, state):
        """The point on the two legs whose distance along them is `step_size * |newton|`."""
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


class BoundedDogleg(AbstractBoundedLeastSquares):
    """A trust region around Gauss-Newton models, its steps along the dogleg inside the feasible set.

    One quadratic is minimised per linearisation, whatever happens to the trust region. A singular Jacobian does no
    harm.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    descent: BoundedDoglegDescent
    search: optx.AbstractSearch
    secant: bool = eqx.field(static=True)
    trials_per_linearisation: int = eqx.field(static=True)

    def __init__(self, rtol: float = 0.0, atol: float = 1e-8, secant: bool = True, trials_per_linearisation: int = 1):
        """Makes the solver.

        Args:
            rtol: relative tolerance on the projected gradient.
            atol: absolute tolerance on it.
            secant: whether the curvature of the residuals is learned.
            trials_per_linearisation: trial points of one step, the Jacobian being updated in between.
        """
        self.rtol, self.atol, self.norm = rtol, atol, optx.max_norm
        self.descent = BoundedDoglegDescent(secant)
        self.search = GainRatio(largest=1.0)
        self.secant = secant
        self.trials_per_linearisation = trials_per_linearisation
