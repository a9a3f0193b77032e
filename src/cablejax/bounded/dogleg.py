"""Powell's dogleg inside a feasible set."""

from __future__ import annotations

import jax.numpy as jnp
import optimistix as optx

from cablejax.bounded.gain_ratio import GainRatio
from cablejax.bounded.gauss_newton import regularised
from cablejax.bounded.least_squares import AbstractBoundedLeastSquares, ModelDescent


class BoundedDoglegDescent(ModelDescent):
    """`step(s)` goes along two legs, to the projected Cauchy point and on to the model's minimum over the set.

    It stops at the length `s |newton|`, the trust region; s = 1 is the whole way (as in `optimistix.DoglegDescent`).
    The corners are feasible, so on a convex set the legs are. They are the state, as steps [P] from y: to the model's
    minimum along the projected gradient, and to its minimum over the set.
    """

    def init(self, y, f_info_struct):
        """The initial state: two legs of length zero."""
        del f_info_struct
        return jnp.zeros_like(y), jnp.zeros_like(y)

    def query(self, y, f_info, state):
        """Computes both legs at a new point: to the Cauchy point, and to the minimum of the model in the set."""
        del state
        feasible, at = self.feasible, self.y
        if feasible is None or at is None:
            raise ValueError("The descent has no set yet: call `within` first.")
        gradient, tiny = f_info.grad, jnp.finfo(y.dtype).tiny
        model = regularised(self.convex(f_info))
        length = jnp.sum(gradient**2) / (gradient @ model @ gradient + tiny)
        cauchy = (feasible.project(at - length * gradient.reshape(at.shape)) - at).ravel()
        # the projection bends the ray: along the chord the model may have its minimum before the end
        slope, curvature = jnp.sum(gradient * cauchy), cauchy @ model @ cauchy
        cauchy = cauchy * jnp.clip(-slope / (curvature + tiny), 0.0, 1.0)
        return cauchy, self.minimum(model, gradient)

    def step(self, step_size, state):
        """The point on the two legs whose distance along them is `step_size * |newton|`."""
        tiny, (cauchy, newton) = jnp.finfo(step_size.dtype).tiny, state
        leg = newton - cauchy
        reach = step_size * jnp.linalg.norm(newton)
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

    @property
    def descent(self) -> BoundedDoglegDescent:
        """The two legs."""
        return BoundedDoglegDescent(self.secant)

    @property
    def search(self) -> GainRatio:
        """The trust region follows the reductions, up to the whole way."""
        return GainRatio(largest=1.0)
