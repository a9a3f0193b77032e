"""Arrays that mean no particular thing: runs of flags, and angles within a turn."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Int


def stretches(flags: Bool[np.ndarray, " T"]) -> Int[np.ndarray, "S 2"]:
    """First sample of each stretch in which a flag is set, and the first after it."""
    return np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int))).reshape(-1, 2)


def wrapped(angle):
    """The same angle within [-pi, pi) [rad]. NumPy in, NumPy out; JAX in, JAX out."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
