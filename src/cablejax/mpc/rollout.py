"""A plan with what the model expects of it."""

from __future__ import annotations

import dataclasses

import jax
from jaxtyping import Array, Float

from cablejax.types import History


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rollout:
    """What `ShapingProblem.rollout` gives.

    Attributes:
        motion: the plan [m], shape [T, Q, 3].
        met: the histories that its steps start from, with a leading axis T.
        shapes: predicted keypoints X(1), ..., X(T) [m], shape [T, N, 2].
    """

    motion: Float[Array, "*batch T Q 3"]
    met: History
    shapes: Float[Array, "*batch T N 2"]
