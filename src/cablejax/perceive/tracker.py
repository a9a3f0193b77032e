"""Tracks the cable from cloud to cloud: warm start, detection of a loss, and reacquisition."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cablejax.perceive.frame import Status, Track, TrackerConfig, TrackState, judge, quality, track
from cablejax.perceive.initial import PaddedCloud, cloud_path, first_fit, padded, path_length
from cablejax.poses import planar_rows

# Lengths of the cable over which a cloud and the grippers can hardly extend.
_FARTHEST = 4.0


@dataclasses.dataclass(frozen=True)
class Tracker:
    """The tracker for raw clouds: any number of points, NaN among them, or none.

    `init` and `step` are pure functions of their arguments. They raise only on input that can never be a cloud. A
    frame without a cable is counted as lost and reported in `Track.status`, and in words by `explain`.

    Attributes:
        config: see `TrackerConfig`.
    """

    config: TrackerConfig = TrackerConfig()

    def __post_init__(self):
        if not isinstance(self.config, TrackerConfig):
            raise ValueError(f"config is of type {type(self.config).__name__}, expected a TrackerConfig.")

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
        pose = planar_rows(gripper_pose, "gripper_pose")
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
        """Processes the next cloud; arguments and errors as in `init`."""
        pose = planar_rows(gripper_pose, "gripper_pose")
        cloud = padded(points, self.config.capacity)
        after, seen = track(self.config, state, jnp.asarray(cloud.points, float), cloud.mask, jnp.asarray(pose, float))
        misfits = int(after.misfits)
        if misfits == 1 or (misfits > 0 and misfits % self.config.retry == 0):
            state, found = self._search(after, cloud, pose)
            if int(found.status) == Status.TRACKED:
                return state, found
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
        length, used = config.registration.length, cloud.points[cloud.mask]
        places = np.concatenate([used, np.asarray(gripper_pose, np.float32)[:, :2]])
        across = float(np.ptp(places, axis=0).max())
        begin = f"The cloud does not fit a cable of {length:.3g} m between these grippers: "
        if across > _FARTHEST * length:
            return f"{begin}together they extend over {across:.3g} m. Are both in metres, and in one frame?"
        # a path is smooth, which takes a little off its ends
        ends = np.asarray(gripper_pose, float)[:, :2]
        way = path_length(np.stack([ends[0], *cloud_path(used, gripper_pose, length), ends[1]]))
        return f"{begin}{self._misfit(track)} The shortest way along its points is {way:.3g} m."

    def _misfit(self, track: Track) -> str:
        """Which of the thresholds that `judge` looks at a fit does not keep, and what may be the reason."""
        config, reach = self.config, f"{1e3 * self.config.reach:.0f} mm"
        support, seen, sigma = float(track.support), float(track.seen), float(track.sigma)
        if not support >= config.min_support:
            return (
                f"{support:.0%} of its points lie within {reach} of the best fit, expected {config.min_support:.0%}. "
                "Is something else in the cloud, is it in another frame than the grippers, or is theta not the "
                "direction of the cable from gripper 0 to gripper 1, in rad?"
            )
        if not seen >= config.min_seen:
            return f"{seen:.0%} of the cable have points, expected {config.min_seen:.0%}: is it hidden?"
        if not sigma <= config.max_sigma:
            return f"its points scatter by {1e3 * sigma:.1f} mm, expected {1e3 * config.max_sigma:.0f} mm at most."
        return (
            f"its points are near the best fit, which is bent to {float(track.curvature):.0f} 1/m (at most "
            f"{config.max_curvature:.0f}) and misses the second gripper by {1e3 * float(track.gap):.0f} mm (at most "
            f"{reach}). Check theta, the direction of the cable from gripper 0 to gripper 1 in rad, the order of the "
            "grippers, and the length."
        )

    def _search(self, state: TrackState, cloud: PaddedCloud, pose: np.ndarray) -> tuple[TrackState, Track]:
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
                return found, Track(fit.keypoints, status, zero, *quality(fit))
            found_by = quality(fit)
        else:
            status, zero = jnp.asarray(Status.FEW_POINTS), jnp.asarray(0.0)
            found_by = (state.sigma, zero, zero, zero, zero)
        nowhere = jnp.full((config.registration.n_keypoints, 2), jnp.nan)
        return state, Track(nowhere, status, state.lost, *found_by)
