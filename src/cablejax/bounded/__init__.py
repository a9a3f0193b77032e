"""Bounded minimisation on optimistix: feasible sets, their projections, and solvers that stay inside.

Nothing here knows of cables. The solvers are optimistix solvers, made from its abstract descents and searches; the set
travels in their options:

    solution = least_squares(residuals, BoundedLevenbergMarquardt(atol=1e-8), guess, Box(lower, upper))
    solution.value, solution.certificate(residuals, Box(lower, upper))
"""

from cablejax.bounded.batched_gauss_newton import BatchedGaussNewton, QuadraticModel, solve_arrow
from cablejax.bounded.certificate import Certificate, certify
from cablejax.bounded.dogleg import BoundedDogleg
from cablejax.bounded.gauss_newton import BoundedGaussNewton
from cablejax.bounded.implicit import FixedPointAdjoint
from cablejax.bounded.levenberg_marquardt import BoundedLevenbergMarquardt
from cablejax.bounded.quadratic import minimise_quadratic
from cablejax.bounded.quasi_newton import BoundedQuasiNewton
from cablejax.bounded.results import Result, Solution
from cablejax.bounded.sets import (
    AbstractSet,
    AffineBalls,
    Balls,
    Box,
    Halfspaces,
    Intersection,
    project_ball,
)
from cablejax.bounded.solve import least_squares, minimise
from cablejax.bounded.spectral import SpectralProjectedGradient

__all__ = [
    "AbstractSet",
    "AffineBalls",
    "Balls",
    "BatchedGaussNewton",
    "BoundedDogleg",
    "BoundedGaussNewton",
    "BoundedLevenbergMarquardt",
    "BoundedQuasiNewton",
    "Box",
    "Certificate",
    "FixedPointAdjoint",
    "Halfspaces",
    "Intersection",
    "QuadraticModel",
    "Result",
    "Solution",
    "SpectralProjectedGradient",
    "certify",
    "least_squares",
    "minimise",
    "minimise_quadratic",
    "project_ball",
    "solve_arrow",
]
