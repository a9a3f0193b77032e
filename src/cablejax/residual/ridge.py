"""Ridge regression of the dynamics model's error on the grippers' motion, from the last few samples.

The learned model errs on the actual cable. Within a small step its error is taken as linear in the command,
`delta = R J + b` (Wang et al., RA-L 2022, section "Online Residual Model Learning"), and `J`, `b` are fitted at every
control step to the last W samples.

Units decide what the penalty does. With `R` in metres, five steps of 5 cm by both grippers have `R'R = 0.025`, so the
paper's `lambda = 10` would shrink the residual 400 times: it would be switched off. Here one unit of the regressor is
one centimetre of motion, so the same window has `R'R = 250`: 4 % shrinkage at full speed, 50 % at 1 cm per step, and
nearly all of it once the grippers creep, where five samples say more about noise than about the response.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.limits import check, require
from cablejax.types import ROTATION_WEIGHT

BIAS_SCALE = 5.0
"""Value of the constant regressor; larger is a weaker penalty on the bias. At 5, five samples have `W * 5**2 = 125`, so
that lambda = 10 shrinks the bias by 7 %."""


@dataclasses.dataclass(frozen=True)
class RidgeConfig:
    """Settings of the residual fit.

    Attributes:
        regularisation: the penalty lambda on the scaled coefficients.
        motion_scale: gripper speed that counts as one unit of regressor [m/s]: a centimetre in a step of a second.
        rotation_weight: w [m/rad], turns a rotation into a length before scaling.
        bias: whether the error at rest is fitted too. Without a bias, an error that does not vanish with the motion (a
            wrong steady state, friction) is attributed to the gain, or ignored once the grippers are still.
        forgetting: weight ratio of a sample and the next newer one, in (0, 1]; 1 weighs all alike. On the way to a
            shape the error changes from step to step, so the newest sample says most about the next.
        outlier: root mean square error of a sample [m] beyond which it counts less and less. If model and cable follow
            different branches (one has snapped through, friction holds the other), the error is decimetres and not
            linear in the command; over a horizon, such a residual makes every plan look worse than standing still.
            Infinite = all samples count fully.
    """

    regularisation: float = 10.0
    motion_scale: float = 0.01
    rotation_weight: float = ROTATION_WEIGHT
    bias: bool = True
    forgetting: float = 1.0
    outlier: float = math.inf

    def __post_init__(self):
        check(
            self,
            regularisation="positive",
            motion_scale="positive",
            rotation_weight="positive",
            forgetting="share",
        )
        if self.outlier != math.inf:
            require(self.outlier, "positive", "RidgeConfig.outlier", "It is in metres; with infinity all count fully.")

    def scaled(self, ratio: float, interval: float = 1.0) -> RidgeConfig:
        """The settings scaled to another cable length and another duration of a step."""
        lengths = {name: ratio * getattr(self, name) for name in ("rotation_weight", "outlier")}
        return dataclasses.replace(self, motion_scale=ratio * self.motion_scale / interval, **lengths)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ResidualModel:
    """The error of a one-step model as an affine function of the command.

    Attributes:
        gain: J, displacement error per unit of twist [m / (m/s)] and [m / (rad/s)], shape [3Q, 2N].
        bias: displacement error at rest [m], shape [2N]; zero if it was not fitted.
    """

    gain: Float[Array, "*batch R C"]
    bias: Float[Array, "*batch C"]


def zero_residual(n_keypoints: int, n_grippers: int = 2) -> ResidualModel:
    """The residual that changes nothing, for N keypoints and Q grippers."""
    return ResidualModel(gain=jnp.zeros((3 * n_grippers, 2 * n_keypoints)), bias=jnp.zeros(2 * n_keypoints))


def fit(
    delta: Float[Array, "W N 2"],
    twist: Float[Array, "W Q 3"],
    valid: Bool[Array, " W"] | Bool[Array, "W N"],
    config: RidgeConfig,
) -> ResidualModel:
    """Ridge regression in closed form: the minimiser of `||S (dX - A C)||_F^2 + lambda ||C||_F^2` over C.

    `A = [R / scale, BIAS_SCALE]` are the W scaled regressors and S holds the square roots of the samples' weights
    (by age and by size, 0 where a sample is not valid). The minimiser is `C = (A' S^2 A + lambda I)^-1 A' S^2 dX`. (The
    paper prints it with regressors and targets swapped.) It is computed in its dual form,
    `C = (S A)' (S A A' S + lambda I)^-1 S dX`: the same C, from a W x W system (5 x 5) instead of one of 7 x 7, whose
    smallest eigenvalue, with no more samples than inputs, is never below that of the primal. All columns of one
    keypoint share a system; keypoints have their own because each may have been unobserved at other instants.

    Differentiable in `delta` and `twist`.

    Args:
        delta: error of the model's displacement, `X(t+1) - X(t) - f(X(t), R(t))` [m], shape [W, N, 2], oldest first.
        twist: commands that were held during these steps [m/s, rad/s], shape [W, Q, 3].
        valid: samples to use, per sample or per sample and keypoint, shape [W] or [W, N]. Values of `delta` that are
            not valid are ignored, NaN included.
        config: penalty, forgetting and units.

    Raises:
        ValueError: if the shapes do not belong together.
    """
    window, n_keypoints = (*delta.shape, 0, 0)[:2]
    fits = delta.ndim == 3 and twist.ndim == 3 and twist.shape[0] == window and twist.shape[2] == 3
    if not fits or valid.shape not in ((window,), (window, n_keypoints)):
        raise ValueError(
            f"Shapes delta {delta.shape}, twist {twist.shape}, valid {valid.shape} do not belong together: expected "
            "delta [W, N, 2], twist [W, Q, 3] and valid [W] or [W, N]."
        )
    valid = jnp.broadcast_to(valid.reshape(window, -1), (window, n_keypoints))
    delta = jnp.where(valid[..., None], delta, 0.0)
    twist = jnp.where(valid.any(axis=1)[:, None, None], twist, 0.0)

    units = _units(twist.shape[1], config).astype(twist.dtype)
    regressors = twist.reshape(window, -1) / units
    if config.bias:
        regressors = jnp.concatenate([regressors, jnp.full((window, 1), BIAS_SCALE, regressors.dtype)], axis=1)
    age = jnp.arange(window - 1, -1, -1)
    size = jnp.sum(delta**2, axis=(1, 2)) / jnp.maximum(jnp.sum(valid, axis=1), 1)
    # the root of Geman and McClure's weight
    belief = 1.0 / (1.0 + size / config.outlier**2)
    root_weight = valid * (belief * jnp.sqrt(config.forgetting**age))[:, None].astype(delta.dtype)

    coefficients = jax.vmap(_dual_ridge, in_axes=(None, 1, 1, None), out_axes=1)(
        regressors, delta, root_weight, config.regularisation
    )
    n_inputs = units.shape[0]
    gain = coefficients[:n_inputs].reshape(n_inputs, -1) / units[:, None]
    bias = coefficients[n_inputs] * BIAS_SCALE if config.bias else jnp.zeros_like(delta[0])
    return ResidualModel(gain=gain, bias=bias.reshape(-1))


def apply(model: ResidualModel, twist: Float[Array, "Q 3"]) -> Float[Array, "N 2"]:
    """Displacement that the residual adds to the model's [m]. Differentiable in every argument."""
    return (twist.reshape(-1) @ model.gain + model.bias).reshape(-1, 2)


def _units(n_grippers: int, config: RidgeConfig) -> Float[Array, " R"]:
    """Twist that counts as one unit of regressor, for each of the 3Q inputs."""
    one_gripper = [config.motion_scale, config.motion_scale, config.motion_scale / config.rotation_weight]
    return jnp.asarray(one_gripper * n_grippers)


def _dual_ridge(
    regressors: Float[Array, "W R"],
    target: Float[Array, "W 2"],
    root_weight: Float[Array, " W"],
    regularisation: float,
) -> Float[Array, "R 2"]:
    """Weighted ridge coefficients by the W x W dual system."""
    weighted = root_weight[:, None] * regressors
    gram = weighted @ weighted.T + regularisation * jnp.eye(regressors.shape[0], dtype=regressors.dtype)
    factor = jax.scipy.linalg.cho_factor(gram)
    return weighted.T @ jax.scipy.linalg.cho_solve(factor, root_weight[:, None] * target)
