"""Bounded minimisation on optimistix: feasible sets, their projections, and solvers that stay inside.

Nothing here knows of cables. The solvers are optimistix solvers, made from its abstract descents and searches; the set
travels in their options:

    solution = least_squares(residuals, BoundedLevenbergMarquardt(atol=1e-8), guess, Box(lower, upper))
    solution.value, solution.certificate(residuals, Box(lower, upper))
"""

from cablejax.bounded.batched_gauss_newton import BatchedGaussNewton, Linearised, Minimised, solve_arrow
from cablejax.bounded.certificate import Certificate, certify
from cablejax.bounded.dogleg import BoundedDogleg, BoundedDoglegDescent
from cablejax.bounded.gain_ratio import GainRatio
from cablejax.bounded.gauss_newton import BoundedGaussNewton, ConstrainedNewton
from cablejax.bounded.implicit import FixedPointAdjoint
from cablejax.bounded.least_squares import AbstractBoundedLeastSquares
from cablejax.bounded.levenberg_marquardt import BoundedLevenbergMarquardt, DampedQuadratic
from cablejax.bounded.quadratic import QuadraticMinimum, minimise_quadratic
from cablejax.bounded.quasi_newton import BoundedQuasiNewton
from cablejax.bounded.results import Result, Solution, Stats
from cablejax.bounded.sets import (
    AbstractSet,
    AffineBalls,
    Balls,
    Box,
    ConvexSet,
    Halfspaces,
    Intersection,
    project_ball,
)
from cablejax.bounded.solve import least_squares, minimise
from cablejax.bounded.spectral import NonmonotoneArmijo, ProjectionArc, SpectralProjectedGradient

__all__ = [
    "AbstractBoundedLeastSquares",
    "AbstractSet",
    "AffineBalls",
    "Balls",
    "BatchedGaussNewton",
    "BoundedDogleg",
    "BoundedDoglegDescent",
    "BoundedGaussNewton",
    "BoundedLevenbergMarquardt",
    "BoundedQuasiNewton",
    "Box",
    "Certificate",
    "ConstrainedNewton",
    "ConvexSet",
    "DampedQuadratic",
    "FixedPointAdjoint",
    "GainRatio",
    "Halfspaces",
    "Intersection",
    "Linearised",
    "Minimised",
    "NonmonotoneArmijo",
    "ProjectionArc",
    "QuadraticMinimum",
    "Result",
    "Solution",
    "SpectralProjectedGradient",
    "Stats",
    "certify",
    "least_squares",
    "minimise",
    "minimise_quadratic",
    "project_ball",
    "solve_arrow",
]
