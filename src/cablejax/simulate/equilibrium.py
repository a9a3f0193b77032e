"""Static equilibrium of the planar chain with both ends clamped, without friction.

Minimises the bending energy `sum_i phi_i^2` of a uniform cable over the joint angles phi, subject to the far end's
position and tangent, by Newton's method in the null space of the constraints. A rest curvature that is the same
everywhere does not change the minima, because the clamps fix the whole turn. Negative curvature is reflected, so that
the iteration ends in a minimum, a shape in which a real cable would rest. Only from a guess with a symmetry that no
minimum has may it end in a saddle: `Equilibrium.stability` is below 0 there.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from cablejax.arrays import wrapped
from cablejax.cable import Discretisation
from cablejax.simulate.compiled_equilibrium import joints, settle
from cablejax.simulate.composite import link_lengths
from cablejax.types import CableState

FEWEST_LINKS = 5
"""Links of a chain that both grippers' poses leave a joint to move: four joints against three conditions."""


def links_of(lengths: Any, angles: Any, heading: Any) -> tuple[Any, Any]:
    """Direction of every link [rad], shape [n], and the vector along it [m], shape [n, 2]. NumPy or JAX arrays.

    Args:
        lengths: of the links [m], shape [n].
        angles: of the joints between them [rad], shape [n - 1].
        heading: direction of the first link [rad].
    """
    xp = angles.__array_namespace__()
    theta = heading + xp.concatenate([xp.zeros(1, dtype=angles.dtype), xp.cumsum(angles)])
    return theta, lengths[:, None] * xp.stack([xp.cos(theta), xp.sin(theta)], axis=-1)


def beyond_joints(links: Any) -> Any:
    """Vector from every joint to the far end [m], shape [n - 1, 2]: what lies beyond a joint turns about it."""
    return links[::-1].cumsum(axis=0)[::-1][1:]


@dataclasses.dataclass(frozen=True)
class Equilibrium:
    """A shape in which the frictionless cable rests.

    Attributes:
        angles: joint angles [rad], shape [J].
        stability: smallest eigenvalue of the bending energy's second derivative along the constraints, in units of
            EI / L: 0 where the cable is about to snap through.
    """

    angles: Float[np.ndarray, "J"]
    stability: float


def find_equilibrium(
    config: Discretisation, gripper_pose: Float[np.ndarray, "2 3"], guess: Float[np.ndarray, "J"]
) -> Equilibrium:
    """The settled cable between two planar gripper poses, near the joint angles `guess` [rad].

    Raises:
        ValueError: the chain has fewer links than `FEWEST_LINKS`, the poses are out of reach of the cable, or the
            iteration does not settle.
    """
    pose = np.asarray(gripper_pose, np.float64)
    if not np.all(np.isfinite(pose)):
        raise ValueError(f"The gripper poses contain NaN or infinity: {pose.tolist()}.")
    span = np.linalg.norm(pose[1, :2] - pose[0, :2])
    if span > config.cable.length * (1 + 1e-9):
        raise ValueError(
            f"The grippers are {span:.4f} m apart, more than the cable's length of {config.cable.length} m: bring them "
            "closer."
        )
    if span > config.cable.length * (1 - 1e-9):
        return _taut(config, pose)
    if config.n_links < FEWEST_LINKS:
        raise ValueError(
            f"A chain of {config.n_links} links cannot move between two grippers, expected at least {FEWEST_LINKS} "
            "links."
        )
    angles, stability, off = settle(link_lengths(config), pose, np.array(guess, np.float64))
    if np.isnan(stability):
        raise ValueError(
            f"No equilibrium found between gripper poses {pose.tolist()}: the remaining error of the far end is "
            f"{off:.2e}. Give a `guess` nearer to the shape, or poses further from taut."
        )
    return Equilibrium(angles=angles, stability=float(stability * config.cable.length))


def _taut(config: Discretisation, pose: Float[np.ndarray, "2 3"]) -> Equilibrium:
    """The only shape of a cable as long as the grippers are apart: straight."""
    chord = pose[1, :2] - pose[0, :2]
    off = np.abs(wrapped(pose[:, 2] - np.arctan2(chord[1], chord[0]))).max()
    turned = max(off, abs(pose[1, 2] - pose[0, 2]))
    if turned > 1e-6:
        raise ValueError(
            f"The grippers are a whole cable length apart, but turned by {turned:.3g} rad from the line between them "
            "or against each other: a taut cable can only be straight. Bring them closer, or align them."
        )
    return Equilibrium(angles=np.zeros(config.n_joints), stability=np.inf)


def chain_nodes(
    config: Discretisation, gripper_pose: Float[np.ndarray, "2 3"], angles: Float[np.ndarray, "J"]
) -> Float[np.ndarray, "J 2"]:
    """Positions of the bending joints [m] of the chain that leaves gripper 0."""
    return joints(link_lengths(config), np.asarray(gripper_pose, np.float64), np.asarray(angles, np.float64))


def arch_angles(config: Discretisation, gripper_pose: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "J"]:
    """A first guess for `find_equilibrium`: the tangent turns linearly between the ends, plus one gentle arch."""
    pose = np.asarray(gripper_pose, np.float64)
    span = np.linalg.norm(pose[1, :2] - pose[0, :2]) / config.cable.length
    fraction = np.linspace(0.0, 1.0, config.n_links)
    chord = np.arctan2(pose[1, 1] - pose[0, 1], pose[1, 0] - pose[0, 0])
    # An arch theta = a sin(2 pi s) shortens the span by a^2 / 4. The side is that to which the ends already lean.
    lean = wrapped(pose[0, 2] - chord) - wrapped(pose[1, 2] - chord)
    amplitude = 2.0 * np.sqrt(max(1.0 - span, 1e-6))
    theta = pose[0, 2] + (pose[1, 2] - pose[0, 2]) * fraction
    if abs(lean) < 1.0:
        theta += np.sign(lean if lean else 1.0) * min(amplitude, 1.5) * np.sin(2 * np.pi * fraction)
    return np.diff(theta)


def angles_of_keypoints(
    config: Discretisation, gripper_pose: Float[np.ndarray, "2 3"], keypoints: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, "J"]:
    """Joint angles of the chain through given keypoints; missing ones (NaN) are bridged.

    As many points as the cable has keypoints are taken to be at its marks, others to be evenly spaced.
    """
    pose = np.asarray(gripper_pose, np.float64)
    points = np.asarray(keypoints, np.float64)
    seen = np.all(np.isfinite(points), axis=1)
    if seen.sum() < 3:
        raise ValueError(f"Only {seen.sum()} of {len(points)} keypoints are finite, expected at least 3 as a guess.")
    marks = config.cable.keypoint_arclength
    arclength = (marks if len(points) == len(marks) else np.linspace(0.0, config.cable.length, len(points)))[seen]
    tangents = np.unwrap(np.arctan2(*np.diff(points[seen], axis=0).T[::-1]))
    tangents += 2 * np.pi * np.round((pose[0, 2] - tangents[0]) / (2 * np.pi))
    s = np.concatenate([[0.0], (arclength[1:] + arclength[:-1]) / 2, [config.cable.length]])
    theta = np.concatenate([[pose[0, 2]], tangents, [pose[1, 2]]])
    nodes = np.arange(config.n_links) * config.link_length
    return np.diff(np.interp(nodes, s, theta))


def equilibrium_state(config: Discretisation, gripper_pose, *, guess=None) -> CableState:
    """The settled cable as a `CableState`, for one pair of grippers or a batch `[*B, Q, P]`.

    Raises:
        ValueError: wrong shape, grippers out of reach, or spatial poses that do not share a plane.
    """
    pose = np.asarray(gripper_pose, np.float64)
    width = 3 if config.dimension == 2 else 7
    if pose.shape[-2:] != (2, width):
        raise ValueError(f"gripper_pose has shape {pose.shape}, expected (..., 2, {width}).")
    batch = pose.shape[:-2]
    flat = pose.reshape(-1, 2, width)
    guesses = [None] * len(flat)
    if guess is not None:
        shape = np.shape(guess)
        if len(shape) != len(batch) + 2 or shape[:-2] != batch or shape[-1] != config.dimension:
            expected = ", ".join(map(str, (*batch, "N", config.dimension)))
            raise ValueError(f"guess has shape {shape}, expected ({expected}): keypoints for each pair of grippers.")
        guesses = np.asarray(guess).reshape(len(flat), *shape[-2:])
    solve = _planar_qpos if config.dimension == 2 else _spatial_qpos
    qpos = np.stack([solve(config, p, g) for p, g in zip(flat, guesses, strict=True)])
    nv = config.n_joints + 3 if config.dimension == 2 else 3 * config.n_joints + 6
    return CableState(
        qpos=jnp.asarray(qpos.reshape(*batch, -1), float),
        qvel=jnp.zeros((*batch, nv)),
        gripper_pose=jnp.asarray(pose, float),
    )


def _planar_qpos(config, pose, guess):
    start = arch_angles(config, pose) if guess is None else angles_of_keypoints(config, pose, guess)
    return np.concatenate([pose[0], find_equilibrium(config, pose, start).angles])


def _spatial_qpos(config, pose, guess):
    """Spatial poses in one plane, the grippers not twisted against each other: a planar problem, tilted."""
    frames = Rotation.from_quat(pose[:, 3:], scalar_first=True).as_matrix()
    chord = pose[1, :3] - pose[0, :3]
    tangents = [frame[:, 0] for frame in frames]
    vectors = np.stack([chord / max(np.linalg.norm(chord), 1e-12), *tangents])
    normal = np.linalg.svd(vectors)[2][-1]
    if np.abs(vectors @ normal).max() > 1e-6:
        raise ValueError(
            "Spatial gripper poses must share a plane with the line between them for an initial equilibrium. Start "
            "from coplanar grippers and move them by a rollout."
        )
    # of the planes that contain a straight cable, take one that the grippers' own axes suggest
    if np.linalg.matrix_rank(vectors, tol=1e-6) == 1:
        normal = frames[0][:, 2]
    axis = frames[0].T @ normal
    in_plane = np.cross(normal, tangents[0])
    angle = np.arctan2(tangents[1] @ in_plane, tangents[1] @ tangents[0])
    turned = Rotation.from_rotvec(normal * angle).as_matrix()
    if np.abs(turned @ frames[0] - frames[1]).max() > 1e-6:
        raise ValueError(
            "The grippers are twisted against each other about the cable's axis. Start untwisted and turn one by a "
            "rollout."
        )
    planar = np.array([[0.0, 0.0, 0.0], [chord @ tangents[0], chord @ in_plane, angle]])
    flat_guess = None
    if guess is not None:
        relative = guess - pose[0, :3]
        flat_guess = np.stack([relative @ tangents[0], relative @ in_plane], axis=1)
    angles = _planar_qpos(config, planar, flat_guess)[3:]
    joints = Rotation.from_rotvec(axis * angles[:, None]).as_quat(scalar_first=True)
    return np.concatenate([pose[0], joints.ravel()])
