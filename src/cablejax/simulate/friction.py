"""Forces of the table: Coulomb friction regularised at low speed, its variations over the table, and viscous drag.

    f = -mu w v / sqrt(|v|^2 + v0^2)

with w the weight carried by a link. An explicit step is stable only for `mu g dt / v0 < 2`, far too loose a
regularisation for a cable that must not creep while it is held. Instead the coefficient `c = mu w / sqrt(|v|^2 + v0^2)`
is taken at the start of the step and the velocity at its end: `f = -c (v + dt a)`, stable at any step.

Grippers that hold the ends a little above the table carry a part of the weight. An end that is held level at height d
sags as a beam and touches the table, without a bend there, after a length

    lambda = (72 EI d / w)^(1/4),      w = rho g,

where the table carries `w lambda / 3` at one point; the rest of that length's weight hangs on the gripper. A tenth of a
millimetre of height lifts a decimetre of the reference cable.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.effects.physics import Physics, normal_gravity
from cablejax.simulate.contact import length

PATCH_EDGE = 0.005
"""Over which the edge of a friction patch is smoothed [m]."""
STRIBECK_SPEED = 0.004
"""Speed at which sliding has taken away most of the static excess [m/s]."""


def drag_coefficient(
    physics: Physics,
    position: Float[Array, "n 2"],
    velocity: Float[Array, "n 2"],
    mass: Float[Array, "n"],
    link_length: float,
    speed: float,
) -> Float[Array, "n"]:
    """Force over velocity of the table on each link [N s/m]. Differentiable everywhere, at rest too.

    Args:
        physics: `friction`, `static_excess`, the patch, `drag` and gravity are used.
        position: of each link's node [m].
        velocity: of each link's node [m/s].
        mass: carried by the table at each node [kg].
        link_length: [m].
        speed: regularisation speed v0 [m/s].
    """
    patch = jax.nn.sigmoid((physics.patch_radius - length(position - physics.patch_centre)) / PATCH_EDGE)
    coefficient = physics.friction + physics.patch_friction * patch
    squared = jnp.sum(velocity**2, axis=1)
    coefficient = coefficient * (1.0 + physics.static_excess * jnp.exp(-squared / STRIBECK_SPEED**2))
    regularised = jnp.sqrt(squared + speed**2)
    return coefficient * mass * normal_gravity(physics) / regularised + physics.drag * link_length


def on_table(physics: Physics, mass: Float[Array, "n"] | Float[np.ndarray, "n"], link_length: float):
    """Mass that the table carries at each node [kg]: the node's mass, less the part that hangs on the grippers.

    Differentiable; at a height of 0 the mass stays as it is, and its derivative by the height is 0 instead of infinite.

    Args:
        physics: `grip_height`, `stiffness`, `density` and gravity are used.
        mass: of each node, both held ones included [kg]; a NumPy or JAX array.
        link_length: between two nodes [m].
    """
    nodes = mass.__array_namespace__().arange(len(mass))
    return (
        mass
        - _hanging(physics, physics.stiffness[0], nodes, link_length)
        - _hanging(physics, physics.stiffness[-1], nodes[::-1], link_length)
    )


def _hanging(physics: Physics, stiffness, nodes, link_length: float):
    """Mass that one gripper carries at each node, counted from it [kg]; negative where the cable comes down."""
    xp = nodes.__array_namespace__()
    weight = physics.density * normal_gravity(physics)
    # without weight no force is the table's; the other branch of `where` must have a derivative nevertheless
    held = (physics.grip_height > 0) & (stiffness > 0) & (weight > 0)
    weight, bending = xp.where(held, weight, 1.0), xp.where(held, stiffness, 1.0)
    span = xp.where(held, (72.0 * bending * xp.where(held, physics.grip_height, 1.0) / weight) ** 0.25, 0.0)
    # a short cable comes down in its middle
    reach = xp.minimum(span / link_length, 0.5 * (len(nodes) - 1))
    lifted = xp.clip(reach - nodes + 0.5, 0.0, xp.minimum(reach, 1.0))
    landing = xp.clip(1.0 - xp.abs(reach - nodes), 0.0, 1.0) * reach / 3.0
    return physics.density * link_length * (lifted - landing)


def implicit_drag(
    jacobian: Float[Array, "n nv 2"], coefficient: Float[Array, "n"], velocity: Float[Array, "n 2"]
) -> tuple[Float[Array, "nv nv"], Float[Array, "nv"]]:
    """Velocity derivative `J' c J` and generalised force `-J' c v` of the drag on all links."""
    weighted = jacobian * coefficient[:, None, None]
    damping = jnp.einsum("kid,kjd->ij", weighted, jacobian)
    force = -jnp.einsum("kid,kd->i", weighted, velocity)
    return damping, force
