"""Limits of a command, independent of the controller that computed it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from cablejax.limits import check, check_workspace

_SHARES = np.linspace(0.0, 1.0, 201)
_ROUNDING, _DIGITS = 1e-12, 8.0
"""Beyond a limit by this, or by so many times the rounding of a number of one, is within."""
_CLAMPED = 0.05
"""Length of the cable, in lengths of it, along which it leaves a gripper in the gripper's direction."""


@dataclasses.dataclass(frozen=True)
class CommandLimits:
    """Bounds on both grippers while a command holds, enforced in addition to the controller's own bounds.

    Attributes:
        speed: of each gripper at most [m/s].
        turn_rate: of each gripper at most [rad/s].
        min_distance: of the grippers from each other at least, in lengths of the cable.
        max_distance: of the grippers from each other at most, in lengths of the cable; at 1 the cable would be taut. If
            the grippers are turned away from each other, the cable reaches less far, and the limit is lower.
        workspace: lowest and highest corner (x, y) of where the grippers may be [m]; None = anywhere.
    """

    speed: float = 0.1
    turn_rate: float = 1.0
    min_distance: float = 0.1
    max_distance: float = 0.995
    workspace: tuple[tuple[float, float], tuple[float, float]] | None = None

    def __post_init__(self):
        check(self, "speed", turn_rate="speed")
        if not 0 <= self.min_distance < self.max_distance <= 1:
            raise ValueError(
                f"CommandLimits distances {self.min_distance} to {self.max_distance}: expected 0 <= min_distance < "
                "max_distance <= 1, in lengths of the cable."
            )
        check_workspace(self)

    def shortened(
        self, twist: Float[Any, "*B Q 3"], pose: Float[Any, "*B Q 3"], duration: float, length: float
    ) -> Float[Any, "*B Q 3"]:
        """The twist, or the largest share of it (in steps of 0.5 %) that stays within all limits while it is held.

        Both grippers' twists are scaled by the same share. Grippers that start outside may move on as long as they do
        not get farther out. NumPy in, NumPy out in double precision; JAX in, JAX out, also within `jit`.

        Args:
            twist: [m/s, rad/s], finite.
            pose: of both grippers when it begins [m, rad].
            duration: for which it is held at most [s].
            length: of the cable [m].
        """
        if isinstance(twist, np.ndarray):
            twist, pose = np.asarray(twist, float), np.asarray(pose, float)
        xp = twist.__array_namespace__()
        shares = xp.asarray(_SHARES, dtype=twist.dtype)
        # the grippers pass through the end points of all smaller shares
        broken = self._broken(shares.reshape(-1, *[1] * twist.ndim) * twist, pose, duration, length)
        if isinstance(twist, np.ndarray) and not broken.any():
            return twist
        last = xp.where(broken.any(axis=0), broken.argmax(axis=0), len(_SHARES)) - 1
        return shares[xp.maximum(last, 0)][..., None, None] * twist

    def _broken(self, twist: Any, pose: Any, duration: float, length: float) -> Bool[Any, "*B"]:
        """Which twists end outside of a limit, and farther out than they begin."""
        xp, start = twist.__array_namespace__(), pose[..., :2]
        rounding = max(_ROUNDING, _DIGITS * float(np.finfo(start.dtype).eps))
        ends = start + duration * twist[..., :2]
        apart, before = (xp.linalg.norm(places[..., 1, :] - places[..., 0, :], axis=-1) for places in (ends, start))
        clamped = _CLAMPED * length * xp.asarray([1.0, -1.0], dtype=start.dtype)[:, None]
        free = []
        for places, theta in ((ends, pose[..., 2] + duration * twist[..., 2]), (start, pose[..., 2])):
            beyond = places + clamped * xp.stack([xp.cos(theta), xp.sin(theta)], axis=-1)
            free.append(xp.linalg.norm(beyond[..., 1, :] - beyond[..., 0, :], axis=-1))
        broken = (xp.linalg.norm(twist[..., :2], axis=-1) > self.speed + rounding).any(axis=-1)
        broken |= (xp.abs(twist[..., 2]) > self.turn_rate + rounding).any(axis=-1)
        broken |= apart > xp.maximum(self.max_distance * length, before) + rounding
        broken |= free[0] > xp.maximum(self.max_distance * (1 - 2 * _CLAMPED) * length, free[1]) + rounding
        broken |= apart < xp.minimum(self.min_distance * length, before) - rounding
        if self.workspace is not None:
            low, high = (xp.asarray(corner, dtype=start.dtype) for corner in self.workspace)
            outside = (ends < xp.minimum(low, start) - rounding) | (ends > xp.maximum(high, start) + rounding)
            broken |= outside.any(axis=(-2, -1))
        return broken
