"""Finds episodes that repeat one another.

A law that is not quite the real one errs in the same way each time the grippers move in the same way. Such episodes are
one piece of evidence, whatever the number of samples: they are left out of a fit together, and share one vote.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

_ALIKE = 0.05
"""Motions whose gripper poses differ by less than this share of the cable's length, root mean square, are one."""
_ARM = 0.15
"""So many lengths count as much as one radian."""


def repeated_motions(gripper_pose: Float[np.ndarray, "E T 2 3"], length: float) -> Int[np.ndarray, "E"]:
    """For every episode, the first one with the same motion; its own number where there is none before it.

    Args:
        gripper_pose: of the grippers, theta continuous, NaN beyond an episode's end [m, m, rad].
        length: of the cable [m].
    """
    place = gripper_pose * np.array([1.0, 1.0, _ARM * length])
    first = np.arange(len(place))
    for e in range(1, len(place)):
        square = ((place[:e] - place[e]) ** 2).sum(axis=(2, 3))
        common = np.isfinite(square)
        mean = np.where(common, square, 0.0).sum(axis=1) / np.maximum(common.sum(axis=1), 1)
        alike = np.flatnonzero((mean < (_ALIKE * length) ** 2) & (2 * common.sum(axis=1) > common.shape[1]))
        if len(alike):
            first[e] = first[alike[0]]
    return first


def episodes_by_motion(motion: Int[np.ndarray, "E"]) -> list[Int[np.ndarray, "_"]]:
    """The episodes of each motion, in the order of their numbers."""
    return [np.flatnonzero(motion == first) for first in np.unique(motion)]


def share_of_motion(motion: Int[np.ndarray, "E"]) -> Float[np.ndarray, "E"]:
    """1 / how many episodes have the motion of each."""
    return 1.0 / (motion[:, None] == motion[None]).sum(axis=1)
