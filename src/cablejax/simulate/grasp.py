"""Both ends held rigidly: the constrained step of the chain in closed form.

MJX's own constraint solver iterates and gives wrong derivatives. The grasps are equality constraints, so one step of
the linearly implicit Euler method has a closed form, differentiable in both modes:

    (M + dt D) a = f + J' lambda,        J (v + dt a) = v*

with M the inertia, D the velocity derivative of damping and friction, f the force at the current velocity and v* the
velocity that carries both held ends exactly to where the grippers are at the end of the step. The dual form solves 6
(planar) or 12 (spatial) rows and keeps its precision in float32.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float

# Relative regularisation of the dual matrix. A straight cable cannot change the distance of its ends to first order, so
# one row becomes void there; the regularisation lets it yield instead of dividing by zero.
_REGULARISATION = 1e-7


def constrained_acceleration(
    inertia: Float[Array, "nv nv"],
    force: Float[Array, "nv"],
    jacobian: Float[Array, "C nv"],
    acceleration: Float[Array, "C"],
    yielding: Float[Array, "C"] | float = 0.0,
) -> Float[Array, "nv"]:
    """Solves `inertia a = force + J' lambda` with `J a = acceleration - yielding lambda`. Differentiable throughout.

    Args:
        inertia: symmetric positive definite, `M + dt D`.
        force: generalised force without the grasps.
        jacobian: rows of the held ends' velocities.
        acceleration: wanted acceleration of these rows [m/s^2, rad/s^2].
        yielding: compliance of each row over dt^2; zero is a rigid grasp.
    """
    solved = solve_positive(inertia, jnp.concatenate([force[:, None], jacobian.T], axis=1))
    return solve_held(solved, jacobian, acceleration, yielding)


def solve_held(
    solved: Float[Array, "n C1"],
    rows: Float[Array, "C n"],
    wanted: Float[Array, "C"],
    yielding: Float[Array, "C"] | float = 0.0,
) -> Float[Array, "n"]:
    """The dual form: `u` with `A u = b + G' lambda` and `G u = wanted - yielding lambda`, from `A^-1 [b, G']`.

    Args:
        solved: `A^-1 b` and, in the other columns, `A^-1 G'`.
        rows: G.
        wanted: value of each row.
        yielding: diagonal that softens the rows.
    """
    free, response = solved[:, 0], solved[:, 1:]
    dual = rows @ response + jnp.diag(jnp.broadcast_to(yielding, wanted.shape))
    # a row of zeros, or of rounding, asks for nothing
    square = jnp.diagonal(dual)
    size = jnp.sqrt(jnp.where(square > jnp.finfo(dual.dtype).eps ** 1.5 * square.max(), square, 1.0))
    scaled = dual / (size[:, None] * size) + _REGULARISATION * jnp.eye(dual.shape[0], dtype=dual.dtype)
    multiplier = solve_positive(scaled, ((wanted - rows @ free) / size)[:, None])[:, 0] / size
    return free + response @ multiplier


def solve_positive(matrix: Float[Array, "n n"], rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solves `matrix x = rhs` for a symmetric positive definite matrix.

    Derivatives go through the solution, `dx = matrix^-1 (drhs - dmatrix x)`, with the factor at hand, instead of
    through the Cholesky factorisation: many times faster in reverse mode.
    """
    factor = jsl.cho_factor(jax.lax.stop_gradient(matrix), lower=True)
    return jax.lax.custom_linear_solve(lambda x: matrix @ x, rhs, lambda _, b: jsl.cho_solve(factor, b), symmetric=True)
