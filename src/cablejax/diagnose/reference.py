"""Fits a ridge residual to a recorded run: a correction without a cause, for comparison."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cablejax.arrays import positions_at
from cablejax.diagnose.clock import keypoints_at
from cablejax.diagnose.recording import Recording
from cablejax.residual.learner import PAPER
from cablejax.residual.ridge import RidgeConfig, apply, fit

HORIZON = 5
"""Steps that the residual is carried on."""
_STEP = 1.0  # [s]
_RIDGE = RidgeConfig()


def predicted_ahead(
    observed: Float[np.ndarray, "E T N 2"],
    simulated: Float[np.ndarray, "E T N 2"],
    gripper_pose: Float[np.ndarray, "E T 2 3"],
    interval: Float[np.ndarray, "E"],
    length: np.ndarray,
) -> tuple[float, float] | None:
    """Corrects a simulator's displacements by ridge regression, `delta = R J + b`, over the last five steps.

    The residual is fitted to what the last five steps of one second got wrong, and carried on for `HORIZON` steps with
    the grippers' true motion. Errors contain the noise of two observations.

    Returns:
        Root mean square errors of a coordinate [m]: of the simulator's displacement, and with the residual added; None
        if no episode is long enough, or none was observed for so long.
    """
    alone, corrected = [], []
    for e in range(len(observed)):
        recorded, window = slice(0, int(length[e])), PAPER.window
        time = float(interval[e]) * np.arange(int(length[e]))
        grid = _STEP * np.arange(int(time[-1] / _STEP + 1e-6) + 1)
        n_starts = len(grid) - window - HORIZON
        if n_starts < 1:
            continue
        error = keypoints_at(grid, time, observed[e, recorded] - simulated[e, recorded], float(interval[e]))
        twist = np.diff(positions_at(grid, time, gripper_pose[e, recorded]), axis=0) / _STEP
        delta = np.diff(error, axis=0)
        past = np.arange(n_starts)[:, None] + np.arange(window)
        ahead = window + np.arange(n_starts)[:, None] + np.arange(HORIZON)
        guess = np.asarray(_carried()(delta[past], twist[past], np.isfinite(delta[past]).all(axis=-1), twist[ahead]))
        # what the simulator's displacement over the whole horizon gets wrong
        wrong = error[window + HORIZON :][:n_starts] - error[window : window + n_starts]
        alone.append(wrong)
        corrected.append(wrong - guess)
    if not alone or not np.isfinite(np.concatenate(corrected)).any():
        return None
    plain, better = (float(np.sqrt(np.nanmean(np.concatenate(x) ** 2))) for x in (alone, corrected))
    return plain, better


def ahead_of_observations(
    recording: Recording,
    before: Float[np.ndarray, "E T N 2"],
    after: Float[np.ndarray, "E T N 2"],
    noise: Float[np.ndarray, "N"],
) -> tuple[dict[str, float] | None, float | None]:
    """Errors five seconds ahead [mm], see `Gap.ahead_mm`, and the share of the squared leftover that is learnable.

    Args:
        recording: with the observed keypoints.
        before: keypoints of the nominal simulator [m].
        after: with the named effects [m].
        noise: standard deviation of each keypoint's coordinates [m].

    Returns:
        Two times None where no episode is long enough, or none was observed for so long.
    """
    arguments = recording.gripper_pose, recording.interval, recording.length
    nominal = predicted_ahead(recording.keypoints, before, *arguments)
    named = predicted_ahead(recording.keypoints, after, *arguments)
    if nominal is None or named is None:
        return None, None
    # both ends of the prediction are observed with noise
    floor = 2 * float(np.mean(noise**2))
    alone, corrected = named
    left = max(alone**2 - floor, 0.0)
    learnable = (alone**2 - max(corrected**2, floor)) / left if left > 0.1 * floor else 0.0
    errors = {"nominal": 1e3 * nominal[0], "ridge": 1e3 * nominal[1], "named": 1e3 * alone}
    return errors, float(np.clip(learnable, 0.0, 1.0))


@functools.cache
def _carried():
    def one(delta, twist, valid, ahead):
        residual = fit(delta, twist, valid, _RIDGE)
        return jnp.sum(jax.vmap(lambda r: apply(residual, r))(ahead), axis=0)

    return jax.jit(jax.vmap(one))
