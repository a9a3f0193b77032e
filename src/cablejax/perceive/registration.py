"""Registration of one cloud: the most likely inextensible curve between the grippers, by expectation maximisation."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cablejax.arrays import quarter_turn
from cablejax.limits import check
from cablejax.perceive.curve import (
    Curve,
    CurveMatrices,
    carried,
    centre_jacobian,
    curve,
    curve_matrices,
    keypoints_of,
)
from cablejax.perceive.mixture import NEIGHBOURS, STRIDE, Moments, distance_to, embedding_stiffness, expectation
from cablejax.simulate.grasp import constrained_acceleration

COOLING = 0.9
"""Factor by which the standard deviation falls at least in an iteration, until it is settled. Left to the estimate it
would stay large in a cloud of many outliers, which then all seem to belong to the cable."""
TOGETHER = 1e-9
"""Distance of the grippers, in lengths of the cable, below which there is no direction from one to the other."""
MAX_TURN = 0.3
"""Largest change of a joint angle in one iteration [rad]."""


@dataclasses.dataclass(frozen=True)
class RegistrationConfig:
    """The cable to find, and the weight of each assumption about it.

    The three weights are in nats: breaking an assumption by one unit costs as much as one point of likelihood `1/e`.

    Attributes:
        length: free length of the cable between the grippers [m].
        n_keypoints: keypoints wanted, uniform in arc length, both ends included.
        n_links: links of the chain that is fitted.
        outlier_weight: mu, prior probability of an outlier.
        area: over which outliers are spread [m^2].
        min_sigma: least standard deviation of the points across the cable [m].
        settled_sigma: standard deviation [m] down to which annealing is forced: a plausible size of the noise and the
            cable's thickness.
        coherence: weight of coherent motion [1/m^2]: 1/2 of it times the squared norm of the displacement field.
        kernel_width: distance over which motion coheres, in lengths of the cable.
        structure: weight of the local linear embedding [1/m^2].
        bending: weight of the bending energy `1/2 int curvature^2 ds` [m]. A uniform cable rests where this energy is
            least, so the term hardly shifts it, and determines hidden stretches. It straightens a cable with permanent
            bends: use a smaller weight there.
    """

    length: float = 1.0
    n_keypoints: int = 13
    n_links: int = 41
    outlier_weight: float = 0.1
    area: float = 1.0
    min_sigma: float = 1e-3
    settled_sigma: float = 4e-3
    coherence: float = 1e3
    kernel_width: float = 0.2
    structure: float = 1e4
    bending: float = 100.0

    def __post_init__(self):
        scales = ("area", "min_sigma", "settled_sigma", "kernel_width", "bending")
        check(self, "length", coherence="not_negative", structure="not_negative", **dict.fromkeys(scales, "positive"))
        if not 0 < self.outlier_weight < 1:
            raise ValueError(
                f"RegistrationConfig.outlier_weight is {self.outlier_weight}, expected a number in (0, 1)."
            )
        least = STRIDE * (NEIGHBOURS + 1)
        if self.n_links < least or self.n_keypoints < 2:
            raise ValueError(
                f"RegistrationConfig has {self.n_links} links and {self.n_keypoints} keypoints, expected at least "
                f"{least} links and 2 keypoints."
            )

    @property
    def matrices(self) -> CurveMatrices:
        """Constant matrices of this cable."""
        return curve_matrices(self.n_links, self.n_keypoints, self.length, self.kernel_width)


class CurveFit(NamedTuple):
    """A cable fitted to a cloud.

    Attributes:
        angles: joint angles of the chain [rad], shape [J].
        gripper_pose: where its ends are, shape [Q, 3].
        keypoints: positions uniform in arc length [m], shape [N, 2].
        sigma: standard deviation of the points across the cable [m], shape [].
        log_posterior: log likelihood of the cloud less the cost of bending, to compare fits of one cloud [nats], shape
            [].
        support: part of the cloud that lies within reach of the curve, shape [].
        seen: part of the cable that has points, shape [].
        curvature: the largest of the curve [1/m], shape [].
        gap: distance [m] by which the curve misses gripper 1, or by which its turn does in rad L, shape [].
    """

    angles: Float[Array, "*b J"]
    gripper_pose: Float[Array, "*b Q 3"]
    keypoints: Float[Array, "*b N 2"]
    sigma: Float[Array, "*b"]
    log_posterior: Float[Array, "*b"]
    support: Float[Array, "*b"]
    seen: Float[Array, "*b"]
    curvature: Float[Array, "*b"]
    gap: Float[Array, "*b"]


@functools.partial(jax.jit, static_argnames=("config", "iterations", "coherent", "reach"))
def register(
    config: RegistrationConfig,
    points: Float[Array, "S 2"],
    mask: Bool[Array, " S"],
    gripper_pose: Float[Array, "Q 3"],
    angles: Float[Array, "J"],
    angles_pose: Float[Array, "Q 3"],
    sigma: Float[Array, ""],
    *,
    iterations: int,
    coherent: bool = True,
    reach: float = 0.015,
) -> CurveFit:
    """Fits the cable to a cloud, starting from a known curve.

    Each iteration is one step of expectation maximisation. The M-step is a Gauss-Newton step on the joint angles under
    the constraint that the curve ends in gripper 1. The standard deviation is estimated again in each iteration; it may
    fall to half at once but not grow, so a large start value anneals.

    Differentiable in `points`, `gripper_pose`, `angles`, `angles_pose` and `sigma`, in both modes, through all
    iterations; not in the configuration. Batched by `jax.vmap`.

    Args:
        config: the cable.
        points: the cloud on the table [m].
        mask: false where a row of `points` is only padding.
        gripper_pose: (x, y, theta) [m, rad] of both grippers; theta is the direction of the cable's tangent and
            `theta_1 - theta_0` counts the turns between them.
        angles: joint angles [rad] of the curve to start from.
        angles_pose: the gripper poses of that curve.
        sigma: standard deviation to start from [m].
        iterations: steps of expectation maximisation.
        coherent: whether the displacement from the start shall be coherent and keep its structure. Without it only
            bending is penalised, for a start that is a mere guess.
        reach: distance [m] within which a point counts as support.
    """
    matrices = config.matrices
    dtype = points.dtype
    # what is padding may be anything, NaN included
    points = jnp.where(mask[:, None], points, 0.0)
    start = curve(matrices, angles, angles_pose)
    reference = carried(matrices, start.centre, angles_pose, gripper_pose)
    if coherent:
        tie = config.coherence * jnp.asarray(matrices.stiffness_of_motion, dtype)
        keep = config.structure * embedding_stiffness(reference)
    else:
        tie = keep = jnp.zeros((config.n_links, config.n_links), dtype)

    def iterate(carry, _):
        angles, sigma = carry
        shape = curve(matrices, angles, gripper_pose)
        moments = _expectation(config, points, mask, shape, sigma)
        angles = angles + _maximisation(config, shape, moments, angles, gripper_pose, reference, tie, keep, sigma)
        return (angles, _deviation(config, moments, sigma)), None

    # The turn is made up for at once, evenly: the iterations then only have to close the remaining gap.
    turn = (gripper_pose[1, 2] - gripper_pose[0, 2]) - jnp.sum(angles)
    angles = angles + turn / len(angles)
    (angles, sigma), _ = jax.lax.scan(iterate, (angles, jnp.asarray(sigma, dtype)), length=iterations)
    return _assess(config, points, mask, angles, gripper_pose, sigma, reach)


def _expectation(config: RegistrationConfig, points, mask, shape: Curve, sigma) -> Moments:
    return expectation(
        points,
        mask,
        shape,
        config.matrices.lengths,
        sigma,
        outlier_weight=config.outlier_weight,
        area=config.area,
    )


def _deviation(config: RegistrationConfig, moments: Moments, sigma) -> Float[Array, ""]:
    """Standard deviation across the cable that explains the residuals, within what annealing allows."""
    total = jnp.sum(moments.weight)
    variance = jnp.sum(moments.across_squared) / jnp.maximum(total, 1.0)
    estimate = jnp.sqrt(jnp.maximum(variance, config.min_sigma**2))
    largest = jnp.maximum(COOLING * sigma, jnp.minimum(sigma, config.settled_sigma))
    return jnp.where(total > 1.0, jnp.clip(estimate, jnp.maximum(0.5 * sigma, config.min_sigma), largest), sigma)


def _maximisation(
    config: RegistrationConfig, shape: Curve, moments: Moments, angles, pose, reference, tie, keep, sigma
) -> Float[Array, "J"]:
    """Gauss-Newton step of the penalised likelihood on the curves that end in gripper 1."""
    matrices = config.matrices
    dtype = angles.dtype
    spacing = config.length / (config.n_links - 1)
    of_centre = centre_jacobian(matrices, shape)
    across = jnp.einsum("kjd,kd->kj", of_centre, quarter_turn(shape.tangent))
    turn = jnp.asarray(matrices.beyond, dtype)
    # A link that shifts by u across and turns by v changes the residual of a point at `a` to r - u - a v.
    precision = 1.0 / sigma**2
    shift = moments.weight[:, None] * across + moments.along[:, None] * turn
    swing = moments.along[:, None] * across + moments.along_squared[:, None] * turn
    hessian = precision * (across.T @ shift + turn.T @ swing)
    force = precision * (across.T @ moments.across + turn.T @ moments.along_across)
    for axis in range(2):
        jacobian, centre = of_centre[..., axis], shape.centre[:, axis]
        hessian = hessian + jacobian.T @ ((tie + keep) @ jacobian)
        force = force - jacobian.T @ (tie @ (centre - reference[:, axis]) + keep @ centre)
    hessian = hessian + (config.bending / spacing) * jnp.eye(len(angles), dtype=dtype)
    force = force - config.bending / spacing * angles
    arm = shape.end - shape.joint
    # along and across the chord: a taut cable cannot move along it, whatever its heading. The step is the same in every
    # frame, so no derivative passes through this one, and grippers at one point have that of the table.
    chord = jax.lax.stop_gradient(pose[1, :2] - pose[0, :2])
    apart = jnp.sqrt(jnp.sum(chord**2))
    far = apart > TOGETHER * config.length
    chord = jnp.where(far, chord / jnp.where(far, apart, 1.0), jnp.eye(2, dtype=dtype)[0])
    frame = jnp.stack([chord, quarter_turn(chord)])
    constraint = jnp.concatenate([frame @ quarter_turn(arm).T, jnp.full((1, len(angles)), config.length, dtype)])
    gap = _closure(config, shape, angles, pose)
    error = jnp.concatenate([frame @ gap[:2], gap[2:]])
    step = constrained_acceleration(hessian, force, constraint, error)
    return step * jnp.minimum(1.0, MAX_TURN / jnp.sqrt(jnp.max(step**2) + 1e-20))


def _closure(config: RegistrationConfig, shape: Curve, angles, pose) -> Float[Array, "3"]:
    """Gap between the curve's end and gripper 1: position [m], and turn in units of the length."""
    turn = (pose[1, 2] - pose[0, 2]) - jnp.sum(angles)
    return jnp.concatenate([pose[1, :2] - shape.end, config.length * turn[None]])


def _assess(config: RegistrationConfig, points, mask, angles, pose, sigma, reach) -> CurveFit:
    shape = curve(config.matrices, angles, pose)
    moments = _expectation(config, points, mask, shape, sigma)
    spacing = config.length / (config.n_links - 1)
    count = jnp.maximum(jnp.sum(mask), 1)
    near = mask & (distance_to(points, shape, config.matrices.lengths) < reach)
    # A link has been seen if it answers for a tenth of its even share of the points, and for one at least.
    share = count * jnp.asarray(config.matrices.lengths / config.length, angles.dtype)
    bending = 0.5 * config.bending / spacing * jnp.sum(angles**2)
    return CurveFit(
        angles=angles,
        gripper_pose=pose,
        keypoints=keypoints_of(config.matrices, shape),
        sigma=sigma,
        log_posterior=moments.log_likelihood - bending,
        support=jnp.sum(near) / count,
        seen=jnp.mean(moments.weight > jnp.maximum(0.1 * share, 1.0)),
        curvature=jnp.max(jnp.abs(angles)) / spacing,
        gap=jnp.max(jnp.abs(_closure(config, shape, angles, pose))),
    )
