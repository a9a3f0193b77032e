"""The record of one closed-loop run, and its measures."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from cablejax.control.targets import Target
from cablejax.gaplog import Episode
from cablejax.mpc.state import Action

SETTLING_FRACTION = 0.1
"""Half-width of the band around the terminal error in which a run counts as settled, relative to that error or, where
that is less, to the change of the error over the run."""
SETTLING_FLOOR = 1e-3
"""Smallest half-width of that band, in lengths of the cable."""
_SEEN = 0.5
"""Share of the keypoints below which a view says too little of where the cable is."""
SETTLING_DWELL = 3
"""Samples at the end that must lie in the band, or the run has not settled."""


@dataclasses.dataclass(frozen=True)
class ClosedLoopRun:
    """One cable brought towards one target, at the control instants; `episode` has it at the camera's rate.

    At the last sample no command was computed: `twist` and the fields from `residual_share` to `mpc_ms` are NaN there.

    Attributes:
        target: what was asked for.
        times: seconds since the first command, shape [T].
        keypoints: observed cable [m], NaN = not observed, shape [T, N, 2].
        gripper_pose: (x, y, theta) [m, rad], shape [T, Q, 3].
        twist: commands [m/s, rad/s], shape [T, Q, 3].
        error_cm: root mean square distance to the target [cm], shape [T]: of the true keypoints where the cable is a
            simulated one, which knows them, otherwise of the observed ones.
        residual_share: the controller's report, NaN where it makes none, shape [T].
        radius: the controller's bound on one step's motion [m], NaN where it reports none, shape [T].
        action: the `mpc.Action` of each command, NaN where the controller reports none, shape [T].
        mpc_ms: wall time of each control call [ms], compilation excluded, shape [T].
        unobserved: keypoint observations that are missing, over the whole run.
        stopped: why the run ended early, or None.
        episode: the run for the gap log, resting time before the first command included.
    """

    target: Target
    times: Float[np.ndarray, " T"]
    keypoints: Float[np.ndarray, "T N 2"]
    gripper_pose: Float[np.ndarray, "T Q 3"]
    twist: Float[np.ndarray, "T Q 3"]
    error_cm: Float[np.ndarray, " T"]
    residual_share: Float[np.ndarray, " T"]
    radius: Float[np.ndarray, " T"]
    action: Float[np.ndarray, " T"]
    mpc_ms: Float[np.ndarray, " T"]
    unobserved: int
    stopped: str | None
    episode: Episode

    @property
    def initial_error_cm(self) -> float:
        """Error before the first command [cm]."""
        return float(self.error_cm[0])

    @property
    def terminal_error_cm(self) -> float:
        """Error at the end [cm]."""
        return float(self.error_cm[-1])

    @property
    def settling_time_s(self) -> float:
        """See `settling_time`."""
        return settling_time(self.times, self.error_cm, self.target.length)

    @property
    def straightened(self) -> Bool[np.ndarray, " T"]:
        """Control instants at which the cable was being straightened, to be shaped again."""
        return self.action == Action.STRAIGHTEN

    @property
    def goal_cm(self) -> float:
        """Error up to which a target counts as reached [cm]: a hundredth of its length."""
        return self.target.length

    @property
    def reached(self) -> bool:
        """Whether the target was reached: by the true keypoints, or by at least half of them as last observed."""
        seen = np.isfinite(self.keypoints[-1]).all(axis=-1)
        guessed = self.terminal_error_cm == shape_error_cm(self.keypoints[-1], self.target.keypoints)
        return self.terminal_error_cm <= self.goal_cm and (seen.mean() >= _SEEN or not guessed)

    def verdict(self) -> str:
        """One sentence: whether the target was reached, and if not, how far the cable got and where it is off."""
        start, end = self.initial_error_cm, self.terminal_error_cm
        early = f" It stopped after {self.times[-1]:.0f} s: {self.stopped}" if self.stopped else ""
        if self.reached:
            return f"{self.target.name}: reached, from {start:.2f} to {end:.2f} cm.{early}"
        distance = 100 * np.linalg.norm(self.keypoints[-1] - self.target.keypoints, axis=-1)
        seen, known = np.isfinite(distance), np.isfinite(self.error_cm)
        if not known.any():
            return f"{self.target.name}: no keypoint of the cable was ever observed.{early}"
        best = int(np.nanargmin(self.error_cm))
        last = f"at the end {seen.sum()} of {len(seen)} keypoints were observed"
        if seen.any():
            far = f"keypoint {int(np.nanargmax(distance))} is farthest off, by {np.nanmax(distance):.2f} cm"
            last = far if seen.mean() >= _SEEN else f"{last}, of which {far}"
        if self.straightened[-2:].any():
            early += " It was being straightened for another try: more commands may reach the target."
        return (
            f"{self.target.name}: not reached within {self.goal_cm:.2f} cm. The error went from {start:.2f} to "
            f"{end:.2f} cm (lowest {self.error_cm[best]:.2f} cm after {self.times[best]:.0f} s); {last}.{early}"
        )


def shape_error_cm(keypoints: Float[Any, "*T N 2"], target: Float[Any, "*#T N 2"]) -> Float[Any, "*T"]:
    """Root mean square distance [cm] of the observed keypoints to the target's; NaN where none was observed.

    NumPy in, NumPy out; JAX in, JAX out, also within `jit`.
    """
    xp = keypoints.__array_namespace__()
    squared = ((keypoints - target) ** 2).sum(axis=-1)
    seen = xp.isfinite(squared)
    count = seen.sum(axis=-1)
    total = xp.where(seen, squared, 0.0).sum(axis=-1)
    return xp.where(count > 0, 100 * xp.sqrt(total / xp.maximum(count, 1)), xp.nan)


def settling_time(times: Float[np.ndarray, " T"], error_cm: Float[np.ndarray, " T"], length: float) -> float:
    """First time from which on the error stays near its last value; infinite if it was still changing at the end.

    Near means within 10 % of the last value, and within 10 % of the error's change over the run where the target stayed
    far; a thousandth of `length` [m], of the cable or the target, is near in any case. The last three samples must all
    be near.
    """
    error = np.asarray(error_cm)
    band = max(SETTLING_FRACTION * min(error[-1], abs(error[0] - error[-1])), 100 * SETTLING_FLOOR * length)
    return time_in_band(times, error, band)


def time_in_band(times: Float[np.ndarray, " T"], error: Float[np.ndarray, " T"], band: float) -> float:
    """First time from which on the error differs from its last value by at most `band`; infinite if there is none."""
    if not np.isfinite(error[-1]):
        return float("inf")
    outside = np.flatnonzero(~(np.abs(error - error[-1]) <= band))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(times[first]) if len(error) - first >= min(SETTLING_DWELL, len(error)) else float("inf")
