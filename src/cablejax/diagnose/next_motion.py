"""Chooses or designs the motion to record next, by expected information about which explanation holds."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.diagnosis import NextMotion
from cablejax.diagnose.motion_bounds import Bounds, BoundsError
from cablejax.diagnose.motion_design import DesignConfig, design_motion, excluded
from cablejax.diagnose.motion_judge import Judge, Judged
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.protocol import explanation
from cablejax.diagnose.safe_motions import INTERVAL, Way, safe_ways, starting_pose

DESIGNED = "designed"
"""Name of a designed motion."""
# Motions as long as the log's share its compiled program, if they are neither cut short nor mostly rest.
_SAMPLES = (250, 400)
_USUAL_SAMPLES = 300


def next_motion(judge: Judge, design: DesignConfig | None = None) -> NextMotion | None:
    """Judges every safe motion from a first pose of the log and, if asked to, designs one.

    Args:
        judge: of motions, with the bounds to keep.
        design: effort of the search for a motion; None = the best safe motion is taken.

    Returns:
        The motion with the most information. None if nothing is left to find out: a single explanation without
        parameters.

    Raises:
        BoundsError: no motion keeps all bounds; says how many each bound excludes.
    """
    if judge.about_parameters and not len(judge.explanations[0].z):
        return None
    ways, judged, n_samples = _safe(judge)
    kept = {name: one for name, one in judged.items() if not one.beyond}
    ended = None
    if design is not None:
        kept[DESIGNED], ended = design_motion(judge, ways, judged, n_samples, design)
    if not kept:
        raise BoundsError(excluded(list(judged.values())))
    name = DESIGNED if design is not None else max(kept, key=lambda name: kept[name].information)
    best = kept[name]
    assert best.keypoints is not None
    names = [" + ".join(dict.fromkeys(one.names)) or "nominal" for one in judge.explanations]
    return NextMotion(
        motion=name,
        separates=() if judge.about_parameters else tuple(names),
        information=best.information,
        doubt=judge.doubt,
        alternatives={name: one.information for name, one in kept.items()},
        poses=best.poses,
        interval=INTERVAL,
        shapes=dict(zip(names, best.keypoints, strict=True)),
        ended=ended,
    )


def require_some_motion(playback: Playback, noise: Float[np.ndarray, "N"], bounds: Bounds) -> None:
    """Checks that some motion of the nominal cable keeps all bounds.

    Args:
        playback: of the log's motions.
        noise: standard deviation of each keypoint's coordinates [m].
        bounds: to keep.

    Raises:
        BoundsError: none does; says how many each bound excludes.
    """
    judge = Judge(playback, (explanation(),), np.ones(1), (np.zeros((0, 0)),), noise, bounds=bounds)
    ways, judged, n_samples = _safe(judge)
    design_motion(judge, ways, judged, n_samples, dataclasses.replace(DesignConfig(), simulations=1000))


def _safe(judge: Judge) -> tuple[dict[str, Way], dict[str, Judged], int]:
    """The safe motions by name, judged, and their number of samples."""
    playback, bounds = judge.playback, judge.bounds
    n_samples, most = playback.gripper_pose.shape[1], int(bounds.duration / INTERVAL + 1e-6) + 1
    if not _SAMPLES[0] <= n_samples <= min(_SAMPLES[1], most):
        n_samples = min(_USUAL_SAMPLES, most)
    ways = safe_ways(playback.config, starting_pose(playback.gripper_pose), bounds)
    judged = judge.judged([way.played(n_samples, bounds) for way in ways.values()])
    return ways, dict(zip(ways, judged, strict=True)), n_samples
