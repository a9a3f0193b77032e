"""Auxiliary output of a function, `fn(y, args) -> (value, aux)`: kept for the current point of a solve."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


def nothing_yet(struct: Any) -> Any:
    """Zeros in place of an aux of this structure, before the function has been called."""
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), struct)


def aux_at(fn: Any, y: Array, args: Any, struct: Any) -> Any:
    """The aux at a point; where there is none the function is not called."""
    return fn(y, args)[1] if jax.tree.leaves(struct) else struct


def chosen(accept: Bool[Array, ""], new: Any, old: Any) -> Any:
    """The aux of a trial that was accepted, or the one before."""
    return jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, old)
