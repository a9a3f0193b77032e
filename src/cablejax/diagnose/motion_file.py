"""Writes the motion to record next as files that a plant and an arm can execute."""

from __future__ import annotations

import os
import pathlib

import numpy as np

from cablejax.diagnose.diagnosis import NextMotion
from cablejax.gaplog import write_gap_log
from cablejax.types import GapLog
from cablejax.whole_file import whole_file

FILE = "next_motion"
"""Name of the files without their endings."""
COLUMNS = ("time_s", *(f"gripper_{q}_{x}" for q in (0, 1) for x in ("x_m", "y_m", "theta_rad")))
"""Columns of the csv."""


def motion_log(following: NextMotion, log: GapLog) -> GapLog:
    """The motion as a gap log of one episode without keypoints: its commands, and poses as they are commanded.

    Args:
        following: the motion.
        log: that was diagnosed; of it the cable.
    """
    poses, samples = following.poses, len(following.poses)
    points = log.keypoints.shape[2]
    return GapLog(
        time=following.interval * np.arange(samples)[None],
        keypoints=np.full((1, samples, points, 2), np.nan, np.float32),
        gripper_pose=poses[None].astype(np.float32),
        gripper_command=np.append(np.diff(poses, axis=0) / following.interval, np.zeros((1, 2, 3)), axis=0)[
            None
        ].astype(np.float32),
        episode_length=np.array([samples], np.int32),
        hold=np.zeros((1, samples), bool),
        meta={**log.meta, "motion": [following.motion], "source": "to be recorded next, by cablejax diagnose"},
    )


def write_motion(folder: str | os.PathLike[str], following: NextMotion | None, log: GapLog) -> pathlib.Path | None:
    """Writes `next_motion.npz`, a gap log without keypoints, and `next_motion.csv`, one row of poses for each sample.

    Where there is no motion, those of an earlier diagnosis are removed.

    Args:
        folder: that exists.
        following: the motion, or None.
        log: that was diagnosed.

    Returns:
        The path of the gap log.
    """
    path = pathlib.Path(folder) / f"{FILE}.npz"
    table = path.with_suffix(".csv")
    if following is None:
        path.unlink(missing_ok=True)
        table.unlink(missing_ok=True)
        return None
    rows = np.column_stack([following.interval * np.arange(len(following.poses)), following.poses.reshape(-1, 6)])
    text = "\n".join([",".join(COLUMNS), *(",".join(f"{v:.6f}" for v in row) for row in rows), ""])
    with whole_file(table) as stream:
        stream.write(text.encode())
    return write_gap_log(path, motion_log(following, log), overwrite=True)
