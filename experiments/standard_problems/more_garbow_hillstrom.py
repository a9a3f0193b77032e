"""Problems of More, Garbow and Hillstrom (ACM TOMS 7, 1981, 17-41) in boxes.

The functions and starts are the paper's. The paper sets no bounds: here every problem has a box around start and
optimum, and some are taken again with a bound that cuts the optimum off. Objectives are half the sums of squares that
the paper gives.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from standard_problems.base import BoundedProblem


def more_garbow_hillstrom_problems() -> list[BoundedProblem]:
    """Sorted by the paper's numbers."""

    def problem(
        name: str, residuals, start, lower, upper, optimum: float, note: str = "zero residuals"
    ) -> BoundedProblem:
        return BoundedProblem(
            name,
            "More-Garbow-Hillstrom",
            np.array(start, float),
            optimum,
            residuals=residuals,
            lower=np.broadcast_to(np.array(lower, float), np.shape(start)),
            upper=np.broadcast_to(np.array(upper, float), np.shape(start)),
            note=note,
        )

    paper, found = "the paper", "best of many starts"
    helical, wood, watson = (-1, 0, 0), (-3, -1, -3, -1), np.zeros(6)
    powell = (3, -1, 0, 1)
    return [
        problem("Freudenstein-Roth", freudenstein_roth, (0.5, -2), (0, -5), (20, 5), 24.4921268396, found),
        problem("Brown badly scaled", brown_badly_scaled, (1, 1), (0, 0), (1e7, 1e3), 0.0),
        problem("Beale", beale, (1, 1), (-5, -5), (5, 5), 0.0),
        problem("Beale, x1 <= 2", beale, (1, 1), (-5, -5), (2, 5), 0.261672418005, found),
        problem("Jennrich-Sampson", jennrich_sampson, (0.3, 0.4), (0, 0), (1, 1), 62.1810911778, paper),
        problem("Helical valley", helical_valley, helical, (-2, -2, -2), (2, 2, 2), 0.0),
        problem("Helical valley, x1 <= 0.8", helical_valley, helical, (-2, -2, -2), (0.8, 2, 2), 0.495211060481, found),
        problem("Bard", bard, (1, 1, 1), (-5, 0.1, 0.1), (5, 5, 5), 0.00410743865329, paper),
        problem("Bard, x2 <= 1", bard, (1, 1, 1), (-5, 0.1, 0.1), (5, 1, 5), 0.00417863107983, found),
        problem("Powell singular", powell_singular, powell, -5, 5, 0.0),
        problem("Powell singular, x1 >= 0.1", powell_singular, powell, (0.1, -5, -5, -5), 5, 9.39098150292e-05, found),
        problem("Wood, 0 <= x2 <= 0.9", wood_function, wood, 0, (10, 0.9, 10, 10), 0.00441070473026, found),
        problem("Brown-Dennis", brown_dennis, (25, 5, -5, -1), -100, 100, 42911.1008132, paper),
        problem(
            "Brown-Dennis, x1 >= -11", brown_dennis, (25, 5, -5, -1), (-11, *[-100] * 3), 100, 43131.8204066, found
        ),
        problem("Watson 6", watson_function, watson, -2, 2, 0.00114383502678, paper),
        problem("Chebyquad 8", chebyquad, np.arange(1, 9) / 9, 0, 1, 0.00175843686284, paper),
        problem("Chebyquad 7", chebyquad, np.arange(1, 8) / 8, 0, 1, 0.0),
        problem("Chebyquad 7, x1 >= 0.1", chebyquad, np.arange(1, 8) / 8, (0.1, *[0] * 6), 1, 0.00295989778021, found),
        problem("Broyden tridiagonal 10", broyden_tridiagonal, -np.ones(10), -1.0, 1.0, 0.0),
    ]


def freudenstein_roth(x: Float[Array, "2"]) -> Float[Array, "2"]:
    """Problem 2; from the start all descent methods go to the local minimum (11.41, -0.897)."""
    first = -13.0 + x[0] + ((5.0 - x[1]) * x[1] - 2.0) * x[1]
    return jnp.stack([first, -29.0 + x[0] + ((x[1] + 1.0) * x[1] - 14.0) * x[1]])


def brown_badly_scaled(x: Float[Array, "2"]) -> Float[Array, "3"]:
    """Problem 4; the optimum is (1e6, 2e-6)."""
    return jnp.stack([x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2.0])


def beale(x: Float[Array, "2"]) -> Float[Array, "3"]:
    """Problem 5; the optimum is (3, 0.5)."""
    return jnp.array([1.5, 2.25, 2.625]) - x[0] * (1.0 - x[1] ** jnp.arange(1, 4))


def jennrich_sampson(x: Float[Array, "2"]) -> Float[Array, "10"]:
    """Problem 6 with 10 residuals; sum of squares 124.362 at x1 = x2 = 0.2578."""
    i = jnp.arange(1.0, 11.0)
    return 2.0 + 2.0 * i - (jnp.exp(i * x[0]) + jnp.exp(i * x[1]))


def helical_valley(x: Float[Array, "3"]) -> Float[Array, "3"]:
    """Problem 7; the optimum is (1, 0, 0), and the angle jumps on the half-line x1 < 0, x2 = 0, where it starts."""
    # The branch that the paper takes: arctan in (-1/4, 1/4), plus a half where x1 is negative.
    angle = jnp.arctan(x[1] / jnp.where(x[0] == 0, 1e-300, x[0])) / (2 * jnp.pi) + jnp.where(x[0] < 0, 0.5, 0.0)
    return jnp.stack([10.0 * (x[2] - 10.0 * angle), 10.0 * (jnp.hypot(x[0], x[1]) - 1.0), x[2]])


def bard(x: Float[Array, "3"]) -> Float[Array, "15"]:
    """Problem 8; sum of squares 8.21487e-3."""
    y = jnp.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39])
    u = jnp.arange(1.0, 16.0)
    v = 16.0 - u
    return y - (x[0] + u / (v * x[1] + jnp.minimum(u, v) * x[2]))


def powell_singular(x: Float[Array, "4"]) -> Float[Array, "4"]:
    """Problem 13; the Jacobian is singular at the optimum, 0."""
    parts = [x[0] + 10.0 * x[1], 5**0.5 * (x[2] - x[3]), (x[1] - 2.0 * x[2]) ** 2, 10**0.5 * (x[0] - x[3]) ** 2]
    return jnp.stack(parts)


def wood_function(x: Float[Array, "4"]) -> Float[Array, "6"]:
    """Problem 14; the optimum is all ones, and there is another minimum on the negative side."""
    parts = [10.0 * (x[1] - x[0] ** 2), 1.0 - x[0], 90.0**0.5 * (x[3] - x[2] ** 2), 1.0 - x[2]]
    return jnp.stack([*parts, 10.0**0.5 * (x[1] + x[3] - 2.0), (x[1] - x[3]) / 10.0**0.5])


def brown_dennis(x: Float[Array, "4"]) -> Float[Array, "20"]:
    """Problem 16 with 20 residuals; sum of squares 85822.2."""
    t = jnp.arange(1.0, 21.0) / 5.0
    return (x[0] + t * x[1] - jnp.exp(t)) ** 2 + (x[2] + x[3] * jnp.sin(t) - jnp.cos(t)) ** 2


def watson_function(x: Float[Array, " n"]) -> Float[Array, "31"]:
    """Problem 20; with six variables the sum of squares is 2.28767e-3."""
    t = jnp.arange(1.0, 30.0)[:, None] / 29.0
    j = jnp.arange(x.size)
    slope = jnp.sum(j[1:] * x[1:] * t ** (j[1:] - 1), axis=1)
    value = jnp.sum(x * t**j, axis=1)
    return jnp.concatenate([slope - value**2 - 1.0, x[:1], (x[1] - x[0] ** 2 - 1.0)[None]])


def chebyquad(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """Problem 35; with eight variables the sum of squares is 3.51687e-3, with seven 0."""
    y = 2.0 * x - 1.0
    before, now, residuals = jnp.ones_like(y), y, []
    for i in range(1, x.size + 1):
        integral = -1.0 / (i**2 - 1.0) if i % 2 == 0 else 0.0
        residuals.append(jnp.mean(now) - integral)
        before, now = now, 2.0 * y * now - before
    return jnp.stack(residuals)


def broyden_tridiagonal(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """Problem 30."""
    padded = jnp.pad(x, 1)
    return (3.0 - 2.0 * x) * x - padded[:-2] - 2.0 * padded[2:] + 1.0
