"""A standard problem: a smooth objective over a box or over balls, a start, and the best value known."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.bounded.sets import Balls, Box, ConvexSet

RELATIVE = 1e-6
"""A solver has found the optimum if its objective is above the best known by no more than this, relative to it."""
ABSOLUTE = 1e-10
"""The same where the best known objective is 0."""
FEASIBLE = 1e-8
"""Largest violation of a feasible point."""


@dataclasses.dataclass(frozen=True, eq=False)
class BoundedProblem:
    """Minimise a function over a convex set. Written for float64; the functions are traceable and differentiable.

    Attributes:
        name: unique in the collection.
        family: where it comes from, for tables.
        start: where solvers begin, not always in the set; any shape.
        optimum: best objective known.
        residuals: `y -> r`, the objective being half the squared norm; None for an objective of another form.
        function: `y -> f`, for an objective of another form.
        lower: lower bounds, `start`'s shape; None = not a box.
        upper: upper bounds, likewise.
        radius: bound on the norm of every last-axis vector; None = no balls.
        note: what the optimum is known from.
    """

    name: str
    family: str
    start: Float[np.ndarray, "..."]
    optimum: float
    residuals: Callable[[Array], Array] | None = None
    function: Callable[[Array], Array] | None = None
    lower: Float[np.ndarray, "..."] | None = None
    upper: Float[np.ndarray, "..."] | None = None
    radius: float | None = None
    note: str = ""

    def __post_init__(self):
        if (self.residuals is None) == (self.function is None):
            raise ValueError(f"Problem {self.name!r}: give either its residuals or its function.")
        if (self.lower is None) == (self.radius is None) or (self.lower is None) != (self.upper is None):
            raise ValueError(f"Problem {self.name!r}: give either lower and upper bounds or a radius.")

    @property
    def is_least_squares(self) -> bool:
        """Whether solvers for residuals apply."""
        return self.residuals is not None

    @property
    def is_box(self) -> bool:
        """Whether solvers for bounds on the variables apply."""
        return self.lower is not None

    def objective(self, y: Float[Array, "..."]) -> Float[Array, ""]:
        """The value to minimise."""
        if self.residuals is not None:
            return 0.5 * jnp.sum(self.residuals(y) ** 2)
        assert self.function is not None
        return self.function(y)

    def feasible(self) -> ConvexSet:
        """The set, in the precision that JAX has now."""
        if self.radius is not None:
            return Balls(jnp.asarray(self.radius))
        return Box(jnp.asarray(self.lower), jnp.asarray(self.upper))

    def violation(self, y: Float[np.ndarray, "..."]) -> float:
        """How far outside the set a point is; independent of `feasible`."""
        y = np.asarray(y, float)
        if self.radius is not None:
            return float(max(0.0, (np.linalg.norm(y, axis=-1) - self.radius).max()))
        return float(max(0.0, (np.asarray(self.lower) - y).max(), (y - np.asarray(self.upper)).max()))

    def is_solved(self, y: Float[np.ndarray, "..."], objective: float) -> bool:
        """Whether a point is feasible and as good as the best known, within `RELATIVE`, `ABSOLUTE`, `FEASIBLE`."""
        close = objective <= self.optimum + max(RELATIVE * abs(self.optimum), ABSOLUTE if self.optimum == 0 else 0.0)
        return bool(np.isfinite(y).all() and close and self.violation(y) <= FEASIBLE)
