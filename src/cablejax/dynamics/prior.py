"""What a short physical calculation expects of the cable: the displacement that the network corrects.

The cable is taken for an inextensible elastica whose friction forces stay as they are during the step. With the
keypoints' polygon x before and y after the step, its curvature b(y, theta) (second differences, end tangents theta
given by the grippers) and its chord lengths c(y), the step solves

    b'(y)^T b(y, theta') + c'(y)^T lambda = f,        c(y) = c(x),        y at the ends prescribed,

where the friction force f = b'(x)^T b(x, theta) + c'(x)^T lambda_0 is what the shape before the step left unbalanced at
the tensions lambda_0 that explain most of it. A few Newton steps with the bending stiffness as the only curvature of
the Lagrangian are enough; each solves for one tension per chord. The stiffness EI cancels.

What is left for the network is what this leaves out: friction that slips, damping, inertia, snap-through.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

RELATIVE_COMPLIANCE = 1e-4
"""Stretch compliance of a chord relative to its mean bending compliance. A straight cable's length cannot respond to
bending, only to stretching: this keeps the tensions finite there."""


@functools.lru_cache(maxsize=32)
def bending_operator(n_keypoints: int, length: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Matrices of the discrete bending energy `h / 2 |B y - s(theta)|^2`. Not to be modified: cached.

    Returns:
        B, shape [N, N]: rows are curvature vectors at the keypoints; the two at the ends, where half a spacing h
            bends, are weighted by sqrt(1/2) and compare the first and last chord with the gripper's tangent.
        A, shape [N - 2, N - 2]: inverse of `h B^T B` on the free keypoints.
        weight: of the tangents in s, so that `s[0] = weight t_0` and `s[-1] = -weight t_1`.
    """
    n, h = n_keypoints, length / (n_keypoints - 1)
    b = np.zeros((n, n))
    for i in range(1, n - 1):
        b[i, i - 1 : i + 2] = np.array([1.0, -2.0, 1.0]) / h**2
    weight = np.sqrt(0.5) * 2.0 / h
    b[0, :2] = np.array([-1.0, 1.0]) * weight / h
    b[-1, -2:] = np.array([1.0, -1.0]) * weight / h
    return b, np.linalg.inv(h * (b.T @ b)[1:-1, 1:-1]), weight


def elastic_step(
    keypoints: Float[Array, "N 2"],
    gripper_pose: Float[Array, "2 3"],
    twist: Float[Array, "2 3"],
    *,
    length: float,
    interval: float = 1.0,
    iterations: int = 3,
) -> Float[Array, "N 2"]:
    """Displacement [m] of an inextensible elastic cable under locked friction, see the top of this file.

    Zero for grippers at rest. Exact at both ends. Turns with the cable. Differentiable in all three arrays.

    Args:
        keypoints: positions before the step [m], shape [N, 2].
        gripper_pose: (x, y, theta) of both grippers before the step; theta is the direction of the cable's tangent.
        twist: (vx, vy, omega) of both grippers in the world's frame [m/s, rad/s].
        length: free length of the cable [m].
        interval: duration of the step [s].
        iterations: Newton steps.
    """
    n, dtype = keypoints.shape[0], keypoints.dtype
    bending, compliance, weight = bending_operator(n, length)
    operator = jnp.asarray(bending, dtype)
    transposed = jnp.asarray(bending.T * length / (n - 1), dtype)
    compliance = jnp.asarray(compliance, dtype)
    padded = jnp.pad(compliance, 1)
    # How much chord k shortens in direction j when chord j pulls: bending compliance between neighbouring differences.
    between = padded[1:, 1:] - padded[1:, :-1] - padded[:-1, 1:] + padded[:-1, :-1]

    def bending_force(y, theta):
        tangent = jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=-1) * weight
        ends = jnp.zeros((n, 2), dtype).at[0].set(tangent[0]).at[-1].set(-tangent[1])
        return (transposed @ (operator @ y - ends))[1:-1]

    def chords(y):
        d = jnp.diff(y, axis=0)
        c = jnp.sqrt(jnp.sum(d**2, axis=-1) + 1e-18)
        return c, d / c[:, None]

    def tension_force(direction, tension):
        pull = tension[:, None] * direction
        return pull[:-1] - pull[1:]

    def stretch(direction, free):
        return jnp.sum(direction * jnp.diff(jnp.pad(free, ((1, 1), (0, 0))), axis=0), axis=-1)

    def solve_tension(direction, force, excess, before):
        """Tensions at which the bent cable, loaded by `force`, loses the `excess` of its chords."""
        system = (direction @ direction.T) * between
        soft = RELATIVE_COMPLIANCE * jnp.trace(system) / (n - 1)
        right = excess - stretch(direction, compliance @ force) + soft * before
        factor = jax.scipy.linalg.cho_factor(system + soft * jnp.eye(n - 1, dtype=dtype))
        return jax.scipy.linalg.cho_solve(factor, right)

    theta, turned = gripper_pose[:, 2], gripper_pose[:, 2] + interval * twist[:, 2]
    rest, direction = chords(keypoints)
    force = bending_force(keypoints, theta)
    none = jnp.zeros(n - 1, dtype)
    tension = solve_tension(direction, force, none, none)
    friction = force + tension_force(direction, tension)

    moved = interval * twist[:, :2]
    y = keypoints.at[0].add(moved[0]).at[-1].add(moved[1])
    # First guess: the stretchable cable's answer.
    y = y.at[1:-1].add(-compliance @ (bending_force(y, turned) - force))
    for _ in range(iterations):
        length_now, direction = chords(y)
        unbalanced = bending_force(y, turned) - friction
        tension = solve_tension(direction, unbalanced, length_now - rest, tension)
        y = y.at[1:-1].add(-compliance @ (unbalanced + tension_force(direction, tension)))
    return y - keypoints
