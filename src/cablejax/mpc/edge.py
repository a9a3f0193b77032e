"""What every controller checks before anything is compiled: its target, its first history, each observation."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from cablejax.types import History


def check_target(target: Float[Array | np.ndarray, "N 2"]) -> None:
    """Raises ValueError unless the target is an array of finite keypoints [N, 2], N at least 3: fewer have no shape."""
    target = np.asarray(target)
    if target.ndim != 2 or target.shape[0] < 3 or target.shape[1] != 2 or not np.isfinite(target).all():
        raise ValueError(
            f"The target has shape {target.shape}{'' if np.isfinite(target).all() else ' with non-finite values'}, "
            "expected finite keypoints [N, 2] in metres, three or more."
        )


def check_start(target: Float[Array | np.ndarray, "N 2"], history: History) -> None:
    """Raises ValueError unless the history is finite and has the target's number of keypoints."""
    check_observation(target, history.keypoints[-1], history.gripper_pose)
    if not (np.isfinite(history.keypoints).all() and np.isfinite(history.gripper_pose).all()):
        raise ValueError("The initial history has non-finite values: start from a complete observation.")


def check_observation(
    target: Float[Array | np.ndarray, "N 2"],
    keypoints: Float[Array | np.ndarray, "N 2"],
    gripper_pose: Float[Array | np.ndarray, "Q 3"],
) -> None:
    """Raises ValueError unless an observation has the shape of the target's keypoints and of two grippers' poses."""
    if np.shape(keypoints) != np.shape(target) or np.shape(gripper_pose) != (2, 3):
        raise ValueError(
            f"Observation with keypoints {np.shape(keypoints)} and gripper poses {np.shape(gripper_pose)}, "
            f"expected {np.shape(target)} as the target and (2, 3)."
        )
