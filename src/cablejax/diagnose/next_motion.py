"""Chooses the motion to record next: the one on which the most probable explanations differ most."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.diagnosis import NextMotion
from cablejax.diagnose.planar import physics_of
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.protocol import Explanation
from cablejax.diagnose.safe_motions import INTERVAL, safe_motions, starting_pose
from cablejax.effects.physics import Physics

# Motions as long as the log's share its compiled program, if they are neither cut short nor mostly rest.
_SAMPLES = (250, 400)
_USUAL_SAMPLES = 300


def next_motion(
    playback: Playback, explanations: Sequence[Explanation], noise: Float[np.ndarray, "N"], temper: float = 1.0
) -> NextMotion | None:
    """Simulates every safe motion from a first pose of the log under the two most probable explanations.

    Of a single explanation the motion is chosen that changes most with its parameters, each moved by one standard
    deviation of its posterior on this log.

    Args:
        playback: the log's motions.
        explanations: fitted explanations, most probable first; all but the first two are ignored.
        noise: standard deviation of each keypoint's coordinates [m].
        temper: how many correlated samples count as one, for the posterior; see `belief`.

    Returns:
        The motion and its separation, or None if there is no motion that this cable bears and the simulation survives.

    Raises:
        ValueError: no explanations.
    """
    if not explanations:
        raise ValueError("next_motion needs at least one fitted explanation, got none.")
    config, first = playback.config, starting_pose(playback.gripper_pose)
    n_samples = playback.gripper_pose.shape[1]
    n_samples = n_samples if _SAMPLES[0] <= n_samples <= _SAMPLES[1] else _USUAL_SAMPLES
    motions = {}
    for name, poses in safe_motions(config, first, n_samples).items():
        try:
            motions[name] = Playback.of_motion(config, poses[None], None, np.full(1, INTERVAL))
        except ValueError:
            # no settled start, for example of a first pose that only a cable wound otherwise can have
            continue
    if not motions:
        return None
    library = Playback(
        config=config,
        gripper_pose=np.concatenate([m.gripper_pose for m in motions.values()]),
        angles=np.concatenate([m.angles for m in motions.values()]),
        interval=np.concatenate([m.interval for m in motions.values()]),
        believed=playback.believed,
    )
    if len(explanations) > 1:
        rivals = [physics_of(c, playback.believed, config) for c in explanations[:2]]
        separation = _difference(library, rivals[0], rivals[1:], noise)[0]
        separates = _name(explanations[0]), _name(explanations[1])
    else:
        separation = _sensitivity(playback, library, explanations[0], noise, temper)
        separates = ()
    numbers = {name: float(value) for name, value in zip(motions, separation, strict=True) if np.isfinite(value)}
    if not numbers:
        return None
    best = max(numbers, key=lambda name: numbers[name])
    return NextMotion(motion=best, separates=separates, separation=numbers[best], alternatives=numbers)


def _difference(
    playback: Playback, one: Physics, others: Sequence[Physics], noise: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "K E"]:
    """Root mean square difference of each of the others from the first on each motion, in noise units."""
    keypoints = playback.keypoints([one, *others])
    return np.sqrt((((keypoints[1:] - keypoints[0]) / noise[:, None]) ** 2).mean(axis=(2, 3, 4)))


def _sensitivity(playback, library, explanation: Explanation, noise, temper: float) -> Float[np.ndarray, "E"]:
    """Root of the summed squared changes with every parameter, each moved by one posterior standard deviation."""
    config, n_parameters = playback.config, len(explanation.z)
    if n_parameters == 0:
        return np.full(len(library.gripper_pose), np.nan)
    base = physics_of(explanation, playback.believed, config)
    steps = explanation.differences
    moved = [physics_of(explanation.moved(explanation.z + step), playback.believed, config) for step in np.diag(steps)]
    keypoints = playback.keypoints([base, *moved])
    jacobian = ((keypoints[1:] - keypoints[0]) / noise[:, None]).reshape(n_parameters, -1) / steps[:, None]
    jacobian = np.where(np.isfinite(jacobian), jacobian, 0.0)
    covariance = np.linalg.inv(jacobian @ jacobian.T / temper + np.eye(n_parameters))
    deviation = np.sqrt(np.diagonal(covariance))
    change = _difference(library, base, moved, noise) / np.abs(steps)[:, None] * deviation[:, None]
    return np.sqrt((change**2).sum(axis=0))


def _name(explanation: Explanation) -> str:
    return " + ".join(dict.fromkeys(explanation.names)) or "nominal"
