"""Rosenbrock's valley in boxes: 2, 10 and 50 variables, with no bound and with some bounds active at the optimum."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from standard_problems.base import BoundedProblem

SIZES = (2, 10, 50)
CUT = 0.5
"""Upper bound on the last variable that cuts the free optimum, 1, off."""
LEAST = -0.5
"""Lower bound on all: without it four and more variables have a second minimum, near x[0] = -1."""


def residuals(x: Float[Array, " n"]) -> Float[Array, " m"]:
    """`10 (x[i + 1] - x[i]^2)` and `1 - x[i]`: the chained form, half of whose squared norm is half of Rosenbrock's."""
    return jnp.concatenate([10.0 * (x[1:] - x[:-1] ** 2), 1.0 - x[:-1]])


def rosenbrock_problems() -> list[BoundedProblem]:
    """Each size with a box that contains the free optimum, and with one that cuts it off."""
    problems = []
    for n in SIZES:
        lower, wide = np.full(n, LEAST), np.full(n, 2.0)
        tight = np.where(np.arange(n) == n - 1, CUT, 2.0)
        common = {
            "family": "Rosenbrock",
            "start": np.where(np.arange(n) % 2 == 0, -1.2, 1.0),
            "residuals": residuals,
            "lower": lower,
        }
        problems += [
            BoundedProblem(f"Rosenbrock {n}", optimum=0.0, upper=wide, note="all ones", **common),
            BoundedProblem(
                f"Rosenbrock {n}, x{n} <= {CUT}",
                optimum=_CUT_OPTIMUM[n],
                upper=tight,
                note="best of many starts",
                **common,
            ),
        ]
    return problems


_CUT_OPTIMUM = {2: 0.0426802555084, 10: 0.0596474058018, 50: 0.0596476873817}
