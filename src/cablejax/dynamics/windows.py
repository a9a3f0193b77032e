"""Training windows: short pieces of trajectories, drawn and augmented by a counter-based generator.

The draw depends on `(seed, step)` alone, so a training that was killed and resumed sees what it would have seen.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cablejax.dynamics.config import GNSConfig, Normalisation
from cablejax.dynamics.graph import prior_of
from cablejax.types import History, Trajectory

GRASP_TOLERANCE = 2e-2
"""Largest distance of an end keypoint from its gripper [m] that is taken for a grasp: cables that snap through pull."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Window:
    """A history and what followed it.

    Attributes:
        history: the H samples up to t.
        twist: commands held from t on, shape [K, 2, 3].
        future: keypoints [m] at t + 1, ..., t + K, shape [K, N, 2].
    """

    history: History
    twist: Float[Array, "*batch K 2 3"]
    future: Float[Array, "*batch K N 2"]


def window_at(trajectory: Trajectory, start: Array, *, history: int, steps: int) -> Window:
    """The window whose newest history sample is sample `start` of an unbatched trajectory.

    Before the trajectory's beginning the cable rested, so missing history repeats sample 0.
    """
    past = jnp.maximum(start - history + 1 + jnp.arange(history), 0)
    return Window(
        history=History(keypoints=trajectory.keypoints[past], gripper_pose=trajectory.gripper_pose[start]),
        twist=jax.lax.dynamic_slice_in_dim(trajectory.gripper_twist, start, steps),
        future=jax.lax.dynamic_slice_in_dim(trajectory.keypoints, start + 1, steps),
    )


def draw_windows(key: PRNGKeyArray, data: Trajectory, *, batch: int, history: int, steps: int) -> Window:
    """`batch` windows, uniform over trajectories [M, T, ...] and starts, mirrored and reversed at random."""
    m, t = data.gripper_twist.shape[:2]
    key_episode, key_start, key_mirror, key_reverse = jax.random.split(key, 4)
    episode = jax.random.randint(key_episode, (batch,), 0, m)
    start = jax.random.randint(key_start, (batch,), 0, t - steps + 1)
    flip = jax.random.bernoulli(key_mirror, shape=(batch,))
    swap = jax.random.bernoulli(key_reverse, shape=(batch,))

    def one(episode, start, flip, swap):
        trajectory = jax.tree.map(lambda x: x[episode], data)
        window = window_at(trajectory, start, history=history, steps=steps)
        window = jax.tree.map(lambda a, b: jnp.where(flip, a, b), mirrored(window), window)
        return jax.tree.map(lambda a, b: jnp.where(swap, a, b), reversed_ends(window), window)

    return jax.vmap(one)(episode, start, flip, swap)


def mirrored(window: Window) -> Window:
    """The same motion seen in a mirror, y -> -y: as likely as the original for a uniform straight cable."""
    point, pose = jnp.array([1.0, -1.0]), jnp.array([1.0, -1.0, -1.0])
    return Window(
        history=History(
            keypoints=(window.history.keypoints * point).astype(window.history.keypoints.dtype),
            gripper_pose=(window.history.gripper_pose * pose).astype(window.history.gripper_pose.dtype),
        ),
        twist=(window.twist * pose).astype(window.twist.dtype),
        future=(window.future * point).astype(window.future.dtype),
    )


def reversed_ends(window: Window) -> Window:
    """The same motion with the cable counted from its other end: the tangent, and so theta, turns by pi."""
    turn = jnp.asarray([0.0, 0.0, jnp.pi], window.history.gripper_pose.dtype)
    return Window(
        history=History(
            keypoints=window.history.keypoints[..., ::-1, :],
            gripper_pose=window.history.gripper_pose[..., ::-1, :] + turn,
        ),
        twist=window.twist[..., ::-1, :],
        future=window.future[..., ::-1, :],
    )


def check_trajectories(data: Trajectory, config: GNSConfig, *, steps: int, what: str) -> None:
    """Raises ValueError unless `data` are float arrays [M, T + 1, N, 2], [M, T + 1, 2, 3], [M, T, 2, 3], all finite,
    for this configuration, with ends on the grippers and at least `steps` commands."""
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
    for field in dataclasses.fields(data):
        bad = ~np.isfinite(np.asarray(getattr(data, field.name))).all(axis=(1, 2, 3))
        if bad.any():
            raise ValueError(
                f"{what}.{field.name} holds NaN or infinity in {bad.sum()} of {m} trajectories (first: number "
                f"{int(np.argmax(bad))}). Drop or regenerate them."
            )
    gap = np.abs(np.asarray(data.keypoints)[:, :, [0, -1]] - np.asarray(data.gripper_pose)[..., :2]).max()
    if gap > GRASP_TOLERANCE:
        raise ValueError(
            f"{what}: an end keypoint is {gap:.3g} m away from its gripper, expected to coincide. "
            "Keypoint 0 belongs to gripper 0 and the last to gripper 1."
        )


def fit_normalisation(data: Trajectory, config: GNSConfig) -> Normalisation:
    """Root mean squares of features and targets over trajectories [M, T, ...], see `Normalisation`.

    The residual's leaves out the 5 % of steps with the largest."""
    x = np.asarray(data.keypoints, np.float64)
    pose, twist = np.asarray(data.gripper_pose, np.float64), np.asarray(data.gripper_twist, np.float64)
    moved = np.diff(x, axis=1)

    @jax.jit
    @jax.vmap
    def expected(keypoints, gripper_pose, twist):
        one = jax.vmap(lambda k, p, u: prior_of(History(k[None], p), u, config).displacement)
        return one(keypoints[:-1], gripper_pose[:-1], twist)

    arrays = (jnp.asarray(leaf, jnp.float32) for leaf in (data.keypoints, data.gripper_pose, data.gripper_twist))
    beyond = np.mean((moved - np.asarray(expected(*arrays), np.float64))[:, :, 1:-1] ** 2, axis=(2, 3))
    # The few steps in which a cable snaps through would set the scale alone.
    usual = np.sort(beyond.ravel())[: max(1, int(0.95 * beyond.size))]
    middle = pose[..., :2].mean(axis=2, keepdims=True)
    shorter = config.spacing - np.linalg.norm(np.diff(x, axis=2), axis=-1)

    def rms(values: np.ndarray, least: float) -> float:
        """Rounded, so that it reads well in a configuration; floored, so that motionless data do not divide by zero."""
        return float(f"{max(np.sqrt(np.mean(values**2)), least):.4g}")

    return Normalisation(
        position=rms(x - middle, 1e-3),
        displacement=rms(moved, 1e-5),
        linear_speed=rms(twist[..., :2], 1e-5),
        angular_speed=rms(twist[..., 2], 1e-4),
        shortening=rms(shorter, 1e-5),
        residual=rms(np.sqrt(usual), 1e-6),
    )
