"""Secant updates of the whole Hessian, or of the part that a Gauss-Newton model leaves out."""

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


def positive_update(
    hessian: Float[Array, "P P"], moved: Float[Array, " P"], bent: Float[Array, " P"]
) -> Float[Array, "P P"]:
    """The formula of Broyden, Fletcher, Goldfarb and Shanno, kept positive semi-definite.

    Where the curvature met is less than a fifth of the model's, the model's is cut to a fifth along the move, and no
    more is learned: Powell's damping (Lect. Notes Math. 630, 1978) would, of a negative curvature, learn ever greater
    ones elsewhere. At a curved bound that is the usual case: there the function need not be convex at its minimum.

    Args:
        hessian: B, positive semi-definite.
        moved: s, from one point to another.
        bent: y, by how much the gradient differs there.
    """
    expected, curved = hessian @ moved, moved @ bent
    model = moved @ expected
    # a direction that the matrix does not see, but for rounding
    seen = model > 16 * jnp.finfo(moved.dtype).eps * jnp.linalg.norm(moved) * jnp.linalg.norm(expected)
    model, expected = jnp.where(seen, model, 0.0), jnp.where(seen, expected, 0.0)
    convex = (curved >= 0.2 * model) & (curved > jnp.finfo(moved.dtype).tiny)
    learned = jnp.outer(bent, bent) / jnp.where(convex, curved, 1.0)
    lost = jnp.outer(expected, expected) / jnp.where(seen, model, 1.0)
    updated = hessian + jnp.where(convex, learned - lost, -0.8 * lost)
    telling = jnp.isfinite(bent).all() & jnp.isfinite(updated).all()
    # rounding takes the lowest eigenvalues of a nearly singular matrix below zero, where they would stay
    return jnp.where(telling, convex_part(updated), hessian)


def sized(hessian: Float[Array, "P P"], moved: Float[Array, " P"], bent: Float[Array, " P"]) -> Float[Array, "P P"]:
    """The multiple of the identity with the curvature `y'y / s'y` that was met, or the matrix where there was none.

    Nocedal and Wright, Numerical Optimization, equation 6.20.
    """
    curved = moved @ bent
    telling = curved > 1e-8 * jnp.linalg.norm(moved) * jnp.linalg.norm(bent)
    size = jnp.sum(bent**2) / jnp.where(telling, curved, 1.0)
    return jnp.where(telling, size * jnp.eye(len(moved), dtype=moved.dtype), hessian)


def convex_part(hessian: Float[Array, "P P"]) -> Float[Array, "P P"]:
    """The matrix without its negative eigenvalues, those of the matrix scaled to a unit diagonal."""
    diagonal = jnp.abs(jnp.diag(hessian))
    floor = jnp.finfo(diagonal.dtype).eps * diagonal.max() + jnp.finfo(diagonal.dtype).tiny
    unit = jnp.sqrt(jnp.maximum(diagonal, floor))
    eigenvalues, basis = jnp.linalg.eigh(hessian / jnp.outer(unit, unit))
    root = unit[:, None] * basis
    return (root * jnp.maximum(eigenvalues, 0.0)) @ root.T
