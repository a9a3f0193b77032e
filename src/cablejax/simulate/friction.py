"""Coulomb friction of a cable lying on a table, regularised at low speed and treated implicitly.

    f = -mu w v / sqrt(|v|^2 + v0^2)

with w the weight carried by a link. An explicit step is stable only for `mu g dt / v0 < 2`, far too loose a
regularisation for a cable that must not creep while it is held. Instead the coefficient `c = mu w / sqrt(|v|^2 + v0^2)`
is taken at the start of the step and the velocity at its end: `f = -c (v + dt a)`, stable at any step.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def drag_coefficient(
    velocity: Float[Array, "n 2"], normal_load: Float[Array, "n"], friction_coefficient: Float[Array, ""], speed: float
) -> Float[Array, "n"]:
    """`c = mu w / sqrt(|v|^2 + v0^2)` of each link [N s/m]. Differentiable everywhere, at rest too.

    Args:
        velocity: of each link's node [m/s].
        normal_load: weight carried by the table at each link [N].
        friction_coefficient: mu.
        speed: regularisation speed v0 [m/s].
    """
    return friction_coefficient * normal_load / jnp.sqrt(jnp.sum(velocity**2, axis=-1) + speed**2)


def implicit_drag(
    jacobian: Float[Array, "n nv 2"], coefficient: Float[Array, "n"], velocity: Float[Array, "n 2"]
) -> tuple[Float[Array, "nv nv"], Float[Array, "nv"]]:
    """Velocity derivative `J' c J` and generalised force `-J' c v` of the drag on all links."""
    weighted = jacobian * coefficient[:, None, None]
    damping = jnp.einsum("kid,kjd->ij", weighted, jacobian)
    force = -jnp.einsum("kid,kd->i", weighted, velocity)
    return damping, force
