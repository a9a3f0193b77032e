"""Keypoints from the nodes of the chain, by cubic Hermite interpolation along the arc length."""

from __future__ import annotations

from typing import Any

import numpy as np

from cablejax.arrays import quarter_turn
from cablejax.cable import Discretisation
from cablejax.effects.physics import Physics


def marked_keypoints(
    config: Discretisation, physics: Physics, nodes: Any, unit: Any, *, scale: Any = 1.0, slipped: Any = None
) -> Any:
    """Points of a planar cable where its keypoints are marked, with the bias of each mark. One function of all engines.

    NumPy in, NumPy out; JAX in, JAX out, differentiable in all arrays; in the bias of an end, which stays on the cable,
    from within. Without bias and slip the arc lengths are those of `hermite_weights`, to the last bit.

    Args:
        config: of the cable.
        physics: `bias_along` and `bias_across` are used.
        nodes: positions [m], shape [..., n, 2].
        unit: unit tangents at the nodes, shape [..., n, 2].
        scale: length of the cable over its nominal length, shape [].
        slipped: cable that came through either gripper [m], shape [2]: marks move away from that gripper.

    Returns:
        Keypoints [m], shape [..., N, 2].
    """
    xp, h, last = nodes.__array_namespace__(), config.link_length, config.n_links - 1
    marks = config.cable.keypoint_arclength
    # whole and broken part of the nominal place apart: at no shift, neither is rounded
    segment = np.clip(np.floor(marks / h + 1e-9), 0, last - 1)
    marks, segment, place, within = (
        np.asarray(x, nodes.dtype) for x in (marks, segment, marks / h, marks / h - segment)
    )
    shift = physics.bias_along / h
    if slipped is not None:
        total = slipped[0] + slipped[1]
        moved = physics.bias_along + slipped[0] - marks * total / config.cable.length
        ends = np.isin(np.arange(len(marks)), (0, len(marks) - 1))
        shift = xp.where(ends, shift, last * moved / (config.cable.length + total))
    # not xp.clip: at both ends of the cable the derivative is that of moving inwards, not the mean of both sides
    inside = xp.where(shift > last - place, last - place, shift)
    t = within + xp.where(inside < -place, -place, inside)
    further = xp.clip(xp.floor(t + 1e-4), -segment, last - 1 - segment)
    t = (t - further)[:, None]
    index = (segment + further).astype(int)
    a, b, da, db = nodes[..., index, :], nodes[..., index + 1, :], unit[..., index, :], unit[..., index + 1, :]
    points = (1 - 3 * t**2 + 2 * t**3) * a + (3 * t**2 - 2 * t**3) * b
    points = points + scale * h * ((t - 2 * t**2 + t**3) * da + (t**3 - t**2) * db)
    tangent = (1 - t) * da + t * db
    normal = quarter_turn(tangent)
    return points + physics.bias_across[:, None] * normal


def hermite(s: Any, ends: Any, slopes: Any) -> Any:
    """Cubic Hermite interpolation along the cable, from its ends. Differentiable in all arrays.

    Args:
        s: fraction of the arc length, shape [N, 1].
        ends: values at both ends, shape [2, D].
        slopes: derivatives by s there, shape [2, D].
    """
    blend = s * s * (3.0 - 2.0 * s)
    return (1.0 - blend) * ends[0] + blend * ends[1] + s * (1.0 - s) ** 2 * slopes[0] - s * s * (1.0 - s) * slopes[1]


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
