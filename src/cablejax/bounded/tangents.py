"""Derivatives along the tangents that a custom rule of equinox is given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax


def derivative_along(fn: Callable[..., Any], primals: tuple, tangents: tuple) -> Any:
    """The derivative of `fn(*primals)` along tangents, of which None stands for what does not change."""
    # The tangents are those of arrays; what has none stays as it is.
    moving = jax.tree.map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None)
    varying, fixed = eqx.partition(primals, moving)
    return jax.jvp(lambda varying: fn(*eqx.combine(varying, fixed)), (varying,), (tangents,))[1]
