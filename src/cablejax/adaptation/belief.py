"""An extended Kalman filter on the two inputs of a conditioned model: stiffness and friction of the cable.

A conditioned model predicts `f(X, R; c)` with `c = cable_descriptor(...)`. The error of one step corrects c: with
H = df/dc at the estimate's mean,

    Lambda' = phi Lambda + (1 - phi) Lambda_0    c' = Lambda'^-1 (phi Lambda c + (1 - phi) Lambda_0 c_0)
    Lambda <- Lambda' + w H'H / sigma^2                                c <- c' + Lambda^-1 w H' (dX - f') / sigma^2

in information form, with phi = `memory` and the prior (c_0, Lambda_0): old evidence fades and the prior takes its
place, so that a changed cable is followed (stabilised forgetting, Kulhavy and Zarrop 1993). In slow motion only the
ratio of stiffness to friction is identifiable; in the other direction c stays at the prior's mean.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.limits import LIMITS, check, make_hashable, shown


@dataclasses.dataclass(frozen=True)
class AdaptationConfig:
    """Settings of the filter; logarithms are natural.

    Attributes:
        prior_mean: c_0, the log ratios of stiffness and friction to those of the reference cable before anything was
            seen: the mean of the model's training data, or what a diagnosis named.
        prior_std: their standard deviation: a factor of e either way.
        error_std: standard deviation of a keypoint's coordinate that no cable explains [m]. Errors of neighbouring
            keypoints are alike, so this is above the error of one.
        memory: phi, the share of the information that one step leaves, in (0, 1].
        outlier: root mean square error of one step, in units of `error_std`, beyond which it counts less and less: a
            cable that snaps through says nothing about its stiffness.
        max_step: largest change of a log ratio in one step: the model is linearised.
        limits: smallest and largest log ratio believed, of stiffness and of friction. `control.shaping.make_controller`
            takes those of the model's training data; the default is that of the released models, which record none.
    """

    prior_mean: tuple[float, float] = (0.0, 0.0)
    prior_std: float = 1.0
    error_std: float = 3e-3
    memory: float = 0.95
    outlier: float = 3.0
    max_step: float = 0.5
    limits: tuple[tuple[float, float], ...] = ((-2.4, 1.2), (-2.4, 1.2))

    def __post_init__(self):
        check(self, prior_std="positive", error_std="positive", memory="share", outlier="positive", max_step="positive")
        make_hashable(self, "prior_mean", "limits")
        if not _numbers(self.limits, (2, 2)) or not all(low <= high for low, high in self.limits):
            raise ValueError(
                f"AdaptationConfig.limits are {shown(self.limits)}, expected the smallest and the largest log ratio of "
                "stiffness, and those of friction."
            )
        pairs = zip(self.prior_mean, self.limits, strict=True) if _numbers(self.prior_mean, (2,)) else ()
        if not pairs or not all(low <= mean <= high for mean, (low, high) in pairs):
            raise ValueError(
                f"AdaptationConfig.prior_mean is {shown(self.prior_mean)}, expected the log ratios of stiffness and "
                f"friction within {self.limits}."
            )


def _numbers(values: object, shape: tuple[int, ...]) -> bool:
    """Whether a value is tuples of finite numbers of a shape."""
    if not shape:
        return values in LIMITS["finite"]
    return isinstance(values, tuple) and len(values) == shape[0] and all(_numbers(one, shape[1:]) for one in values)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class CableBelief:
    """Estimate of the cable after the observations so far.

    Attributes:
        mean: of the log ratios of stiffness and friction, see `cable_descriptor`, shape [2].
        information: inverse covariance, shape [2, 2].
    """

    mean: Float[Array, "*batch 2"]
    information: Float[Array, "*batch 2 2"]


def prior_belief(config: AdaptationConfig, dtype: Any = float) -> CableBelief:
    """The belief before any observation, in this type of numbers: that of the observations."""
    return CableBelief(
        mean=jnp.array(config.prior_mean, dtype), information=jnp.eye(2, dtype=dtype) / config.prior_std**2
    )


def update(
    config: AdaptationConfig,
    belief: CableBelief,
    sensitivity: Float[Array, "N 2 2"],
    error: Float[Array, "N 2"],
    valid: Bool[Array, " N"],
) -> CableBelief:
    """The belief after one more step. Differentiable in `sensitivity` and `error`; never leaves `config.limits`.

    Args:
        config: settings.
        belief: before.
        sensitivity: derivative of the model's displacement by `belief.mean` [m], shape [N, 2, 2]: keypoint, coordinate,
            log ratio.
        error: displacement that was observed minus that of the model [m], shape [N, 2].
        valid: keypoints whose error is known, shape [N]; values elsewhere are ignored, NaN included.
    """
    finite = valid & jnp.isfinite(error).all(axis=-1) & jnp.isfinite(sensitivity).all(axis=(-2, -1))
    rows = jnp.where(finite[:, None, None], sensitivity, 0.0).reshape(-1, 2) / config.error_std
    innovation = jnp.where(finite[:, None], error, 0.0).reshape(-1) / config.error_std
    size = jnp.sum(innovation**2) / jnp.maximum(2 * jnp.sum(finite), 1)
    # Geman and McClure's: the pull of an error falls as its third power, so that no snap-through moves the belief
    weight = 1.0 / (1.0 + size / config.outlier**2) ** 2
    prior = prior_belief(config, belief.mean.dtype)
    forgotten = (1.0 - config.memory) * prior.information
    faded = config.memory * belief.information + forgotten
    information = faded + weight * rows.T @ rows
    # what fades comes back as the prior: in a direction in which nothing is seen any more, the belief returns there
    # instead of drifting
    returning = jnp.linalg.solve(faded, forgotten @ (prior.mean - belief.mean))
    step = returning + jnp.linalg.solve(information, weight * rows.T @ (innovation - rows @ returning))
    step = jnp.clip(step, -config.max_step, config.max_step)
    low, high = jnp.asarray(config.limits, belief.mean.dtype).T
    return CableBelief(mean=jnp.clip(belief.mean + step, low, high), information=information)
