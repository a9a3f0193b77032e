"""Evidence of a recording: observations and predictions, weighed by the noise, and which episodes repeat one another.

A law that is not quite the real one errs in the same way each time the grippers move in the same way. Such episodes are
one piece of evidence, whatever the number of samples: they are left out of a fit together, and share one vote.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from cablejax.arrays import positions_at
from cablejax.diagnose.protocol import Explanation, Simulator

_ALIKE = 0.05
"""Motions whose gripper poses differ by less than this share of the cable's length, root mean square, are one."""
_ARM = 0.15
"""Share of the cable's length that a radian of a gripper counts for there."""


@dataclasses.dataclass(frozen=True)
class Robust:
    """Pseudo-Huber loss 2 d^2 (sqrt(1 + (r / d)^2) - 1) of the distance r between predicted and observed points.

    A simulation that swings over another way must not decide alone, and one that breaks down is one bad episode.

    Attributes:
        distance: d, in the unit of the observations.
        lost: distance at which a point counts whose prediction broke down.
        steepest: largest derivative of a point by a coordinate, per prior standard deviation. A steeper point counts as
            lost: its simulation is chaotic, no step is short enough for its linear model, and it would block the fit.
    """

    distance: float
    lost: float
    steepest: float


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Evidence of a recording. Lengths and errors are in the unit of the observations.

    Attributes:
        simulator: of the recorded motions.
        episodes: which of its episodes these are, shape [E].
        observed: NaN = not observed, shape [E, T, ...].
        nominal: predictions without any effect, shape [E, T, ...].
        noise: standard deviation of each observed coordinate, of a shape that broadcasts against `observed[e, t]`.
        temper: how many correlated samples of each episode count as one independent, see `belief`, shape [E].
        freedom: of Student's distribution over episodes, see `belief`.
        motion: episodes with the same number repeat one another, see `repeated_motions`, shape [E].
        fit_freedom: of the distribution that fits maximise; None = `freedom`.
        own_error: of the simulator in each episode, shape [E]; None = `Calibration.baseline` in all.
        robust: loss of the distances between points, over the last axis; None = squares.
    """

    simulator: Simulator
    episodes: Int[np.ndarray, "E"]
    observed: Float[np.ndarray, "E T *O"]
    nominal: Float[np.ndarray, "E T *O"]
    noise: Float[np.ndarray, "*B"]
    temper: Float[np.ndarray, "E"]
    freedom: float
    motion: Int[np.ndarray, "E"]
    fit_freedom: float | None = None
    own_error: Float[np.ndarray, "E"] | None = None
    robust: Robust | None = None

    def restricted(self, rows: Sequence[int] | Int[np.ndarray, "_"]) -> Evidence:
        """The evidence of some of its episodes only."""
        chosen = np.asarray(rows, int)
        return dataclasses.replace(
            self,
            episodes=self.episodes[chosen],
            observed=self.observed[chosen],
            nominal=self.nominal[chosen],
            temper=self.temper[chosen],
            motion=self.motion[chosen],
            own_error=None if self.own_error is None else self.own_error[chosen],
        )

    def predict(self, explanations: Sequence[Explanation]) -> Float[np.ndarray, "X E T *O"]:
        """Predictions of all episodes under each explanation."""
        return self.simulator.predict([self.simulator.with_own(one) for one in explanations], self.episodes)

    def whitened(self, predicted: np.ndarray) -> np.ndarray:
        """Predicted less observed in units of the noise, 0 where nothing was observed."""
        difference = (predicted - self.observed) / self.noise
        difference = np.where(np.isfinite(self.observed), difference, 0.0)
        return difference.reshape(*difference.shape[: difference.ndim - self.observed.ndim + 1], -1)

    def surprise(self, sse: Float[np.ndarray, "E"]) -> Float[np.ndarray, "E"]:
        """Q of every episode: squared error above the noise, in units of what is to be expected."""
        return (sse - self.count) / self.temper

    def log_likelihoods(self, sse: Float[np.ndarray, "E"]) -> Float[np.ndarray, "E"]:
        """Log likelihood of each episode, see `student_log_likelihoods`."""
        return student_log_likelihoods(self.surprise(sse), self.freedom, self.share)

    def weight(self, sse: Float[np.ndarray, "E"]) -> Float[np.ndarray, "E"]:
        """Weight of each episode's squared residuals in the least squares problem that a fit solves in one step."""
        freedom = self.fit_freedom or self.freedom
        return self.share * (freedom + 1) / (freedom + np.maximum(self.surprise(sse), 0.0)) / self.temper

    @property
    def share(self) -> Float[np.ndarray, "E"]:
        """See `share_of_motion`."""
        return share_of_motion(self.motion, self.count > 0)

    @property
    def count(self) -> Float[np.ndarray, "E"]:
        """Observed coordinates of each episode."""
        return np.isfinite(self.observed).sum(axis=tuple(range(1, self.observed.ndim)))


def student_log_likelihoods(
    surprise: Float[np.ndarray, "E"], freedom: float, share: Float[np.ndarray, "E"]
) -> Float[np.ndarray, "E"]:
    """Student's log likelihood of every episode up to a constant, see `belief`; their sum is that of the recording.

    Below the noise floor it is its tangent there: the floor is an estimate, and a fit that comes out below it still has
    a best value.

    Args:
        surprise: Q of every episode.
        freedom: of Student's distribution.
        share: of each episode in the vote of its motion, see `share_of_motion`.
    """
    scaled = surprise / freedom
    each = np.where(scaled > 0, np.log1p(np.maximum(scaled, 0.0)), scaled)
    return -0.5 * (freedom + 1) * share * each


def repeated_motions(
    gripper_pose: Float[np.ndarray, "E T 2 3"], interval: Float[np.ndarray, "E"], length: float
) -> Int[np.ndarray, "E"]:
    """For every episode, the first one with the same motion; its own number where there is none before it.

    Args:
        gripper_pose: of the grippers, theta continuous, NaN beyond an episode's end [m, m, rad].
        interval: between samples [s].
        length: of the cable [m].
    """
    last = gripper_pose.shape[1] - 1
    clock = interval.min() * np.arange(1 + int(last * interval.max() / interval.min() + 1e-6))
    place = np.full((len(interval), len(clock), 2, 3), np.nan)
    for row, own, pose in zip(place, interval, gripper_pose, strict=True):
        within = clock <= last * own + 1e-9
        row[within] = positions_at(clock[within], own * np.arange(last + 1), pose) * [1.0, 1.0, _ARM * length]
    first, samples = np.arange(len(place)), np.isfinite(place).all(axis=(2, 3)).sum(axis=1)
    for e in range(1, len(place)):
        square = ((place[:e] - place[e]) ** 2).sum(axis=(2, 3))
        common = np.isfinite(square)
        mean = np.where(common, square, 0.0).sum(axis=1) / np.maximum(common.sum(axis=1), 1)
        half = np.maximum(samples[:e], samples[e]) / 2
        alike = np.flatnonzero((mean < (_ALIKE * length) ** 2) & (common.sum(axis=1) > half))
        if len(alike):
            first[e] = first[alike[0]]
    return first


def episodes_by_motion(motion: Int[np.ndarray, "E"]) -> list[Int[np.ndarray, "_"]]:
    """The episodes of each motion, in the order of their numbers."""
    return [np.flatnonzero(motion == first) for first in np.unique(motion)]


def share_of_motion(motion: Int[np.ndarray, "E"], seen: Bool[np.ndarray, "E"]) -> Float[np.ndarray, "E"]:
    """Share of each episode in the one vote of its motion: 1 over the number of its episodes that were seen.

    Args:
        motion: episodes with the same number repeat one another.
        seen: whether there is any observation of an episode; the others have no say.
    """
    return 1.0 / np.maximum(((motion[:, None] == motion[None]) & seen[None]).sum(axis=1), 1)
