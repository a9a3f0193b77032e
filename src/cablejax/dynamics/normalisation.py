"""Scales of features and outputs, measured on training data, and the validation of these data."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.dynamics.config import ModelConfig, Normalisation
from cablejax.dynamics.graph import Frame, frame_of, prior_of
from cablejax.types import History, Trajectory

GRASP_TOLERANCE = 2e-2
"""Largest distance of an end keypoint from its gripper that is taken for a grasp, in lengths of the cable: cables that
snap through pull."""

_AT_ONCE = 16
"""Trajectories of which the prior is computed together."""


def check_trajectories(data: Trajectory, config: ModelConfig, *, steps: int, what: str) -> None:
    """Checks that trajectories can train this configuration.

    Raises:
        ValueError: `data` are not finite float arrays [M, T + 1, N, 2], [M, T + 1, 2, 3] and [M, T, 2, 3], the ends are
            not on the grippers, or there are fewer than `steps` commands.
    """
    x, pose, twist = np.shape(data.keypoints), np.shape(data.gripper_pose), np.shape(data.gripper_twist)
    n = config.n_keypoints
    expected = f"keypoints [M, T+1, {n}, 2], gripper_pose [M, T+1, 2, 3], gripper_twist [M, T, 2, 3]"
    came = f"{what} has keypoints {x}, gripper_pose {pose}, gripper_twist {twist}"
    if not (len(x) == len(pose) == len(twist) == 4):
        raise ValueError(f"{came}; expected four axes each: {expected}.")
    m, t = twist[:2]
    if x != (m, t + 1, n, 2) or pose != (m, t + 1, 2, 3) or twist != (m, t, 2, 3) or m == 0:
        raise ValueError(f"{came}; expected {expected} with M > 0. Is the data of another cable or gripper count?")
    if t < steps:
        raise ValueError(
            f"{what} has {t} commands per trajectory, but {steps} are rolled out: use longer trajectories."
        )
    cable = None if data.cable is None else np.shape(data.cable)
    if config.conditioned and cable != (m, 2):
        raise ValueError(
            f"{what} has cable {cable}, but a conditioned model is trained with a descriptor of every cable: expected "
            f"({m}, 2), see `cablejax.types.cable_descriptor`."
        )
    for name in ("keypoints", "gripper_pose", "gripper_twist"):
        bad = ~np.isfinite(np.asarray(getattr(data, name))).all(axis=(1, 2, 3))
        if bad.any():
            raise ValueError(
                f"{what}.{name} holds NaN or infinity in {bad.sum()} of {m} trajectories (first: number "
                f"{int(np.argmax(bad))}). Drop or regenerate them."
            )
    gap = np.abs(np.asarray(data.keypoints)[:, :, [0, -1]] - np.asarray(data.gripper_pose)[..., :2]).max()
    if gap > GRASP_TOLERANCE * config.length:
        raise ValueError(
            f"{what}: an end keypoint is {gap:.3g} m away from its gripper, expected to coincide. "
            "Keypoint 0 belongs to gripper 0 and the last to gripper 1."
        )


def fit_normalisation(
    data: Trajectory, config: ModelConfig, frame: Callable[[Float[Array, "2 3"]], Frame] = frame_of
) -> Normalisation:
    """Root mean squares of features and targets over trajectories [M, T, ...], see `Normalisation`.

    The residual's leaves out the 5 % of steps with the largest.
    """
    x = np.asarray(data.keypoints, np.float64)
    pose, twist = np.asarray(data.gripper_pose, np.float64), np.asarray(data.gripper_twist, np.float64)
    moved = np.diff(x, axis=1)

    def expected(of):
        keypoints, gripper_pose, twist = of
        one = jax.vmap(lambda k, p, u: prior_of(History(k[None], p), u, config).displacement)
        return one(keypoints[:-1], gripper_pose[:-1], twist)

    arrays = tuple(jnp.asarray(leaf, jnp.float32) for leaf in (data.keypoints, data.gripper_pose, data.gripper_twist))
    # a step of the static prior takes a hundred times the memory of its data
    prior = jax.jit(lambda arrays: jax.lax.map(expected, arrays, batch_size=_AT_ONCE))(arrays)
    beyond = np.mean((moved - np.asarray(prior, np.float64))[:, :, 1:-1] ** 2, axis=(2, 3))
    # The few steps in which a cable snaps through would set the scale alone.
    usual = np.sort(beyond.ravel())[: max(1, int(0.95 * beyond.size))]
    origin = np.asarray(jax.vmap(jax.vmap(lambda p: frame(p).origin))(jnp.asarray(pose)), np.float64)
    shorter = config.spacing - np.linalg.norm(np.diff(x, axis=2), axis=-1)

    def rms(values: np.ndarray, least: float) -> float:
        """Rounded, so that it reads well in a configuration; floored, so that motionless data do not divide by zero."""
        return float(f"{max(np.sqrt(np.mean(values**2)), least):.4g}")

    return Normalisation(
        position=rms(x - origin[:, :, None], 1e-3),
        displacement=rms(moved, 1e-5),
        linear_speed=rms(twist[..., :2], 1e-5),
        angular_speed=rms(twist[..., 2], 1e-4),
        shortening=rms(shorter, 1e-5),
        residual=rms(np.sqrt(usual), 1e-6),
    )
