"""The curvature that a Gauss-Newton model leaves out, learned along the way."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def secant_update(
    secant: Float[Array, "P P"], moved: Float[Array, " P"], bent: Float[Array, " P"], slope: Float[Array, " P"]
) -> Float[Array, "P P"]:
    """The symmetric S nearest to the last one with `S s = y#`, after sizing it.

    Dennis, Gay, Welsch, ACM Trans. Math. Softw. 7, 1981, equations 3.3 to 3.5.

    Args:
        secant: the last S.
        moved: s, from the last point to this one.
        bent: y# = (J - J_last)' r, the change of the gradient that the residuals' curvature made.
        slope: the whole change of the gradient.
    """
    curved = jnp.sum(moved * bent)
    expected = moved @ secant @ moved
    tiny = jnp.finfo(moved.dtype).tiny
    size = jnp.minimum(jnp.abs(curved) / jnp.maximum(jnp.abs(expected), tiny), 1.0)
    sized = size * secant
    along = jnp.sum(moved * slope)
    # a slope that does not see the move says nothing
    telling = along > 1e-8 * jnp.linalg.norm(moved) * jnp.linalg.norm(slope)
    safe = jnp.where(telling, along, 1.0)
    rest = bent - sized @ moved
    correction = (jnp.outer(rest, slope) + jnp.outer(slope, rest)) / safe
    correction = correction - jnp.sum(moved * rest) * jnp.outer(slope, slope) / safe**2
    return jnp.where(telling & jnp.isfinite(correction).all(), sized + correction, secant)
