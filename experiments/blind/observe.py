"""Observes points of a cable as a camera reports them: material points, errors of the image, lag."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np

from .rod import Motion

KEYPOINTS = 13


@dataclasses.dataclass(frozen=True)
class Camera:
    """How the camera sees the keypoints.

    Attributes:
        scale, angle, offset: similarity about the world's origin, then the offset [m].
        shift_along, shift_across: keypoints off their arc length or off the centreline, to the left [m], shape [13].
        lag, lag_share: total time by which the image is late [s], and the share of it that is a pure delay.
        barrel: radial distortion r (1 + barrel r^2) about `centre` [1/m^2].
        wander: (dx, dy) [m] by which the image has moved at the end of an episode, with the time squared.
        outliers: rows of (episode, first sample, samples, keypoint, dx, dy).
    """

    scale: float = 1.0
    angle: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    shift_along: tuple[float, ...] = (0.0,) * KEYPOINTS
    shift_across: tuple[float, ...] = (0.0,) * KEYPOINTS
    lag: float = 0.0
    lag_share: float = 0.5
    barrel: float = 0.0
    centre: tuple[float, float] = (0.45, 0.0)
    wander: tuple[float, float] = (0.0, 0.0)
    outliers: tuple[tuple[float, ...], ...] = ()


def observe(motion: Motion, camera: Camera, length: float, frame: float, frames: int, episode: int) -> np.ndarray:
    """Noiseless keypoints at every sample [m], shape [T, 13, 2].

    Args:
        frame: time between the motion's frames [s].
        frames: of them per sample.
        episode: its number, for the outliers.
    """
    late = camera.lag > 0
    points, arc = (motion.points, motion.arc) if late else (motion.points[::frames], motion.arc[::frames])
    along = np.linspace(0.0, length, KEYPOINTS)
    keypoints, normals = sample(points, arc, along + np.array(camera.shift_along))
    keypoints += np.array(camera.shift_across)[:, None] * normals
    # The ends are at the grippers, whatever has slid through them, unless the camera misplaces them.
    for k, node in ((0, 0), (KEYPOINTS - 1, -1)):
        if camera.shift_along[k] == 0 and camera.shift_across[k] == 0:
            keypoints[:, k] = points[:, node]
    if camera.barrel:
        radial = keypoints - np.array(camera.centre)
        keypoints = np.array(camera.centre) + radial * (1 + camera.barrel * (radial**2).sum(axis=-1, keepdims=True))
    c, s = np.cos(camera.angle), np.sin(camera.angle)
    keypoints = camera.scale * keypoints @ np.array([[c, s], [-s, c]]) + np.array(camera.offset)
    share = np.linspace(0.0, 1.0, len(keypoints))[:, None, None]
    keypoints = keypoints + np.array(camera.wander) * share**2
    if late:
        keypoints = lagged(keypoints, camera.lag, camera.lag_share, frame)[::frames]
    for number, first, samples, k, dx, dy in camera.outliers:
        if number == episode:
            keypoints[int(first) : int(first + samples), int(k)] += (dx, dy)
    return keypoints


def lagged(signal: np.ndarray, total: float, share: float, frame: float) -> np.ndarray:
    """A signal, late by a pure delay of `share * total` and a first-order lag of the rest; at rest before it starts."""
    at = np.arange(len(signal)) - share * total / frame
    index = np.clip(np.floor(at).astype(int), 0, len(signal) - 2)
    part = np.clip(at - index, 0.0, 1.0).reshape(-1, *[1] * (signal.ndim - 1))
    result = (1 - part) * signal[index] + part * signal[index + 1]
    constant = (1 - share) * total
    if constant > 0:
        keep, late = np.exp(-frame / constant), result
        result = late.copy()
        for i in range(1, len(result)):
            # the exact response to a straight line from the last frame to this one
            trail = constant * (late[i] - late[i - 1]) / frame
            result[i] = late[i] - trail + keep * (result[i - 1] - late[i - 1] + trail)
    return result


@numba.njit(cache=True)
def sample(points, arc, wanted):
    """Points at the wanted arc lengths and the left normals there, by cubic Lagrange interpolation over four points.

    Args:
        points: [m], shape [F, M, 2]; arc: increasing, shape [F, M].
        wanted: shape [K].

    Returns:
        Two arrays of shape [F, K, 2].
    """
    frames, m = points.shape[0], points.shape[1]
    result, normal = np.zeros((frames, wanted.shape[0], 2)), np.zeros((frames, wanted.shape[0], 2))
    for f in range(frames):
        for k in range(wanted.shape[0]):
            s = wanted[k]
            i = np.searchsorted(arc[f], s) - 2
            i = min(max(i, 0), m - 4)
            tx = ty = 0.0
            for a in range(4):
                weight, slope = 1.0, 0.0
                for b in range(4):
                    if b != a:
                        gap = arc[f, i + a] - arc[f, i + b]
                        factor = 1.0 / gap
                        for c in range(4):
                            if c != a and c != b:
                                factor *= (s - arc[f, i + c]) / (arc[f, i + a] - arc[f, i + c])
                        slope += factor
                        weight *= (s - arc[f, i + b]) / gap
                for c in range(2):
                    result[f, k, c] += weight * points[f, i + a, c]
                tx += slope * points[f, i + a, 0]
                ty += slope * points[f, i + a, 1]
            long = np.sqrt(tx * tx + ty * ty)
            normal[f, k, 0], normal[f, k, 1] = -ty / long, tx / long
    return result, normal
