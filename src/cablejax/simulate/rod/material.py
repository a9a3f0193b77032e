"""The material frame of a cable in space: how it turns with the centreline, and how twist spreads.

A torsional wave runs along a thin cable in milliseconds, so twist is always in equilibrium with what bends the cable:

    minimise over the turns theta_j:   1/2 sum_i G (psi_i + theta_i - theta_{i-1})^2 / h - sum_i B/h (D2 x)_i .
    k_i(theta),

with psi the twist between neighbouring edges, G = GJ/rho and k the rest curvature as a vector in the world (Bergou et
al., Discrete elastic rods, 2008). A cable that is straight at rest feels its roll through the total twist only; without
torsional stiffness not at all.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.simulate.rod.physics import RodPhysics


def unit(x: Float[Array, "*B 3"]) -> Float[Array, "*B 3"]:
    """Vectors scaled to length one. Not finite at zero."""
    return x / jnp.sqrt(jnp.sum(x**2, axis=-1, keepdims=True))


def transport(u: Float[Array, "*B 3"], before: Float[Array, "*B 3"], after: Float[Array, "*B 3"]):
    """A vector turned by the smallest rotation that takes one unit vector to another (not to its opposite)."""
    axis = jnp.cross(before, after)
    cosine = jnp.sum(before * after, axis=-1, keepdims=True)
    along = jnp.sum(axis * u, axis=-1, keepdims=True)
    return cosine * u + jnp.cross(axis, u) + axis * along / jnp.maximum(1.0 + cosine, 1e-3)


def spin_of_joints(
    edges: Float[Array, "m 3"],
    rate: Float[Array, "m 3"],
    roll_rate: Float[Array, "2"],
) -> Float[Array, "m1 3"]:
    """Angular velocity of the material at every joint, the mean of both edges' [rad/s].

    An edge's motion shows how it turns, except about itself. There it turns as its neighbours do, for twist spreads at
    once: just enough for the twist to grow equally at all joints.

    Args:
        edges: between neighbouring nodes [m].
        rate: of change of `edges` [m/s].
        roll_rate: of the first and the last edge about themselves [rad/s].
    """
    length, tangents, curvature = _binormals(edges)
    rate = rate / length
    # of the edge after each joint against that before it, where their twist stays as it is
    step = -0.5 * jnp.sum(curvature * (rate[1:] + rate[:-1]), axis=1)
    about = np.linspace([1.0, 0.0], [0.0, 1.0], len(edges)) @ roll_rate + _evened(len(edges)) @ step
    spin = jnp.cross(tangents, rate) + about[:, None] * tangents
    return 0.5 * (spin[1:] + spin[:-1])


def forces_of_torques(edges: Float[Array, "m 3"], torque: Float[Array, "m1 3"]) -> Float[Array, "m 3"]:
    """On the edges, of torques at the joints: the transpose of `spin_of_joints` in `rate`, so that power is the same.

    Args:
        edges: between neighbouring nodes [m].
        torque: at every joint.
    """
    length, tangents, curvature = _binormals(edges)
    torque = _shared(torque)
    bent = curvature * (_evened(len(edges)).T @ jnp.sum(torque * tangents, axis=1))[:, None]
    return (jnp.cross(torque, tangents) - _shared(bent)) / length


def _shared(joints: Float[Array, "m1 3"]) -> Float[Array, "m 3"]:
    """Half of what acts at each joint for either of its edges."""
    zero = jnp.zeros_like(joints[:1])
    return 0.5 * (jnp.concatenate([zero, joints]) + jnp.concatenate([joints, zero]))


def _binormals(edges: Float[Array, "m 3"]) -> tuple[Float[Array, "m 1"], Float[Array, "m 3"], Float[Array, "m1 3"]]:
    """Lengths of the edges, their directions, and the curvature binormals at the joints (Bergou et al.)."""
    length = jnp.sqrt(jnp.sum(edges**2, axis=1, keepdims=True))
    tangents = edges / length
    before, after = tangents[:-1], tangents[1:]
    # edges that turn by more than 120 degrees do not resolve the fold, and the binormal would have no bound
    bound = jnp.maximum(1.0 + jnp.sum(before * after, axis=1, keepdims=True), 0.5)
    return length, tangents, 2.0 * jnp.cross(before, after) / bound


def _evened(count: int) -> Float[np.ndarray, "m m1"]:
    """How steps from edge to edge add up from the first edge on, less as much from each as takes the last one to 0."""
    return np.tri(count, count - 1, -1) - np.linspace(0.0, 1.0, count)[:, None]


def twist(tangents: Float[Array, "m 3"], directors: Float[Array, "m 3"]) -> Float[Array, "m1"]:
    """Angle of each director against that of the edge before it [rad]."""
    before = transport(directors[:-1], tangents[:-1], tangents[1:])
    sine = jnp.sum(jnp.cross(before, directors[1:]) * tangents[1:], axis=1)
    return jnp.arctan2(sine, jnp.sum(before * directors[1:], axis=1))


def turned(directors: Float[Array, "m 3"], tangents: Float[Array, "m 3"], angle: Float[Array, "m"]):
    """Directors turned about their edges."""
    return unit(jnp.cos(angle)[:, None] * directors + jnp.sin(angle)[:, None] * jnp.cross(tangents, directors))


def joint_frames(tangents: Float[Array, "m 3"], directors: Float[Array, "m 3"]):
    """Second and third axis of the material between neighbouring edges, both of shape [m - 1, 3]."""
    along = unit(tangents[:-1] + tangents[1:])
    second = directors[:-1] + directors[1:]
    second = unit(second - along * jnp.sum(second * along, axis=1, keepdims=True))
    return second, jnp.cross(along, second)


def twist_matrix(
    physics: RodPhysics, curve: Float[Array, "J 2"], h: Float[Array | np.ndarray, ""], n: int
) -> Float[Array, "e e"]:
    """Inverse of the stiffness of the turns against each other and against the rest curvature."""
    d = np.eye(n - 2, n - 1, 1) - np.eye(n - 2, n - 1)
    d = jnp.asarray(d[:, 1:-1])
    # no bend is sharper than this against the rest curvature for long: an upper bound makes the relaxation stable
    bound = jnp.sqrt(jnp.sum(curve**2, axis=1) + 1e-6) * 10.0 * jnp.mean(physics.stiffness)
    return jnp.linalg.inv(physics.twist_stiffness / h**2 * d.T @ d + jnp.diag(0.5 * (bound[:-1] + bound[1:])))
