"""Keypoints from the nodes of the chain, by cubic Hermite interpolation along the arc length."""

from __future__ import annotations

import numpy as np

from cablejax.cable import Discretisation


def hermite_weights(config: Discretisation) -> tuple[np.ndarray, np.ndarray]:
    """Matrices that turn nodes into keypoints: `keypoints = positions_w @ nodes + tangents_w @ unit_tangents`.

    The nodes sit at arc lengths `j h`, j = 0..n_links - 1. The error of a cubic Hermite segment is of order h^4, below
    that of the chain itself, which is of order h^2.

    Returns:
        Weights of the node positions [N, n_links] and of the unit tangents at the nodes [N, n_links], these in metres.
    """
    h = config.link_length
    s = config.cable.keypoint_arclength / h
    segment = np.clip(np.floor(s + 1e-9).astype(int), 0, config.n_links - 2)
    t = s - segment
    rows = np.arange(config.cable.n_keypoints)
    positions_w = np.zeros((config.cable.n_keypoints, config.n_links))
    tangents_w = np.zeros_like(positions_w)
    positions_w[rows, segment] = 1 - 3 * t**2 + 2 * t**3
    positions_w[rows, segment + 1] = 3 * t**2 - 2 * t**3
    tangents_w[rows, segment] = h * (t - 2 * t**2 + t**3)
    tangents_w[rows, segment + 1] = h * (t**3 - t**2)
    return positions_w, tangents_w
