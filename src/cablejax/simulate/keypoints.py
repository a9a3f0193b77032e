"""Keypoints from the nodes of the chain, by cubic Hermite interpolation along the arc length."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cablejax.cable import Discretisation
from cablejax.effects.physics import Physics


def hermite_weights(
    config: Discretisation, arclength: Float[np.ndarray, " N"] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Matrices that turn nodes into keypoints: `keypoints = positions_w @ nodes + tangents_w @ unit_tangents`.

    The nodes sit at arc lengths `j h`, j = 0..n_links - 1. The error of a cubic Hermite segment is of order h^4, below
    that of the chain itself, which is of order h^2.

    Args:
        config: the chain.
        arclength: of the keypoints [m]; None = where the cable has its own.

    Returns:
        Weights of the node positions [N, n_links] and of the unit tangents at the nodes [N, n_links], these in metres.
    """
    h = config.link_length
    rows, segment, t = _segments(config, config.cable.keypoint_arclength if arclength is None else arclength)
    positions_w = np.zeros((len(rows), config.n_links))
    tangents_w = np.zeros_like(positions_w)
    positions_w[rows, segment] = 1 - 3 * t**2 + 2 * t**3
    positions_w[rows, segment + 1] = 3 * t**2 - 2 * t**3
    tangents_w[rows, segment] = h * (t - 2 * t**2 + t**3)
    tangents_w[rows, segment + 1] = h * (t**3 - t**2)
    return positions_w, tangents_w


def biased_keypoints(
    config: Discretisation,
    physics: Physics,
    arclength: Float[np.ndarray, " N"],
    nodes: Float[np.ndarray, "n 2"],
    tangents: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "N 2"]:
    """Keypoints that sit off where they should be, along the cable and to the left of its centreline [m].

    Args:
        config: the chain.
        physics: `bias_along` and `bias_across` are used.
        arclength: where the keypoints should be [m].
        nodes: of the chain [m].
        tangents: along the cable at the nodes, as long as the cable is stretched.
    """
    marks = np.clip(arclength + physics.bias_along, 0.0, config.cable.length)
    positions_w, tangents_w = hermite_weights(config, marks)
    _, segment, t = _segments(config, marks)
    along = (1 - t)[:, None] * tangents[segment] + t[:, None] * tangents[segment + 1]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    return positions_w @ nodes + tangents_w @ tangents + np.asarray(physics.bias_across)[:, None] * left


def camera_similarity(physics: Physics, keypoints: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    """Keypoints scaled and turned about the world's origin, then moved, as the camera reports them [m]."""
    cosine, sine = np.cos(physics.camera_angle), np.sin(physics.camera_angle)
    turned = keypoints @ np.array([[cosine, sine], [-sine, cosine]])
    return np.asarray(physics.camera_scale) * turned + np.asarray(physics.camera_offset)


def _segments(config: Discretisation, arclength: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, the segment between two nodes that each keypoint lies in, and how far along that segment."""
    s = arclength / config.link_length
    segment = np.clip(np.floor(s + 1e-9).astype(int), 0, config.n_links - 2)
    return np.arange(len(s)), segment, s - segment
