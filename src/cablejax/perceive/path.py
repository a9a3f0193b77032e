"""The cable's course through a cloud, without any model: the shortest way over the points from gripper to gripper."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

CELL = 0.01
"""Side of the cells that a cloud is thinned to, in lengths of the cable."""
NEIGHBOURS = 24
"""Cells that each cell is connected to: the nearest ones."""
SAMPLES = 161
"""Points of the path."""
SMOOTHING = 4.0
"""Standard deviation of the smoothing along the path, in points."""


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
    keep = cost > 0
    pairs, index = np.unique(np.stack([start[keep], end[keep]]), axis=1, return_index=True)
    graph = coo_matrix((cost[keep][index], pairs), shape=(len(nodes), len(nodes))).tocsr()
    _, previous = dijkstra(graph, directed=False, indices=0, return_predecessors=True)
    path = [1]
    while path[-1] != 0:
        path.append(int(previous[path[-1]]))
    line = nodes[path[::-1]]
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    u = np.linspace(0.0, travelled[-1], SAMPLES)
    even = np.stack([np.interp(u, travelled, line[:, axis]) for axis in range(2)], axis=1)
    return gaussian_filter1d(even, SMOOTHING, axis=0, mode="nearest")


def path_length(path: Float[np.ndarray, "M 2"]) -> float:
    """Length of a polyline [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
