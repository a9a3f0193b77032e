"""Limits of a command, independent of the controller that computed it."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from cablejax.limits import check

_SHARES = np.linspace(0.0, 1.0, 201)


@dataclasses.dataclass(frozen=True)
class CommandLimits:
    """What both grippers may do while a command holds: the last resort, whatever the controller's own bounds are.

    Attributes:
        speed: of each gripper at most [m/s].
        turn_rate: of each gripper at most [rad/s].
        min_distance: of the grippers from each other at least [m].
        max_distance: of the grippers from each other at most [m]: below the cable's length, or it is pulled taut.
        workspace: lowest and highest corner (x, y) of where the grippers may be [m]; None = anywhere.
    """

    speed: float = 0.1
    turn_rate: float = 1.0
    min_distance: float = 0.1
    max_distance: float = 0.995
    workspace: tuple[tuple[float, float], tuple[float, float]] | None = None

    def __post_init__(self):
        check(self, "speed", turn_rate="speed", min_distance="not_negative", max_distance="length")
        if self.min_distance >= self.max_distance:
            raise ValueError(
                f"CommandLimits distances {self.min_distance} to {self.max_distance}: expected the first below the "
                "second [m]."
            )
        if self.workspace is not None:
            corners = np.asarray(self.workspace, float)
            if corners.shape != (2, 2) or not (corners[0] < corners[1]).all():
                raise ValueError(
                    f"CommandLimits.workspace is {self.workspace}, expected ((x, y) of the lowest, (x, y) of the "
                    "highest corner) [m]."
                )

    def shortened(
        self, twist: Float[np.ndarray, "Q 3"], pose: Float[np.ndarray, "Q 3"], duration: float
    ) -> Float[np.ndarray, "Q 3"]:
        """The twist, or the largest share of it (in steps of 0.5 %) that stays within all limits while it is held.

        Both grippers' twists are scaled by the same share. Grippers that start outside may move on as long as they do
        not get farther out.

        Args:
            twist: [m/s, rad/s], finite.
            pose: of both grippers when it begins [m, rad].
            duration: for which it is held at most [s].
        """
        candidates = _SHARES[:, None, None] * np.asarray(twist, float)
        broken = self._excess(candidates, pose, duration) > 0.0
        # the grippers pass through the end points of all smaller shares
        return twist if not broken.any() else candidates[max(int(broken.argmax()) - 1, 0)]

    def _excess(self, twists: np.ndarray, pose: np.ndarray, duration: float) -> np.ndarray:
        """The worst excess of each twist [S, Q, 3] over the limits, or over how far outside the start is already."""
        start = np.asarray(pose, float)[:, :2]
        ends = start + duration * twists[..., :2]
        distance, at_start = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1), np.linalg.norm(start[1] - start[0])
        parts = [
            (np.linalg.norm(twists[..., :2], axis=-1) - self.speed).max(axis=-1),
            (np.abs(twists[..., 2]) - self.turn_rate).max(axis=-1),
            distance - max(self.max_distance, at_start),
            min(self.min_distance, at_start) - distance,
        ]
        if self.workspace is not None:
            low, high = np.asarray(self.workspace, float)
            parts += [
                (np.minimum(low, start) - ends).max(axis=(1, 2)),
                (ends - np.maximum(high, start)).max(axis=(1, 2)),
            ]
        return np.max(parts, axis=0) - 1e-12
