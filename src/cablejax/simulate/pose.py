"""Gripper poses: (x, y, theta) in the plane, (x, y, z, qw, qx, qy, qz) in space, and how twists move them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.arrays import quaternion_product


def integrate_pose(pose: Float[Array, "Q P"], twist: Float[Array, "Q V"], duration: float) -> Float[Array, "Q P"]:
    """The pose after a constant twist, in the world's frame, of given duration [s]. Differentiable throughout."""
    if pose.shape[-1] == 3:
        return pose + duration * twist
    position = pose[..., :3] + duration * twist[..., :3]
    turn = quaternion_of(duration * twist[..., 3:])
    return jnp.concatenate([position, quaternion_product(turn, pose[..., 3:])], axis=-1)


def pose_velocity(pose: Float[Array, "Q P"], target: Float[Array, "Q P"], duration: float) -> Float[Array, "Q V"]:
    """The constant twist that carries `pose` to `target` within `duration` [m/s, rad/s].

    In space the rotation is taken as `2 vec(q_target q^-1)`, exact to third order in the angle of one time step.
    """
    if pose.shape[-1] == 3:
        return (target - pose) / duration
    conjugate = pose[..., 3:] * jnp.array([1.0, -1.0, -1.0, -1.0], pose.dtype)
    difference = quaternion_product(target[..., 3:], conjugate)
    rotation = 2.0 * difference[..., 1:] * jnp.sign(difference[..., :1])
    return jnp.concatenate([target[..., :3] - pose[..., :3], rotation], axis=-1) / duration


def quaternion_of(rotation: Float[Array, "*B 3"]) -> Float[Array, "*B 4"]:
    """Unit quaternion of a rotation vector [rad], differentiable at zero too."""
    squared = jnp.sum((0.5 * rotation) ** 2, axis=-1, keepdims=True)
    small = squared < 1e-8
    half = jnp.sqrt(jnp.where(small, 1.0, squared))
    sinc = jnp.where(small, 1 - squared / 6 + squared**2 / 120, jnp.sin(half) / half)
    cosine = jnp.where(small, 1 - squared / 2 + squared**2 / 24, jnp.cos(half))
    return jax.lax.concatenate([cosine, sinc * 0.5 * rotation], cosine.ndim - 1)


def points_in_space(points: Float[np.ndarray, "*B D"]) -> Float[np.ndarray, "*B 3"]:
    """Points of the plane as points in space with z = 0; those in space as they are. NumPy."""
    return np.pad(points, [(0, 0)] * (points.ndim - 1) + [(0, 3 - points.shape[-1])])


def pose_in_space(pose: Float[np.ndarray, "*B P"]) -> Float[np.ndarray, "*B 7"]:
    """Poses (x, y, theta) as (x, y, 0, qw, 0, 0, qz); those in space as they are. NumPy."""
    if pose.shape[-1] == 7:
        return pose
    half, none = 0.5 * pose[..., 2:], np.zeros_like(pose[..., 2:])
    return np.concatenate([pose[..., :2], none, np.cos(half), none, none, np.sin(half)], axis=-1)
