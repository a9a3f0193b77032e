"""Computes the frictionless resting shapes of a cable at two pairs of gripper poses, compiled.

Without friction, a uniform inextensible cable clamped at both ends rests in a shape that depends on nothing but the
gripper poses and the branch it is on (up or down, S or mirrored S): not on its stiffness, not on its weight. This file
finds that shape by a few Newton steps on a chain of rigid links, from the observed keypoints before a command to the
poses after it. An error in the keypoints fades instead of adding up over a rollout, since they only choose the branch.

`Statics` describes a cable that is not uniform, not straight at rest, or clamped askew. The rest is left to the
network: friction, damping, snap-through.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import CubicSpline

from cablejax.arrays import turns
from cablejax.cable import Cable, Discretisation
from cablejax.effects.given import GivenEffect, with_effects
from cablejax.effects.physics import nominal_physics
from cablejax.simulate.composite import link_lengths, node_offsets
from cablejax.simulate.equilibrium import beyond_joints, links_of
from cablejax.simulate.keypoints import hermite_weights

LINKS = 25
"""Links of the chain. Its keypoints are within 2 mm of the exact elastica, a shape error that the network learns."""

SETTLING_STEPS = 2
"""Newton steps at the poses before the command."""

FOLLOWING_STEPS = 4
"""Newton steps at the poses after it."""

DAMPING = 0.3
"""Added to the second derivative, in units of EI / L (a stable cable's own is between 0 and 12): on the verge of
snapping through a Newton step would be without bound."""

MAX_TURN = 0.2
"""Largest change of a joint angle in one Newton step [rad]."""

_SMALL = 1e-6
# Clamps farther apart than so many lengths are brought nearer. A taut cable is shaped as it is, with its derivatives;
# where clamps are a hundred-thousandth farther apart the steps begin to wander.
_REACH = 1.000003


@dataclasses.dataclass(frozen=True)
class Statics:
    """A cable's parameters that determine its resting shape, besides length; by default uniform and straight when free.

    Attributes:
        stiffness: of each joint over their mean, J = LINKS - 1 of them; () = uniform. Only its course matters.
        rest_curvature: of each joint when free [1/m]; () = straight.
        rotation_offset: of the cable's clamp against either gripper's angle [rad].
        yielding: share of the first and of the last joint's angle by which the clamp there turns: a clamp that yields
            is a spring in series with the joint next to it, and `stiffness` has both.
    """

    stiffness: tuple[float, ...] = ()
    rest_curvature: tuple[float, ...] = ()
    rotation_offset: tuple[float, float] = (0.0, 0.0)
    yielding: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self):
        for name, count in (
            ("stiffness", (0, LINKS - 1)),
            ("rest_curvature", (0, LINKS - 1)),
            ("rotation_offset", (2,)),
            ("yielding", (2,)),
        ):
            values = tuple(getattr(self, name))
            object.__setattr__(self, name, values)
            if len(values) not in count or not np.isfinite(values).all():
                raise ValueError(f"Statics.{name} is {values}, expected {' or '.join(map(str, count))} finite numbers.")
        if self.stiffness and min(self.stiffness) <= 0:
            raise ValueError(f"Statics.stiffness has {min(self.stiffness)}, expected positive numbers.")
        if not all(0 <= share < 1 for share in self.yielding):
            raise ValueError(f"Statics.yielding is {self.yielding}, expected shares from 0 to below 1.")


def statics_with(effects: Iterable[GivenEffect], cable: Cable) -> Statics:
    """The statics with effects; effects that do not change the resting shape, such as friction, are ignored."""
    config = Discretisation(cable, n_links=LINKS)
    nominal = nominal_physics(config, np.float64)
    physics = with_effects(nominal, effects, config)
    softness = 1 / np.asarray(physics.stiffness, float)
    of_clamps = np.asarray(physics.rotation_compliance, float) * (LINKS - 1) / cable.length
    softness[[0, -1]] += of_clamps
    stiffness = 1 / (softness * np.asarray(nominal.stiffness, float))
    # a model has learned the rest curvature of its own cable
    curvature = np.asarray(physics.rest_curvature, float) - np.asarray(nominal.rest_curvature, float)
    return Statics(
        () if np.ptp(stiffness) == 0 else tuple((stiffness / stiffness.mean()).tolist()),
        () if not curvature.any() else tuple(curvature.tolist()),
        tuple(np.asarray(physics.rotation_offset, float).tolist()),
        tuple((of_clamps / softness[[0, -1]]).tolist()),
    )


class ChainMatrices(NamedTuple):
    """Constant matrices of one cable, NumPy or JAX arrays; n = LINKS, N keypoints, J = n - 1 joints.

    Attributes:
        tangents_of_keypoints, tangents_of_ends: tangents at the nodes of the clamped spline, shapes [n, N], [n, 2].
        keypoints_of_nodes, keypoints_of_tangents: Hermite weights of nodes and of tangents [m], shape [N, n].
        link_lengths, node_offsets: of the links [m], and from a link's start to its node [m], shape [n].
        arclengths: of the keypoints, from 0 to 1, shape [N].
        later: the later one of two joints, shape [J, J].
    """

    tangents_of_keypoints: Any
    tangents_of_ends: Any
    keypoints_of_nodes: Any
    keypoints_of_tangents: Any
    link_lengths: Any
    node_offsets: Any
    arclengths: Any
    later: Any


@functools.lru_cache(maxsize=32)
def chain(n_keypoints: int, length: float) -> ChainMatrices:
    """The matrices for a cable of given keypoints and length [m]. Not to be modified: cached."""
    config = Discretisation(Cable(length=length, n_keypoints=n_keypoints, diameter=1e-3 * length), n_links=LINKS)
    nodes = np.linspace(0.0, length, LINKS)

    def derivative(values: np.ndarray, first: float, last: float) -> np.ndarray:
        return CubicSpline(config.cable.keypoint_arclength, values, bc_type=((1, first), (1, last)))(nodes, 1)  # pyright: ignore[reportArgumentType]

    of_keypoints = np.stack([derivative(unit, 0.0, 0.0) for unit in np.eye(n_keypoints)], axis=1)
    zero = np.zeros(n_keypoints)
    of_ends = np.stack([derivative(zero, 1.0, 0.0), derivative(zero, 0.0, 1.0)], axis=1)
    # int32 whether or not JAX is in 64-bit mode
    joints = np.arange(LINKS - 1, dtype=np.int32)
    return ChainMatrices(
        of_keypoints,
        of_ends,
        *hermite_weights(config),
        link_lengths(config),
        node_offsets(config),
        np.asarray(config.cable.keypoint_arclength) / length,
        np.maximum.outer(joints, joints),
    )


def clamped(gripper_pose: Float[Array, "2 3"], statics: Statics) -> Float[Array, "2 3"]:
    """Poses of the cable's clamps at given gripper poses [m, rad]."""
    return gripper_pose + jnp.zeros((2, 3), gripper_pose.dtype).at[:, 2].set(jnp.array(statics.rotation_offset))


def resting_shapes(
    keypoints: Float[Array, "N 2"],
    before: Float[Array, "2 3"],
    after: Float[Array, "2 3"],
    *,
    length: float,
    statics: Statics = Statics(),
) -> tuple[Float[Array, "N 2"], Float[Array, "N 2"]]:
    """Frictionless resting shapes at the clamps' poses before and after a command, on the branch of `keypoints`.

    Turns and shifts with the cable. For a uniform, straight cable it does not depend on which end comes first. Exact at
    both clamps. Differentiable in all three arrays.

    Args:
        keypoints: observed positions [m], shape [N, 2].
        before: (x, y, theta) of both clamps, see `clamped`; theta the direction of the cable's tangent, shape [2, 3].
        after: the same after the command; theta continues that of `before`.
        length: free length of the cable [m].
        statics: what else is known of the cable; its rotation offset is in the poses already.
    """
    constants = chain(len(keypoints), length)
    matrices = ChainMatrices(*(jnp.asarray(m, keypoints.dtype) for m in constants[:-1]), later=constants.later)
    bending = _bending(statics, length, keypoints.dtype)
    angles = _observed_angles(matrices, keypoints, before)
    turn = jnp.sum(angles)
    reached = _within_reach(before, length)
    for _ in range(SETTLING_STEPS):
        angles = _newton_step(matrices, bending, angles, reached, turn, length)
    resting = _chain_keypoints(matrices, bending, angles, before, turn)
    turn = turn + (after[1, 2] - after[0, 2]) - (before[1, 2] - before[0, 2])
    reached = _within_reach(after, length)
    for _ in range(FOLLOWING_STEPS):
        angles = _newton_step(matrices, bending, angles, reached, turn, length)
    return resting, _chain_keypoints(matrices, bending, angles, after, turn)


def _within_reach(pose: Float[Array, "2 3"], length: float) -> Float[Array, "2 3"]:
    """The clamps' poses, the second on its way to the first hardly farther than the cable is long: no chain meets more.

    Without that the steps would wander where grippers are farther apart by an error of the length, or of a tool.
    """
    way = pose[1, :2] - pose[0, :2]
    squared = jnp.sum(way**2)
    reach = _REACH * length
    beyond = squared > reach**2
    nearer = pose[0, :2] + way * (reach / jnp.sqrt(jnp.where(beyond, squared, 1.0)))
    return pose.at[1, :2].set(jnp.where(beyond, nearer, pose[1, :2]))


class _Bending(NamedTuple):
    """Stiffness of each joint over the mean, the angle at which it is free of moment [rad], `Statics.yielding`."""

    stiffness: Float[Array, "J"]
    free: Float[Array, "J"]
    yielding: tuple[float, float]


def _bending(statics: Statics, length: float, dtype: Any) -> _Bending:
    joints = LINKS - 1
    stiffness = jnp.asarray(statics.stiffness or np.ones(joints), dtype)
    free = jnp.asarray(statics.rest_curvature or np.zeros(joints), dtype) * (length / joints)
    return _Bending(stiffness, free, statics.yielding)


def _links(
    matrices: ChainMatrices, bending: _Bending, angles: Array, pose: Array, turn: Array
) -> tuple[Float[Array, "n"], Float[Array, "n 2"]]:
    """Direction of every link [rad] and the vector along it [m]; where a clamp yields, its link turns with it."""
    theta, links = links_of(matrices.link_lengths, angles, _heading(angles, pose, turn))
    if not any(bending.yielding):
        return theta, links
    first, last = bending.yielding
    theta = theta.at[0].add(first * (angles[0] - bending.free[0])).at[-1].add(-last * (angles[-1] - bending.free[-1]))
    return theta, matrices.link_lengths[:, None] * jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=-1)


def _beyond(bending: _Bending, links: Float[Array, "n 2"]) -> Float[Array, "J 2"]:
    """What each joint's angle turns, as a vector to the far end [m]."""
    first, last = bending.yielding
    return beyond_joints(links).at[0].add(first * links[0]).at[-1].add(-last * links[-1])


def _observed_angles(matrices: ChainMatrices, keypoints: Array, pose: Array) -> Float[Array, "J"]:
    """Joint angles [rad] of the chain along the cubic spline through the keypoints, clamped in the grippers."""
    heading = jnp.stack([jnp.cos(pose[:, 2]), jnp.sin(pose[:, 2])], axis=-1)
    return turns(matrices.tangents_of_keypoints @ keypoints + matrices.tangents_of_ends @ heading)


def _heading(angles: Array, pose: Array, turn: Array) -> Float[Array, ""]:
    """Direction of the first link [rad]: what the angles lack of `turn` is shared by both grippers.

    Counted from gripper 0 alone, the steps would depend on which end of the cable comes first.
    """
    return pose[0, 2] + (turn - jnp.sum(angles)) / 2


def _newton_step(
    matrices: ChainMatrices, bending: _Bending, angles: Array, pose: Array, turn: Array, length: float
) -> Float[Array, "J"]:
    """One step on `min sum stiffness (angles - free)^2 / 2h`, the far end at gripper 1, the angles' sum `turn`."""
    joints = len(angles)
    h = length / joints
    moments = bending.stiffness * (angles - bending.free) / h
    _, links = _links(matrices, bending, angles, pose, turn)
    beyond, chord = _beyond(bending, links), jnp.sum(links, axis=0)
    # a joint turns what lies beyond it by half its angle, and what lies before it by as much the other way
    lever = beyond - chord / 2
    jacobian = jnp.stack([-lever[:, 1], lever[:, 0], jnp.full(joints, length, angles.dtype)])
    error = jnp.append(pose[1, :2] - pose[0, :2] - chord, (turn - jnp.sum(angles)) * length)
    normal = jacobian @ jacobian.T
    # relative regularisation: the constraints of a straight cable are dependent
    normal = normal + _SMALL * jnp.trace(normal) * jnp.eye(3, dtype=angles.dtype)
    tension = jnp.linalg.solve(normal, jacobian @ moments)
    pulled = beyond @ tension[:2]
    hessian = jnp.diag(bending.stiffness / h + DAMPING / length)
    # the far end's second derivative in two angles is minus what lies beyond the later one
    hessian = hessian + tension[0] * beyond[matrices.later, 0] + tension[1] * beyond[matrices.later, 1]
    hessian = hessian - (pulled[:, None] + pulled) / 2 + chord @ tension[:2] / 4
    system = jnp.block([[hessian, -jacobian.T], [-jacobian, -_SMALL * jnp.eye(3, dtype=angles.dtype)]])
    step = jnp.linalg.solve(system, jnp.concatenate([jacobian.T @ tension - moments, -error]))[:joints]
    largest = jnp.sqrt(jnp.max(step**2) + 1e-20)
    return angles + step * jnp.minimum(1.0, MAX_TURN / largest)


def _chain_keypoints(
    matrices: ChainMatrices, bending: _Bending, angles: Array, pose: Array, turn: Array
) -> Float[Array, "N 2"]:
    """Keypoints of the chain with these joint angles, what it misses gripper 1 by spread evenly along it."""
    theta, links = _links(matrices, bending, angles, pose, turn)
    tangents = jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=-1)
    origins = pose[0, :2] + jnp.cumsum(jnp.concatenate([jnp.zeros((1, 2), angles.dtype), links[:-1]]), axis=0)
    nodes = origins + matrices.node_offsets[:, None] * tangents
    missed = pose[1, :2] - pose[0, :2] - jnp.sum(links, axis=0)
    along = matrices.arclengths[:, None] * missed
    return matrices.keypoints_of_nodes @ nodes + matrices.keypoints_of_tangents @ tangents + along
