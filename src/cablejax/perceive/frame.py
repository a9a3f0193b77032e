"""One frame of tracking, compiled: register from the last state, judge the fit, carry the cable along if none fits."""

from __future__ import annotations

import dataclasses
import enum
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cablejax.arrays import wrapped
from cablejax.limits import check
from cablejax.perceive.registration import CurveFit, RegistrationConfig, register
from cablejax.types import ROTATION_WEIGHT

WIDENING = 1.5
"""Factor on the last standard deviation from which the next frame starts."""


class Status(enum.IntEnum):
    """Outcome of a frame."""

    TRACKED = 0
    """The cable was found in the cloud."""
    FEW_POINTS = 1
    """Lost: the cloud is empty or nearly so."""
    NO_FIT = 2
    """Lost: the cloud is not that of this cable between these grippers."""


@dataclasses.dataclass(frozen=True)
class TrackerConfig:
    """Settings of the tracker.

    Attributes:
        registration: the cable and its registration.
        capacity: points that a frame is thinned or padded to.
        iterations: of registration per frame.
        reach: distance [m] within which a point supports the fit.
        min_points: smallest cloud that is registered.
        min_support: part of the cloud that must be within reach of the cable.
        min_seen: part of the cable that must have points.
        max_sigma: largest standard deviation of the points across the cable [m].
        max_curvature: largest curvature of the fit [1/m]: a cable that is too long for its cloud hides the surplus in a
            fold.
        max_search: largest initial standard deviation of a frame [m], which is the last frame's plus the distance that
            the grippers have moved since.
        retry: frames between searches without a prior, which begin with the first frame that does not fit.
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
        counts, sizes = ("capacity", "iterations", "min_points", "retry"), ("reach", "max_sigma", "max_curvature")
        check(self, **dict.fromkeys(counts, "count"), **dict.fromkeys((*sizes, "max_search"), "positive"))
        check(self, min_support="probability", min_seen="probability")
        if self.capacity < self.min_points:
            raise ValueError(
                f"TrackerConfig.capacity is {self.capacity}, expected at least min_points, {self.min_points}: every "
                "thinned cloud would have too few."
            )


class TrackState(NamedTuple):
    """State of the tracker between frames.

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
    """Estimate after a frame.

    Attributes:
        keypoints: positions [m], shape [N, 2]; while lost, those last found, carried along with the grippers; NaN if
            the cable never was found.
        status: see `Status`, shape [].
        lost: frames since the cable was last found, shape [].
        sigma: standard deviation of the points across the cable [m], shape [].
        support: part of this cloud within reach of the fit, shape [].
        seen: part of the cable that has points, shape [].
        curvature: largest of the fit [1/m], shape [].
        gap: by which the fit misses gripper 1 [m], see `CurveFit`, shape [].
    """

    keypoints: Float[Array, "*b N 2"]
    status: Int[Array, "*b"]
    lost: Int[Array, "*b"]
    sigma: Float[Array, "*b"]
    support: Float[Array, "*b"]
    seen: Float[Array, "*b"]
    curvature: Float[Array, "*b"]
    gap: Float[Array, "*b"]

    def observed(self, gripper_pose: Float[np.ndarray, "Q 3"]) -> Float[np.ndarray, "N 2"]:
        """What a controller may take for an observation: the ends at their grippers, NaN between them while lost.

        Args:
            gripper_pose: the frame's (x, y, theta) of both grippers [m, rad].
        """
        keypoints = np.array(self.keypoints, float)
        keypoints[[0, -1]] = np.asarray(gripper_pose)[:, :2]
        if self.status != Status.TRACKED:
            keypoints[1:-1] = np.nan
        return keypoints


def quality(fit: CurveFit) -> tuple[Array, ...]:
    """Quality of a fit: the last fields of a `Track`."""
    return fit.sigma, fit.support, fit.seen, fit.curvature, fit.gap


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
    step = step.at[:, 2].set(wrapped(step[:, 2]))
    pose = state.gripper_pose + step
    turned = ROTATION_WEIGHT * settings.length * step[:, 2]
    travel = state.travel + jnp.max(jnp.sqrt(jnp.sum(step[:, :2] ** 2, axis=-1) + turned**2 + 1e-16))
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
    return after, Track(keypoints, status, lost, *quality(seen))


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
