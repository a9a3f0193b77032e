"""Keypoints interpolated from the grippers' motion alone: a prior for models, and a baseline."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.simulate.keypoints import hermite


def rigid_interpolation(
    gripper_pose: Float[Array, "2 3"],
    twist: Float[Array, "2 3"],
    *,
    n_keypoints: int,
    length: float,
    interval: float = 1.0,
) -> Float[Array, "N 2"]:
    """Displacement of every keypoint over one interval, interpolated from the two grippers' motion alone.

    Cubic Hermite interpolation in the arc-length fraction s of the end displacements `v dt` and of the end tangents'
    change `omega dt perp(tangent)`. It is exact at both ends, and exact everywhere if both grippers translate alike.
    Differentiable in `gripper_pose` and `twist`.

    Args:
        gripper_pose: (x, y, theta) of both grippers; theta is the direction of the cable's tangent, shape [2, 3].
        twist: (vx, vy, omega) of both grippers in the world's frame [m/s, rad/s], shape [2, 3].
        n_keypoints: N, uniform in arc length.
        length: free length of the cable [m].
        interval: duration of the step [s].
    """
    s = jnp.linspace(0.0, 1.0, n_keypoints, dtype=twist.dtype)[:, None]
    theta = gripper_pose[:, 2]
    normal = jnp.stack([-jnp.sin(theta), jnp.cos(theta)], axis=-1)
    moved = interval * twist[:, :2]
    turned = length * interval * twist[:, 2:] * normal
    return hermite(s, moved, turned)
