"""The pytrees that travel between the stages of the pipeline.

Every class here is a frozen dataclass. Those that hold JAX arrays are registered as pytrees, so they pass through
`jit`, `vmap`, `grad` and `scan` unchanged. Shapes are written as `[E, T, N, D]`, with these letters throughout the
package:

    B batch   E episodes   T time samples   H history length   N keypoints   Q grippers   J bending joints   D 2 or 3

SI units, radians, right-handed frames. A gripper's pose in the plane is (x, y, theta), its twist (vx, vy, omega), both
in the world's frame. Arrays may carry leading batch axes wherever a function is vmapped.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.cable import GRAVITY, Cable


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class CableMemory:
    """Internal state of a cable beyond positions and velocities, in simulators with effects of extension and memory.

    Attributes:
        stretch: relative change of the free length, shape [].
        stretch_rate: its velocity [1/s], shape [].
        set_curvature: permanent part of the curvature of each joint [1/m], shape [J].
        friction_state: internal friction of each joint, -1 to 1, shape [J].
        time: since the initial state [s], shape [].
    """

    stretch: Float[Array, "*batch"]
    stretch_rate: Float[Array, "*batch"]
    set_curvature: Float[Array, "*batch J"]
    friction_state: Float[Array, "*batch J"]
    time: Float[Array, "*batch"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class CableState:
    """Full state of a simulated cable.

    Attributes:
        qpos: generalised positions, shape [nq].
        qvel: generalised velocities, shape [nv].
        gripper_pose: (x, y, theta) of each gripper, shape [Q, 3]; in space (x, y, z, qw, qx, qy, qz), shape [Q, 7].
        memory: what the cable remembers beyond that; None = nothing.
    """

    qpos: Float[Array, "*batch nq"]
    qvel: Float[Array, "*batch nv"]
    gripper_pose: Float[Array, "*batch Q P"]
    memory: CableMemory | None = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Trajectory:
    """Result of a rollout: T commands and the T + 1 samples around them.

    Attributes:
        keypoints: keypoint positions [m], shape [T + 1, N, D]; sample 0 is the initial state.
        gripper_pose: gripper poses at the same instants, shape [T + 1, Q, 3] or [T + 1, Q, 7].
        gripper_twist: twist held from sample t to t + 1 [m/s, rad/s], shape [T, Q, 3] or [T, Q, 6].
        cable: what is known of the cable, see `cable_descriptor`, shape [2]; None = not recorded.
    """

    keypoints: Float[Array, "*batch T1 N D"]
    gripper_pose: Float[Array, "*batch T1 Q P"]
    gripper_twist: Float[Array, "*batch T Q V"]
    cable: Float[Array, "*batch 2"] | None = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class History:
    """Input of a one-step model of the cable: the last H samples, oldest first.

    Attributes:
        keypoints: positions [m] at t - m, ..., t, shape [H, N, 2] with H = m + 1.
        gripper_pose: (x, y, theta) of both grippers at t, shape [Q, 3].
        cable: what is known of the cable, see `cable_descriptor`, shape [2]; None for a model that does not ask.
    """

    keypoints: Float[Array, "*batch H N 2"]
    gripper_pose: Float[Array, "*batch Q 3"]
    cable: Float[Array, "*batch 2"] | None = None


class Measurement(NamedTuple):
    """Input of a controller at each of its steps.

    Attributes:
        keypoints: observed now [m], NaN = not observed, shape [N, 2].
        gripper_pose: (x, y, theta) of both grippers [m, rad], NaN = not measured, shape [Q, 3].
        twist: that was commanded since the last step [m/s, rad/s], shape [Q, 3]: what limits beyond the controller left
            of its own; None = its own.
    """

    keypoints: Float[Array | np.ndarray, "*batch N 2"]
    gripper_pose: Float[Array | np.ndarray, "*batch Q 3"]
    twist: Float[Array | np.ndarray, "*batch Q 3"] | None = None


ROTATION_WEIGHT = 0.15
"""Metres that one radian of a gripper of a cable of 1 m counts for where motions are compared or added up [m/rad]."""
REFERENCE_STIFFNESS = Cable.bending_stiffness
"""EI of the reference cable [N m^2]."""
REFERENCE_FRICTION = Cable.friction_coefficient * Cable.linear_density * GRAVITY
"""Friction force per length of the reference cable on its table, `mu w` [N/m]."""


def cable_descriptor(
    stiffness: Float[Array | np.ndarray, "*batch"], friction: Float[Array | np.ndarray, "*batch"]
) -> Float[Array | np.ndarray, "*batch 2"]:
    """`[ln(EI / EI_0), ln(mu w / (mu w)_0)]`: what decides a uniform cable's slow motion on a table; 0 = reference.

    Friction below a thousandth of the reference's counts as that. NumPy in, NumPy out; JAX in, JAX out.

    Args:
        stiffness: EI [N m^2].
        friction: friction force per length `mu w` [N/m].
    """
    xp = stiffness.__array_namespace__()
    friction = xp.maximum(friction, 1e-3 * REFERENCE_FRICTION)
    return xp.stack([xp.log(stiffness / REFERENCE_STIFFNESS), xp.log(friction / REFERENCE_FRICTION)], axis=-1)


def advance(
    history: History, displacement: Float[Array, "N 2"], twist: Float[Array, "Q 3"], interval: float = 1.0
) -> History:
    """The history one control interval later. Differentiable in every argument.

    Args:
        history: the last H samples.
        displacement: `X(t + 1) - X(t)` [m], shape [N, 2].
        twist: the command held over the interval [m/s, rad/s], shape [Q, 3].
        interval: its duration [s].
    """
    newest = history.keypoints[-1] + displacement
    return History(
        keypoints=jnp.concatenate([history.keypoints[1:], newest[None]]),
        gripper_pose=history.gripper_pose + interval * twist,
        cable=history.cable,
    )


@dataclasses.dataclass(frozen=True)
class GapLog:
    """A recorded cable run in memory: the arrays of the `cablejax-gap-log/1` format, unchanged, as NumPy arrays.

    Attributes:
        time: seconds from each episode's start, float64, shape [E, T].
        keypoints: observed positions [m], NaN = not observed, float32, shape [E, T, N, D].
        gripper_pose: measured poses, float32, shape [E, T, Q, 3 or 7].
        gripper_command: commanded twist held from `time[t]` to `time[t + 1]`, float32, shape [E, T, Q, 3 or 6].
        episode_length: valid samples of each episode, int32, shape [E].
        meta: the JSON object of the format, with key "schema".
        hold: true where grippers rest and the cable has settled, bool, shape [E, T], or None.
    """

    time: np.ndarray
    keypoints: np.ndarray
    gripper_pose: np.ndarray
    gripper_command: np.ndarray
    episode_length: np.ndarray
    meta: dict[str, Any]
    hold: np.ndarray | None = None

    @property
    def in_space(self) -> bool:
        """Whether the keypoints have three coordinates; otherwise the cable lies on a table."""
        return self.keypoints.shape[-1] == 3

    @property
    def valid(self) -> np.ndarray:
        """Which samples are no padding, shape [E, T]."""
        return np.arange(self.time.shape[1]) < self.episode_length[:, None]

    @property
    def intervals(self) -> np.ndarray:
        """Times between neighbouring samples of all episodes, in order [s], shape [S]."""
        return np.diff(self.time, axis=1)[self.valid[:, 1:]]

    @property
    def rate(self) -> str:
        """Usual samples a second: "100", or "29.97 to 60" where episodes differ; "" if each has only one sample."""
        rates = [
            1 / np.median(np.diff(one[:n])) for one, n in zip(self.time, self.episode_length, strict=True) if n > 1
        ]
        return " to ".join(dict.fromkeys(f"{end(rates):.4g}" for end in (min, max) if rates))
