"""Writes the motion to record next as files that a plant and an arm can execute."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from cablejax.cable import Cable
from cablejax.cable_file import cable_of_log
from cablejax.diagnose.diagnosis import NextMotion
from cablejax.gaplog import TARGETS, Episode, gap_log_from_episodes, write_gap_log
from cablejax.gaplog_join import COMMANDS_DERIVED, EPISODE_LABELS
from cablejax.types import GapLog
from cablejax.whole_file import whole_file

FILE = "next_motion"
"""Name of the files without their endings."""
COLUMNS = ("time_s", *(f"gripper_{q}_{x}" for q in (0, 1) for x in ("x_m", "y_m", "theta_rad")))
"""Columns of the csv."""


def commands_log(motions: Mapping[str, Float[np.ndarray, "T 2 3"]], interval: float, cable: Cable) -> GapLog:
    """Motions as a gap log without keypoints, one episode each: commands, and the poses they are meant to reach.

    Args:
        motions: gripper poses (x, y, theta) by the motion's name [m, rad].
        interval: between two of them [s].
        cable: that is believed to be moved.
    """
    episodes = [
        Episode(
            name,
            interval * np.arange(len(poses)),
            np.full((len(poses), cable.n_keypoints, 2), np.nan),
            poses,
            np.append(np.diff(poses, axis=0) / interval, np.zeros((1, 2, 3)), axis=0),
            np.zeros(len(poses), bool),
        )
        for name, poses in motions.items()
    ]
    source = "commands, to be executed and recorded"
    return gap_log_from_episodes(episodes, cable, source=source)


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
    commands = commands_log({following.motion: following.poses}, following.interval, cable_of_log(log))
    not_its_own = ("motion", "source", "recordings", TARGETS, COMMANDS_DERIVED, *EPISODE_LABELS)
    kept = {name: value for name, value in log.meta.items() if name not in not_its_own}
    return write_gap_log(path, dataclasses.replace(commands, meta={**commands.meta, **kept}), overwrite=True)
