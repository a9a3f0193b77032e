"""Initialisation: finds the cable in one cloud, given only the poses of the grippers at its ends.

Two kinds of guesses compete. Paths along the cloud: the shortest way from gripper to gripper over a graph of occupied
cells, where a jump costs more than the same distance in small steps. And bent curves that need no cloud: arches,
S-curves and loops to both sides. All are registered at once; the most likely one that explains
the cloud wins.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from cablejax.arrays import wrapped
from cablejax.limits import LIMITS
from cablejax.perceive.registration import CurveFit, RegistrationConfig, register

CELL = 0.01
"""Side of the cells that a cloud is thinned to, in lengths of the cable."""
NEIGHBOURS = 24
"""Cells that each cell is connected to: the nearest ones."""
PATH_POINTS = 161
"""Points of the path."""
SMOOTHING = 4.0
"""Standard deviation of the smoothing along the path, in points."""
JUMPS = (2.0, 4.0)
"""Paths to try: powers of the step length that they pay."""
BOWS = (1.2, -1.2, 2.2, -2.2)
"""Amplitudes [rad] of the arches and S-curves."""
GUESS_SIGMA, PATH_SIGMA = 0.1, 0.03
"""Standard deviation from which the guesses anneal, in lengths of the cable: those without the cloud, and along it."""
ITERATIONS = 30
"""Iterations of each guess on the sample."""
SAMPLE = 500
"""Points by which the guesses are judged at first; the best few are refined with all."""
FINALISTS, REFINEMENTS = 4, 8
"""How many guesses are refined with all points, and by how many iterations."""
SAME = 0.01
"""Mean distance of keypoints, in lengths, up to which two fits are the same."""


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
        ValueError: the points have another shape or are not real numbers.
    """
    array = np.asarray(points)
    if array.size == 0:
        array = np.zeros((0, 2))
    if array.ndim != 2 or array.shape[1] not in (2, 3) or array.dtype.kind not in "iuf":
        raise ValueError(
            f"A cloud has shape {array.shape} and type {array.dtype}, expected real numbers of shape [n, 2] or [n, 3]: "
            "one row per point, in metres, in the frame of the grippers."
        )
    # cameras report what they do not see as not finite, or as a number without meaning
    finite = (np.abs(array) <= LIMITS["coordinate"].high).all(axis=1)
    kept = array[finite, :2].astype(np.float32)
    if len(kept) > capacity:
        kept = kept[np.random.default_rng(0).choice(len(kept), capacity, replace=False)]
    rows = np.zeros((capacity, 2), np.float32)
    rows[: len(kept)] = kept
    return PaddedCloud(rows, np.arange(capacity) < len(kept), int(np.sum(~finite)))


def cloud_path(
    points: Float[np.ndarray, "S 2"], gripper_pose: Float[np.ndarray, "Q 3"], length: float, power: float = 2.0
) -> Float[np.ndarray, "M 2"]:
    """The shortest path over the cloud from gripper to gripper, smoothed, uniform in arc length [m].

    Args:
        points: the cloud on the table [m], no padding, not empty.
        gripper_pose: (x, y, theta) of both grippers; only the positions count.
        length: of the cable [m], the scale of the cells.
        power: of the step length that a path pays: the higher, the more it avoids jumps between points.
    """
    ends = np.asarray(gripper_pose, float)[:, :2]
    cell = CELL * length
    _, label, count = np.unique(np.round(points / cell), axis=0, return_inverse=True, return_counts=True)
    label = label.ravel()
    middle = np.stack([np.bincount(label, points[:, axis]) for axis in range(2)], axis=1) / count[:, None]
    crowd = KDTree(middle).query_ball_point(middle, 2.5 * cell, return_length=True)
    middle = middle[(crowd >= min(3, crowd.max())) & (count >= 0.2 * np.median(count))]
    nodes = np.concatenate([ends, middle])
    nearest = min(len(nodes), NEIGHBOURS)
    distance, neighbour = map(np.asarray, KDTree(nodes).query(nodes, k=nearest))
    row = np.repeat(np.arange(len(nodes)), nearest)
    # The grippers reach everything, so that there always is a path, however bad.
    direct = np.linalg.norm(nodes[:, None] - nodes[:2], axis=-1)
    start = np.concatenate([row, np.tile(np.arange(len(nodes)), 2)])
    end = np.concatenate([neighbour.ravel(), np.repeat([0, 1], len(nodes))])
    cost = (np.concatenate([distance.ravel(), direct.T.ravel()]) / cell) ** power
    pairs, index = np.unique(np.stack([start, end]), axis=1, return_index=True)
    # of no length, but an edge: nodes may be at one place
    cost = np.maximum(cost[index], np.finfo(float).tiny)
    graph = coo_matrix((cost, pairs), shape=(len(nodes), len(nodes))).tocsr()
    _, previous = dijkstra(graph, directed=False, indices=0, return_predecessors=True)
    path = [1]
    while path[-1] != 0:
        path.append(int(previous[path[-1]]))
    line = nodes[path[::-1]]
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    u = np.linspace(0.0, travelled[-1], PATH_POINTS)
    even = np.stack([np.interp(u, travelled, line[:, axis]) for axis in range(2)], axis=1)
    return gaussian_filter1d(even, SMOOTHING, axis=0, mode="nearest")


def path_length(path: Float[np.ndarray, "M 2"]) -> float:
    """Length of a polyline [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def first_fit(
    config: RegistrationConfig,
    points: Float[np.ndarray, "S 2"],
    mask: Bool[np.ndarray, " S"],
    gripper_pose: Float[np.ndarray, "Q 3"],
    *,
    reach: float,
) -> CurveFit:
    """The most likely cable in a cloud, without any prior.

    Not differentiable: it chooses. Deterministic.

    Args:
        config: the cable.
        points: the cloud on the table [m]; rows outside `mask` are padding.
        mask: at least one true.
        gripper_pose: (x, y, theta) of both grippers; turns between them are found, not read.
        reach: see `register`.

    Returns:
        The fit. Whether it explains the cloud is for the caller to judge, by `support` and `sigma`.
    """
    guesses = guessed_fits(config, points, mask, gripper_pose, reach=reach)
    keypoints = np.asarray(guesses.keypoints)
    chosen: list[int] = []
    for index in range(len(keypoints)):
        apart = [np.linalg.norm(keypoints[index] - keypoints[k], axis=-1).mean() for k in chosen]
        if not apart or min(apart) > SAME * config.length:
            chosen.append(index)
    chosen = (chosen * FINALISTS)[:FINALISTS]
    best = jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], guesses)
    cloud = jnp.asarray(points, float)
    refined = _register_all(config, cloud, mask, best.gripper_pose, best.angles, 2.0 * best.sigma, reach, REFINEMENTS)
    merit = _merit(config, refined)
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[int(np.argmax(merit))]), refined)


def guessed_fits(
    config: RegistrationConfig,
    points: Float[np.ndarray, "S 2"],
    mask: Bool[np.ndarray, " S"],
    gripper_pose: Float[np.ndarray, "Q 3"],
    *,
    reach: float,
) -> CurveFit:
    """The fits of all guesses to a sample of the cloud, batched, best first; arguments as of `first_fit`."""
    present = np.asarray(points, float)[np.asarray(mask)]
    pose = np.asarray(gripper_pose, float)
    profiles = [_path_profile(config, cloud_path(present, pose, config.length, power), pose) for power in JUMPS]
    n_paths = len(profiles)
    profiles += _bowed_profiles(config, pose)
    tangents = np.stack(profiles)
    poses = np.repeat(pose[None], len(tangents), axis=0)
    poses[:, 0, 2] = pose[0, 2]
    turn = tangents[:, -1] - tangents[:, 0]
    between = pose[1, 2] - pose[0, 2]
    poses[:, 1, 2] = pose[1, 2] + 2 * np.pi * np.round((turn - between) / (2 * np.pi))
    sigma = config.length * np.where(np.arange(len(tangents)) < n_paths, PATH_SIGMA, GUESS_SIGMA)

    angles, sample = np.diff(tangents, axis=1), padded(present, SAMPLE)
    cloud = jnp.asarray(sample.points, float)
    fits = _register_all(config, cloud, sample.mask, poses, angles, sigma, reach, ITERATIONS)
    order = np.argsort(-_merit(config, fits), kind="stable")
    return jax.tree.map(lambda leaf: np.asarray(leaf)[order], fits)


@functools.partial(jax.jit, static_argnames=("config", "reach", "iterations"))
def _register_all(config, points, mask, poses, angles, sigma, reach, iterations) -> CurveFit:
    def one(pose, angles, sigma):
        return register(
            config, points, mask, pose, angles, pose, sigma, iterations=iterations, coherent=False, reach=reach
        )

    return jax.vmap(one)(poses, angles, sigma)


def _merit(config: RegistrationConfig, fits: CurveFit) -> np.ndarray:
    """Log posterior of every fit, minus infinity where the curve does not end in the gripper."""
    merit = np.asarray(fits.log_posterior, float)
    return np.where(np.isfinite(merit) & (np.asarray(fits.gap) < 0.02 * config.length), merit, -np.inf)


def _bowed_profiles(config: RegistrationConfig, pose: np.ndarray) -> list[np.ndarray]:
    """Tangent angles of the links: from one gripper's over the chord's to the other's, with whole turns on the way."""
    s = config.matrices.arclength
    chord = np.arctan2(*(pose[1, :2] - pose[0, :2])[::-1])
    first, last = chord + wrapped(pose[:, 2] - chord)
    found = []
    for middle_turns in (0, 1, -1):
        for end_turns in (0, 1, -1):
            end, middle = last + 2 * np.pi * end_turns, chord + 2 * np.pi * middle_turns
            base = first + (end - first) * s + (middle - 0.5 * (first + end)) * np.sin(np.pi * s) ** 2
            found.append(base)
            if middle_turns == end_turns == 0:
                found += [base + bow * np.sin(mode * np.pi * s) for mode in (1, 2) for bow in BOWS]
    return found


def _path_profile(config: RegistrationConfig, even: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Tangent angles of the links along a path; at its ends those of the grippers, on the nearest turn."""
    steps = np.gradient(even, axis=0)
    angle = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    profile = np.interp(config.matrices.arclength, np.linspace(0.0, 1.0, len(angle)), angle)
    # The ends have the grippers' directions, on the turn that is nearest to the path's.
    profile = profile + pose[0, 2] - (profile[0] - wrapped(profile[0] - pose[0, 2]))
    profile = np.array(profile)
    profile[0], profile[-1] = pose[0, 2], profile[-1] - wrapped(profile[-1] - pose[1, 2])
    return profile
