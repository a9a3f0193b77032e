"""Learns the dynamics model's errors online, by several candidates weighted by their past predictions.

A few samples may say more about noise than about the cable, and a correction that is wrong does harm in a closed loop.
So a candidate has to earn its influence. At every step each one predicts the model's error before it is seen, and is
weighed by the likelihood of what it has predicted so far,

    w_k  ~  (1 + d S_k / 2) ^ -(1 + d m / 2),      m = sum_t phi^(n - t),
    S_k  =  sum_t phi^(n - t) |error(t) - predicted_k(t)|^2 / (N s(t)^2)

with fading memory phi: the marginal likelihood of d independent Gaussian errors a step, of variance s(t)^2 up to an
unknown factor with an inverse gamma prior around 1. Models err in proportion to the motion, s(t)^2 = s^2 + (r |R|)^2: a
millimetre says much about a cable at rest, and little about one that moves by decimetres. Candidates are affine in
the command, so that their mixture is again one affine correction, and its squared error is at most the candidates'
weighted mean (Jensen's inequality).

The candidates are made of these parts:

- The share of the model's drift that does not take place. A model in whose data a cable relaxes predicts motion at
  rest; where friction holds the actual one, that is an error f(X, 0) of known direction and one unknown number, the
  share alpha in [0, 1] that all keypoints have in common. The correction is -alpha f(X, 0): with a share of 1, the
  corrected model predicts no motion without a command.
- The share of the model's response to the command that does not take place. Where friction holds the middle of a cable,
  its ends move with the grippers and it does not: one number beta_i for each keypoint. The correction is
  `-beta_i (df_i/dR) R`, with the derivative about no command. A regression on the command alone has six numbers for
  each coordinate, and where the grippers creep five samples do not determine them.
- Ridge regression on the command (`residual.ridge`, the paper's). It can express any error that is linear in the
  command, and needs decimetres of motion to learn it.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.limits import check, make_hashable
from cablejax.residual.jacobian import Linearised
from cablejax.residual.ridge import ResidualModel, RidgeConfig, apply, fit, zero_residual
from cablejax.types import ROTATION_WEIGHT


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One way to predict the model's error.

    Attributes:
        drift: whether it removes the share of the model's drift at rest that has not taken place.
        response: whether it removes each keypoint's share of the response to the command that has not taken place.
        ridge: regression of what is left on the command; None = no regression.
    """

    drift: bool = False
    response: bool = False
    ridge: RidgeConfig | None = None


_REGRESSION = RidgeConfig(regularisation=100.0, bias=False, forgetting=0.5, outlier=0.02)
"""Ten times the paper's penalty. A planner goes where the corrected model promises most, so that it finds the errors of
a regression on five samples; where they are shrunk too little, some runs on soft cables end centimetres away."""


@dataclasses.dataclass(frozen=True)
class LearnerConfig:
    """Settings of the online learner.

    Attributes:
        candidates: the candidates; a single one always has weight 1.
        window: samples W that they are fitted to.
        forgetting: weight ratio of a sample and the next newer one in fits of shares, in (0, 1].
        drift_floor: root mean square drift [m] below which the share of the drift is not learned, since the error is
            noise.
        response_floor: the same of a keypoint's response in all samples together, in units of s(t).
        memory: phi, by which evidence fades in one step, in (0, 1].
        error_std: s, root mean square error of a good prediction at rest [m].
        error_ratio: r, the same relative to the grippers' speed [s]: a tenth of their motion in a step of a second.
        rotation_weight: w [m/rad], turns a rotation into a length.
        outlier: root mean square error [m] beyond which a step that no candidate predicted counts less and less, as in
            `RidgeConfig`: a snap-through says little about any candidate.
        dimensions: d, independent numbers in the error of one step; neighbouring keypoints err alike.
    """

    candidates: tuple[Candidate, ...] = (
        Candidate(),
        Candidate(drift=True),
        Candidate(ridge=_REGRESSION),
        Candidate(drift=True, ridge=_REGRESSION),
        Candidate(response=True),
        Candidate(drift=True, response=True),
    )
    window: int = 5
    forgetting: float = 0.8
    drift_floor: float = 2e-4
    response_floor: float = 2.0
    memory: float = 0.8
    error_std: float = 2e-4
    error_ratio: float = 0.1
    rotation_weight: float = ROTATION_WEIGHT
    outlier: float = 0.02
    dimensions: float = 4.0

    def __post_init__(self):
        make_hashable(self, "candidates")
        every = self.candidates if isinstance(self.candidates, tuple) else ()
        if not every or not all(isinstance(candidate, Candidate) for candidate in every):
            raise ValueError(f"LearnerConfig.candidates are {self.candidates}, expected one `Candidate` or more.")
        check(
            self,
            window="count",
            forgetting="share",
            memory="share",
            drift_floor="length_scale",
            response_floor="positive",
            error_std="length_scale",
            error_ratio="positive",
            rotation_weight="positive",
            outlier="length_scale",
            dimensions="positive",
        )

    @property
    def needs_gain(self) -> bool:
        """Whether a candidate asks for the model's derivative by the command."""
        return any(candidate.response for candidate in self.candidates)

    def scaled(self, ratio: float, interval: float = 1.0) -> LearnerConfig:
        """The settings for a cable so many times as long, and a step of so many seconds instead of one."""

        def of(candidate: Candidate) -> Candidate:
            ridge = candidate.ridge
            return candidate if ridge is None else dataclasses.replace(candidate, ridge=ridge.scaled(ratio, interval))

        lengths = {
            name: ratio * getattr(self, name) for name in ("drift_floor", "error_std", "rotation_weight", "outlier")
        }
        candidates = tuple(map(of, self.candidates))
        return dataclasses.replace(self, candidates=candidates, error_ratio=interval * self.error_ratio, **lengths)


STATIC = LearnerConfig(candidates=tuple(one for one in LearnerConfig().candidates if not one.response))
"""For a model with the static prior: no response. Such a model predicts where the cable will lie, and not how far a
command moves it: shares of that derivative say little about friction."""
PAPER = LearnerConfig(candidates=(Candidate(ridge=RidgeConfig(bias=False)),))
"""The residual of Wang et al., RA-L 2022: ridge regression on the last five commands, without a bias."""


class Sample(NamedTuple):
    """One step, or with a leading axis W the last ones, oldest first.

    Attributes:
        error: observed displacement minus the offline model's [m], shape [N, 2].
        twist: the command [m/s, rad/s], shape [Q, 3].
        valid: keypoints whose error was observed, shape [N].
        model: the offline model about no command, where the step began.
    """

    error: Float[Array, "*batch N 2"]
    twist: Float[Array, "*batch Q 3"]
    valid: Bool[Array, "*batch N"]
    model: Linearised


class LearnerState(NamedTuple):
    """State of the learner: its samples, and the candidates' evidence.

    Attributes:
        window: the last W samples.
        evidence: S_k, the faded sum of the candidates' mean squared errors in units of s(t)^2, shape [K].
        count: the steps in it, faded alike, shape [].
        loss: the same sums over the run, not faded, and last that of the mixture, shape [K + 1].
    """

    window: Sample
    evidence: Float[Array, "*batch K"]
    count: Float[Array, "*batch"]
    loss: Float[Array, "*batch K1"]


def initial_learner(config: LearnerConfig, n_keypoints: int, n_grippers: int, dtype) -> LearnerState:
    """The state before the first sample, for N keypoints and Q grippers."""
    n, shape = len(config.candidates), (config.window, n_keypoints)
    window = Sample(
        error=jnp.zeros((*shape, 2), dtype),
        twist=jnp.zeros((config.window, n_grippers, 3), dtype),
        valid=jnp.zeros(shape, bool),
        model=Linearised(jnp.zeros((*shape, 2), dtype), jnp.zeros((*shape, 2, n_grippers, 3), dtype)),
    )
    return LearnerState(window, jnp.zeros(n, dtype), jnp.zeros((), dtype), jnp.zeros(n + 1, dtype))


def observe(config: LearnerConfig, state: LearnerState, sample: Sample) -> LearnerState:
    """The state with one more sample: candidates are first scored on it, then fitted to it.

    Values of `sample.error` where it is not valid are ignored, NaN included, as is what is not finite of the model and
    of the command.
    """
    model, twist = jax.tree.map(lambda x: jnp.nan_to_num(x, posinf=0.0, neginf=0.0), (sample.model, sample.twist))
    sample = sample._replace(model=model, twist=twist)
    window = jax.tree.map(lambda old, new: jnp.concatenate([old, new[None]])[1:], state.window, sample)
    models = _candidates(config, state.window, sample.model)
    mixture = _mixed(models, weights(config, state))
    error = jnp.where(sample.valid[:, None], sample.error, 0.0)
    predicted = jnp.stack([*(apply(model, sample.twist) for model in models), apply(mixture, sample.twist)])
    seen = jnp.sum(sample.valid)
    wrong = jnp.where(sample.valid[:, None], error - predicted, 0.0)
    squared = jnp.sum(wrong**2, axis=(1, 2)) / jnp.maximum(seen, 1)
    loss = squared / _expected(config, sample.twist)
    # as in the ridge: the weight of Geman and McClure
    telling = (1.0 + squared[:-1].min() / config.outlier**2) ** -2
    # a step of which nothing was seen is no evidence
    fade = jnp.where(seen > 0, config.memory, 1.0).astype(loss.dtype)
    return LearnerState(
        window=window,
        # an error too large to be squared is no evidence either
        evidence=fade * state.evidence + jnp.where(telling > 0, telling * loss[:-1], 0.0),
        count=fade * state.count + telling * (seen > 0),
        loss=state.loss + loss,
    )


def weights(config: LearnerConfig, state: LearnerState) -> Float[Array, " K"]:
    """Weight of each candidate, shape [K]; they sum to 1."""
    half = config.dimensions / 2.0
    return jax.nn.softmax(-(1.0 + half * state.count) * jnp.log1p(half * state.evidence))


def _expected(config: LearnerConfig, twist: Float[Array, "*batch Q 3"]) -> Float[Array, "*batch"]:
    """Mean squared error s(t)^2 of a good prediction [m^2]."""
    weight = jnp.asarray([1.0, 1.0, config.rotation_weight], twist.dtype)
    motion = jnp.mean(jnp.sum((weight * twist) ** 2, axis=-1), axis=-1)
    return config.error_std**2 + config.error_ratio**2 * motion


def learned(config: LearnerConfig, state: LearnerState, model: Linearised) -> ResidualModel:
    """The correction to plan with. Differentiable in `model` and the samples' errors and commands.

    Args:
        config: settings.
        state: after the newest sample.
        model: the offline model about no command, now.
    """
    return _mixed(_candidates(config, state.window, model), weights(config, state))


def _candidates(config: LearnerConfig, window: Sample, now: Linearised) -> list[ResidualModel]:
    n_keypoints, n_grippers = now.gain.shape[0], now.gain.shape[2]
    zero = jax.tree.map(lambda x: x.astype(now.drift.dtype), zero_residual(n_keypoints, n_grippers))
    at_rest, models = _drift_share(config, window), []
    for candidate in config.candidates:
        model, removed = zero, at_rest if candidate.drift else jnp.zeros_like(at_rest)
        left = window.error + removed * window.model.drift
        if candidate.response:
            response = jnp.einsum("wncqk,wqk->wnc", window.model.gain, window.twist)
            held = _response_share(config, window, left, response)
            left += held[:, None] * response
            gain = -(held[:, None, None, None] * now.gain).reshape(2 * n_keypoints, -1).T
            model = dataclasses.replace(model, gain=gain)
        if candidate.ridge is not None:
            fitted = fit(left, window.twist, window.valid, candidate.ridge)
            model = dataclasses.replace(fitted, gain=model.gain + fitted.gain)
        models.append(dataclasses.replace(model, bias=model.bias - removed * now.drift.ravel()))
    return models


def _trust(config: LearnerConfig, window: Sample) -> Float[Array, "W N 1"]:
    """The samples' weights where shares are fitted: by age, motion, and what was seen."""
    age = jnp.arange(config.window - 1, -1, -1)
    trust = (config.forgetting**age).astype(window.error.dtype) / _expected(config, window.twist)
    return trust[:, None, None] * window.valid[..., None]


def _drift_share(config: LearnerConfig, window: Sample) -> Float[Array, ""]:
    """Share alpha of the model's drift that has not taken place, in [0, 1]: least squares, shrunk towards 0."""
    weight, drift = _trust(config, window), window.model.drift
    error = jnp.where(window.valid[..., None], window.error, 0.0)
    floor = (config.drift_floor / config.error_std) ** 2 * drift.shape[1]
    return jnp.clip(-jnp.sum(weight * error * drift) / (jnp.sum(weight * drift**2) + floor), 0.0, 1.0)


def _response_share(
    config: LearnerConfig, window: Sample, error: Float[Array, "W N 2"], response: Float[Array, "W N 2"]
) -> Float[Array, " N"]:
    """Share beta of each keypoint's response that has not taken place, in [-1, 1]: below 0, it moves farther.

    Least squares, shrunk towards 0.
    """
    weight = _trust(config, window)
    error = jnp.where(window.valid[..., None], error, 0.0)
    size = jnp.sum(weight * response**2, axis=(0, 2)) + config.response_floor**2
    return jnp.clip(-jnp.sum(weight * error * response, axis=(0, 2)) / size, -1.0, 1.0)


def _mixed(models: list[ResidualModel], weight: Float[Array, " K"]) -> ResidualModel:
    """The candidates' weighted mean."""
    gain = sum(w * model.gain for w, model in zip(weight, models, strict=True))
    bias = sum(w * model.bias for w, model in zip(weight, models, strict=True))
    return ResidualModel(gain, bias)  # pyright: ignore[reportArgumentType]
