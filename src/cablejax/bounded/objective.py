"""The objective of a minimisation: a function, or half the sum of squares of residuals."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Scalar


def value_of(out: Array) -> Scalar:
    """The function's value from what was returned: a scalar is the value, residuals stand for half their squares."""
    return out if out.ndim == 0 else 0.5 * jnp.sum(out**2)
