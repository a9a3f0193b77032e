"""Tracks the cable from cloud to cloud: warm start, detection of a loss, and reacquisition."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from cablejax.limits import LIMITS
from cablejax.perceive.frame import Status, Track, TrackerConfig, TrackState, judge, track
from cablejax.perceive.initial import cloud_path, first_fit, path_length


class PaddedCloud(NamedTuple):
    """A cloud on the table in a fixed number of rows.

    Attributes:
        points: [m], zeros where `mask` is false, float32, shape [S, 2].
        mask: which rows are points, shape [S].
        dropped: points that were not finite, or farther away than any camera sees.
    """

    points: Float[np.ndarray, "S 2"]
    mask: Bool[np.ndarray, " S"]
    dropped: int


def padded(points: Float[np.ndarray, "n D"], capacity: int) -> PaddedCloud:
    """The finite points of a cloud in `capacity` rows: a random part of them if there are more. Deterministic.

    Args:
        points: positions [m], shape [n, 2] or [n, 3], of which z is left out; n may be 0.
        capacity: rows S of the result, the same for every frame, so that nothing is compiled twice.

    Raises:
        ValueError: the points have another shape or are not numbers.
    """
    array = np.asarray(points)
    if array.size == 0:
        array = np.zeros((0, 2))
    if array.ndim != 2 or array.shape[1] not in (2, 3) or not np.issubdtype(array.dtype, np.number):
        raise ValueError(
            f"A cloud has shape {array.shape} and type {array.dtype}, expected numbers of shape [n, 2] or [n, 3]: one "
            "row per point, in metres, in the frame of the grippers."
        )
    # cameras report what they do not see as not finite, or as a number without meaning
    finite = (np.abs(array) <= LIMITS["coordinate"].high).all(axis=1)
    kept = array[finite, :2].astype(np.float32)
    if len(kept) > capacity:
        kept = kept[np.random.default_rng(0).choice(len(kept), capacity, replace=False)]
    rows = np.zeros((capacity, 2), np.float32)
    rows[: len(kept)] = kept
    return PaddedCloud(rows, np.arange(capacity) < len(kept), int(np.sum(~finite)))


@dataclasses.dataclass(frozen=True)
class Tracker:
    """The tracker for clouds as they come: any number of points, NaN among them, or none.

    `init` and `step` are pure functions of their arguments. They raise only on input that can never be a cloud. A
    frame without a cable is counted as lost and reported in `Track.status`, and in words by `explain`.

    Attributes:
        config: see `TrackerConfig`.
    """

    config: TrackerConfig = TrackerConfig()

    def init(
        self, points: Float[np.ndarray, "n D"], gripper_pose: Float[np.ndarray, "Q 3"]
    ) -> tuple[TrackState, Track]:
        """Finds the cable in a first cloud, without a prior.

        Args:
            points: the cloud [m], in the frame of the grippers, shape [n, 2] or [n, 3].
            gripper_pose: (x, y, theta) of both grippers [m, rad], theta the direction of the cable's tangent.

        Raises:
            ValueError: the cloud or the pose has a wrong shape, or the pose is not finite.
        """
        pose = _checked_pose(gripper_pose)
        cloud = padded(points, self.config.capacity)
        settings = self.config.registration
        turn = pose[1, 2] - pose[0, 2]
        state = TrackState(
            angles=jnp.full(settings.n_links - 1, turn / (settings.n_links - 1), float),
            gripper_pose=jnp.asarray(pose, float),
            sigma=jnp.asarray(settings.min_sigma, float),
            travel=jnp.zeros((), float),
            lost=jnp.ones((), jnp.int32),
            misfits=jnp.zeros((), jnp.int32),
            found=jnp.asarray(False),
        )
        return self._search(state, cloud, pose)

    def step(
        self, state: TrackState, points: Float[np.ndarray, "n D"], gripper_pose: Float[np.ndarray, "Q 3"]
    ) -> tuple[TrackState, Track]:
        """Takes in the next cloud; arguments and errors as of `init`."""
        pose = _checked_pose(gripper_pose)
        cloud = padded(points, self.config.capacity)
        after, seen = track(self.config, state, cloud.points, cloud.mask, jnp.asarray(pose, float))
        misfits = int(after.misfits)
        if misfits == 1 or (misfits > 0 and misfits % self.config.retry == 0):
            return self._search(after, cloud, pose, otherwise=seen)
        return after, seen

    def explain(
        self, track: Track, points: Float[np.ndarray, "n D"], gripper_pose: Float[np.ndarray, "Q 3"]
    ) -> str | None:
        """Why a frame was lost, in a sentence with numbers; None if it was not."""
        status, config = Status(int(track.status)), self.config
        if status is Status.TRACKED:
            return None
        cloud = padded(points, config.capacity)
        count = int(cloud.mask.sum())
        if status is Status.FEW_POINTS:
            dropped = f" ({cloud.dropped} more are not finite)" if cloud.dropped else ""
            return (
                f"The cloud has {count} usable points{dropped}, expected at least {config.min_points}: the cable is "
                "occluded, or the camera does not look at it."
            )
        found = path_length(cloud_path(cloud.points[cloud.mask], gripper_pose, config.registration.length))
        return (
            f"The cloud does not fit a cable of {config.registration.length:.3g} m between these grippers: "
            f"{float(track.support):.0%} of its points lie within {1e3 * config.reach:.0f} mm of the best fit, "
            f"expected {config.min_support:.0%} and no fold; the shortest way along its points is {found:.3g} m. "
            "Check the cable, its length, and the frame of the cloud."
        )

    def _search(
        self, state: TrackState, cloud: PaddedCloud, pose: np.ndarray, otherwise: Track | None = None
    ) -> tuple[TrackState, Track]:
        """Looks for the cable without a prior; the state stays as it is if it is not found."""
        config = self.config
        count = int(cloud.mask.sum())
        if count >= config.min_points:
            fit = first_fit(config.registration, cloud.points, cloud.mask, pose, reach=config.reach)
            status = judge(config, fit, jnp.asarray(count))
            if int(status) == Status.TRACKED:
                zero = jnp.zeros_like(state.lost)
                found = TrackState(
                    angles=fit.angles,
                    gripper_pose=fit.gripper_pose,
                    sigma=fit.sigma,
                    travel=jnp.zeros_like(state.travel),
                    lost=zero,
                    misfits=zero,
                    found=jnp.asarray(True),
                )
                return found, Track(fit.keypoints, status, zero, fit.sigma, fit.support, fit.seen)
            support, seen, sigma = fit.support, fit.seen, fit.sigma
        else:
            status = jnp.asarray(Status.FEW_POINTS)
            support, seen, sigma = jnp.asarray(0.0), jnp.asarray(0.0), state.sigma
        if otherwise is not None:
            return state, otherwise
        nowhere = jnp.full((config.registration.n_keypoints, 2), jnp.nan)
        return state, Track(nowhere, status, state.lost, sigma, support, seen)


def _checked_pose(value: Float[np.ndarray, "Q 3"]) -> np.ndarray:
    pose = np.asarray(value, float)
    if pose.shape != (2, 3) or not np.isfinite(pose).all():
        raise ValueError(
            f"gripper_pose is {pose.tolist()}, expected two finite rows (x, y, theta): without the grippers' poses "
            "the place of the cable along itself cannot be known."
        )
    return pose
