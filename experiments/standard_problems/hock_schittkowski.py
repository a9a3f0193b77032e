"""The bound constrained problems of Hock and Schittkowski (Test Examples for Nonlinear Programming Codes, 1981).

They are part of CUTEst under the same numbers. Objectives, bounds, starts and optima are the book's; where an optimum
has a closed form it is given by that.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from standard_problems.base import BoundedProblem

_INF = np.inf


def hock_schittkowski_problems() -> list[BoundedProblem]:
    """HS1-5, 25, 38, 45 and 110."""

    def problem(number: int, start, lower, upper, optimum: float, note: str = "the book", **form) -> BoundedProblem:
        bounds = {"lower": np.array(lower, float), "upper": np.array(upper, float)}
        return BoundedProblem(
            f"HS{number}", "Hock-Schittkowski", np.array(start, float), optimum, **bounds, **form, note=note
        )

    return [
        problem(1, (-2, 1), (-_INF, -1.5), (_INF, _INF), 0.0, residuals=_valley),
        # From the book's start, (-2, 1), descent ends in the other minimum, 4.9412 at x = (-1.2210, 1.5).
        problem(2, (2, 1), (-_INF, 1.5), (_INF, _INF), _hs2_optimum(), residuals=_valley, note="closed form"),
        problem(3, (10, 1), (-_INF, 0), (_INF, _INF), 0.0, function=_hs3),
        problem(4, (1.125, 0.125), (1, 0), (_INF, _INF), 8 / 3, function=_hs4, note="(1, 0)"),
        problem(5, (0, 0), (-1.5, -3), (4, 3), -math.sqrt(3) / 2 - math.pi / 3, function=_hs5, note="closed form"),
        problem(25, (100, 12.5, 3), (0.1, 0, 0), (100, 25.6, 5), 0.0, residuals=_hs25, note="(50, 25, 1.5)"),
        problem(38, (-3, -1, -3, -1), (-10,) * 4, (10,) * 4, 0.0, residuals=_wood, note="all ones"),
        problem(45, (2,) * 5, (0,) * 5, (1, 2, 3, 4, 5), 1.0, function=_hs45, note="(1, 2, 3, 4, 5)"),
        problem(110, (9,) * 10, (2.001,) * 10, (9.999,) * 10, _hs110_optimum(), function=_hs110, note="symmetric"),
    ]


def _valley(x: Float[Array, "2"]) -> Float[Array, "2"]:
    return jnp.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]) * 2**0.5


def _hs2_optimum() -> float:
    """The book's closed form of the optimum on the bound x2 = 1.5."""
    a = math.sqrt(598 / 1200)
    x = 2 * a * math.cos(math.acos(1 / (400 * a**3)) / 3)
    return 100 * (1.5 - x**2) ** 2 + (1 - x) ** 2


def _hs3(x):
    return x[1] + 1e-5 * (x[1] - x[0]) ** 2


def _hs4(x):
    return (x[0] + 1.0) ** 3 / 3.0 + x[1]


def _hs5(x):
    return jnp.sin(x[0] + x[1]) + (x[0] - x[1]) ** 2 - 1.5 * x[0] + 2.5 * x[1] + 1.0


def _hs25(x):
    share = 0.01 * jnp.arange(1, 100)
    u = 25.0 + (-50.0 * jnp.log(share)) ** (2.0 / 3.0)
    return 2**0.5 * (jnp.exp(-((u - x[1]) ** x[2]) / x[0]) - share)


def _wood(x):
    """The squared norm is twice Colville's function; half of it, the objective, is that function."""
    parts = [10.0 * (x[1] - x[0] ** 2), 1.0 - x[0], 90.0**0.5 * (x[3] - x[2] ** 2), 1.0 - x[2]]
    # 10.1 (a^2 + b^2) + 19.8 a b as a sum of squares
    a, b = x[1] - 1.0, x[3] - 1.0
    parts += [9.9**0.5 * (a + b), 0.2**0.5 * a, 0.2**0.5 * b]
    return 2**0.5 * jnp.stack(parts)


def _hs45(x):
    return 2.0 - jnp.prod(x) / 120.0


def _hs110(x):
    return jnp.sum(jnp.log(x - 2.0) ** 2 + jnp.log(10.0 - x) ** 2) - jnp.prod(x) ** 0.2


def _hs110_optimum() -> float:
    """All ten variables are equal at the optimum: the root of the derivative in that one, by bisection."""

    def slope(t):
        return 20 * math.log(t - 2) / (t - 2) - 20 * math.log(10 - t) / (10 - t) - 2 * t

    low, high = 9.0, 9.9
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slope(middle) < 0 else (low, middle)
    return 10 * (math.log(low - 2) ** 2 + math.log(10 - low) ** 2) - low**2
