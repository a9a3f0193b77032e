"""Features of the learned corrections: the clamps' past and the simulated cable, in a frame that moves with the clamps.

Its origin is midway between the clamps, x along the horizontal chord, z up, so that nothing depends on where in the
room the cable hangs or which way it faces. Nothing here is observed after the first two samples of a window.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cablejax.spatial.windows import Windows

_HISTORY = 0.4  # [s]
_POSITION_LAGS = 10
_DIRECTION_LAGS = 4


def moving_frame(windows: Windows) -> Float[np.ndarray, "W T 3 3"]:
    """Rows are the frame's axes in the world."""
    chord = windows.position[:, :, 1] - windows.position[:, :, 0]
    flat = chord * np.array([1.0, 1.0, 0.0])
    x = flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-6)
    z = np.broadcast_to(np.array([0.0, 0.0, 1.0]), x.shape)
    return np.stack([x, np.cross(z, x), z], axis=-2)


def in_frame(vectors: Float[np.ndarray, "W T N 3"], frame: Float[np.ndarray, "W T 3 3"]) -> np.ndarray:
    """Vectors of the world in the frame."""
    return np.einsum("wtkc,wtmc->wtmk", frame, vectors)


def earlier(values: Float[np.ndarray, "W T ..."], lag: int) -> np.ndarray:
    """So many samples before; the first sample before the window began."""
    return values[:, np.maximum(np.arange(values.shape[1]) - lag, 0)]


def clamp_history(windows: Windows, frame: Float[np.ndarray, "W T 3 3"]) -> Float[np.ndarray, "W T K"]:
    """The clamps' positions and directions over the last 0.4 s."""
    position, direction = windows.position, windows.frames[:, :, :, 0]
    middle, last = position.mean(axis=2, keepdims=True), round(_HISTORY / windows.interval)
    parts = [
        in_frame(earlier(position, lag) - middle, frame)
        for lag in np.linspace(0, last, _POSITION_LAGS).round().astype(int)
    ]
    parts += [
        in_frame(earlier(direction, lag), frame) for lag in np.linspace(0, last, _DIRECTION_LAGS).round().astype(int)
    ]
    return np.concatenate([part.reshape(*part.shape[:2], -1) for part in parts], axis=-1)
