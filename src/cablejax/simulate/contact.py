"""Contact of the cable with a round obstacle: a smooth linear spring along the obstacle's normal, without friction."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.effects.physics import Physics

# Stiffness of a contact of one link's length [N/m]: a cable of 0.1 N presses 0.1 mm into an obstacle.
_STIFFNESS = 1000.0
_POINTS = 4
# Over which the onset of a contact is smoothed [m].
_EDGE = 0.0005


def obstacle_contact(
    physics: Physics, nodes: Float[Array, "n 2"], slope: Float[Array, "n 2"]
) -> tuple[Float[Array, "n 2"], Float[Array, "n 3"]]:
    """Forces of the obstacle on the nodes [N] and their stiffness (xx, xy, yy) [N/m].

    The obstacle is narrower than a link is long, so the cable touches it by points between the nodes too, on the
    cubic through nodes and tangents; what acts on them is shared by the two nodes next to them.

    Args:
        physics: with the obstacle.
        nodes: positions [m].
        slope: derivative of the position over one link length [m].
    """
    force, stiffness = jnp.zeros_like(nodes), jnp.zeros((nodes.shape[0], 3), nodes.dtype)
    a, b, da, db = nodes[:-1], nodes[1:], slope[:-1], slope[1:]
    for i in range(_POINTS):
        t = i / _POINTS
        point = (1 - 3 * t**2 + 2 * t**3) * a + (3 * t**2 - 2 * t**3) * b
        point = point + (t - 2 * t**2 + t**3) * da + (t**3 - t**2) * db
        away = point - physics.obstacle_centre
        distance = length(away)
        normal = away / distance[:, None]
        depth = physics.obstacle_radius - distance
        # a smooth ramp: nothing at all half a millimetre off
        overlap = jnp.clip(depth + _EDGE, 0.0)
        pressing = jnp.where(depth < _EDGE, overlap**2 / (4 * _EDGE), depth)
        rigidity = _STIFFNESS / _POINTS * jnp.clip(overlap / (2 * _EDGE), 0.0, 1.0)
        push = (_STIFFNESS / _POINTS * pressing)[:, None] * normal
        tensor = rigidity[:, None] * jnp.stack(
            [normal[:, 0] ** 2, normal[:, 0] * normal[:, 1], normal[:, 1] ** 2], axis=1
        )
        for end, share in ((slice(None, -1), 1 - t), (slice(1, None), t)):
            force = force.at[end].add(share * push)
            stiffness = stiffness.at[end].add(share * tensor)
    return force, stiffness


def length(x: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Euclidean norm with a derivative at zero."""
    return jnp.sqrt(jnp.sum(x**2, axis=-1) + 1e-12)
