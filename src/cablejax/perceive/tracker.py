"""Tracks the cable from cloud to cloud: warm start, detection of a loss, and reacquisition."""

from __future__ import annotations

import dataclasses
import enum
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cablejax.perceive.cloud import PaddedCloud, padded
from cablejax.perceive.initial import first_fit
from cablejax.perceive.path import cloud_path, path_length
from cablejax.perceive.registration import CurveFit, RegistrationConfig, register

ROTATION_WEIGHT = 0.15
"""Metres that one radian of a gripper's motion counts for."""
WIDENING = 1.5
"""Factor on the last standard deviation from which the next frame starts."""


class Status(enum.IntEnum):
    """What became of a frame."""

    TRACKED = 0
    """The cable was found in the cloud."""
    FEW_POINTS = 1
    """Held: the cloud is empty or nearly so."""
    NO_FIT = 2
    """Held: the cloud is not that of this cable between these grippers."""


@dataclasses.dataclass(frozen=True)
class TrackerConfig:
    """How clouds are followed.

    Attributes:
        registration: the cable and its registration.
        capacity: points that a frame is thinned or padded to.
        iterations: of registration per frame.
        reach: distance [m] within which a point supports the fit.
        min_points: a cloud of fewer points is not looked at.
        min_support: part of the cloud that must be within reach of the cable.
        min_seen: part of the cable that must have points.
        max_sigma: largest standard deviation of the points across the cable [m].
        max_curvature: largest curvature of the fit [1/m]. One that is too long for its cloud hides the rest in a fold.
        max_search: largest standard deviation that a frame starts from [m]. It starts from the last frame's, plus the
            way that the grippers have gone since.
        retry: the cable is looked for without a prior in the first frame that does not fit, and then every so many.
    """

    registration: RegistrationConfig = dataclasses.field(default_factory=RegistrationConfig)
    capacity: int = 2000
    iterations: int = 6
    reach: float = 0.015
    min_points: int = 30
    min_support: float = 0.75
    min_seen: float = 0.15
    max_sigma: float = 0.008
    max_curvature: float = 25.0
    max_search: float = 0.05
    retry: int = 5

    def __post_init__(self):
        for name in ("capacity", "iterations", "min_points", "retry"):
            if getattr(self, name) < 1:
                raise ValueError(f"TrackerConfig.{name} is {getattr(self, name)}, expected at least 1.")
        for name in ("reach", "max_sigma", "max_curvature", "max_search"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"TrackerConfig.{name} is {value}, expected a positive finite number.")
        for name in ("min_support", "min_seen"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"TrackerConfig.{name} is {getattr(self, name)}, expected a number in [0, 1].")


class TrackState(NamedTuple):
    """What is carried from frame to frame.

    Attributes:
        angles: joint angles of the chain [rad], shape [J].
        gripper_pose: of the same frame, turns counted, shape [Q, 3].
        sigma: standard deviation of the points across the cable [m], shape [].
        travel: way of the grippers since the cable was last found [m], shape [].
        lost: frames since the cable was last found, shape [].
        misfits: frames on end whose cloud did not fit, shape [].
        found: whether it ever was, shape [].
    """

    angles: Float[Array, "*b J"]
    gripper_pose: Float[Array, "*b Q 3"]
    sigma: Float[Array, "*b"]
    travel: Float[Array, "*b"]
    lost: Int[Array, "*b"]
    misfits: Int[Array, "*b"]
    found: Bool[Array, "*b"]


class Track(NamedTuple):
    """What is known after a frame.

    Attributes:
        keypoints: positions [m], shape [N, 2]; while lost, those last found, carried along with the grippers; NaN if
            the cable never was found.
        status: see `Status`, shape [].
        lost: frames since the cable was last found, shape [].
        sigma: standard deviation of the points across the cable [m], shape [].
        support: part of this cloud within reach of the fit, shape [].
        seen: part of the cable that has points, shape [].
    """

    keypoints: Float[Array, "*b N 2"]
    status: Int[Array, "*b"]
    lost: Int[Array, "*b"]
    sigma: Float[Array, "*b"]
    support: Float[Array, "*b"]
    seen: Float[Array, "*b"]


@functools.partial(jax.jit, static_argnames="config")
def track(
    config: TrackerConfig,
    state: TrackState,
    points: Float[Array, "S 2"],
    mask: Bool[Array, " S"],
    gripper_pose: Float[Array, "Q 3"],
) -> tuple[TrackState, Track]:
    """One frame, compiled and pure: register from the last state, judge, hold if it does not fit.

    Batched by `jax.vmap`. Piecewise differentiable as `register` is.

    Args:
        config: see `TrackerConfig`.
        state: after the last frame.
        points: the cloud on the table [m].
        mask: false where a row of `points` is only padding.
        gripper_pose: (x, y, theta) of both grippers now; angles may be given modulo a turn.
    """
    settings = config.registration
    step = gripper_pose - state.gripper_pose
    step = step.at[:, 2].set((step[:, 2] + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    pose = state.gripper_pose + step
    travel = state.travel + jnp.max(
        jnp.sqrt(jnp.sum(step[:, :2] ** 2, axis=-1) + (ROTATION_WEIGHT * step[:, 2]) ** 2 + 1e-16)
    )
    search = jnp.minimum(jnp.sqrt((WIDENING * state.sigma) ** 2 + travel**2), config.max_search)

    def fit(mask) -> CurveFit:
        return register(
            settings,
            points,
            mask,
            pose,
            state.angles,
            state.gripper_pose,
            search,
            iterations=config.iterations,
            reach=config.reach,
        )

    seen = fit(mask)
    status = judge(config, seen, jnp.sum(mask))
    status = jnp.where(~state.found & (status == Status.TRACKED), Status.NO_FIT, status)
    good = status == Status.TRACKED
    # Where the cloud is not to be trusted the registration without points carries the cable along.
    best = jax.lax.cond(good, lambda: seen, lambda: fit(jnp.zeros_like(mask)))
    lost = jnp.where(good, 0, state.lost + 1)
    after = TrackState(
        angles=best.angles,
        gripper_pose=pose,
        sigma=jnp.where(good, best.sigma, state.sigma),
        travel=jnp.where(good, 0.0, travel),
        lost=lost,
        misfits=jnp.where(status == Status.NO_FIT, state.misfits + 1, 0),
        found=state.found,
    )
    keypoints = jnp.where(state.found, best.keypoints, jnp.nan)
    return after, Track(keypoints, status, lost, seen.sigma, seen.support, seen.seen)


@functools.partial(jax.jit, static_argnames="config")
def judge(config: TrackerConfig, fit: CurveFit, count: Int[Array, ""]) -> Int[Array, ""]:
    """Whether a fit to a cloud of `count` points is that cloud's cable; see `Status`."""
    fits = (
        (fit.support >= config.min_support)
        & (fit.seen >= config.min_seen)
        & (fit.sigma <= config.max_sigma)
        & (fit.curvature <= config.max_curvature)
        & (fit.gap <= config.reach)
        & jnp.all(jnp.isfinite(fit.keypoints))
    )
    status = jnp.where(count < config.min_points, Status.FEW_POINTS, jnp.where(fits, Status.TRACKED, Status.NO_FIT))
    return status.astype(jnp.int32)


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
