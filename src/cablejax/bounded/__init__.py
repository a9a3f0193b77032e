"""Bounded minimisation on optimistix: feasible sets, their projections, and solvers that stay inside.

Nothing here knows of cables. The solvers are optimistix solvers, made from its abstract descents and searches:

    feasible = Box(lower, upper)
    solver = ProjectedLevenbergMarquardt(feasible, rtol=0.0, atol=1e-8)
    optimistix.least_squares(residuals, solver, feasible.project(guess), adjoint=FixedPointAdjoint())
"""

from cablejax.bounded.adjoint import FixedPointAdjoint
from cablejax.bounded.certificate import Certificate, certify
from cablejax.bounded.dogleg import ProjectedDogleg, ProjectedDoglegDescent
from cablejax.bounded.gauss_newton import ConstrainedNewton, ProjectedGaussNewton
from cablejax.bounded.least_squares import AbstractProjectedLeastSquares
from cablejax.bounded.levenberg_marquardt import DampedQuadratic, ProjectedLevenbergMarquardt
from cablejax.bounded.projection import project
from cablejax.bounded.quadratic import QuadraticMinimum, minimise_quadratic
from cablejax.bounded.sets import AbstractSet, Balls, Box, Intersection
from cablejax.bounded.spectral import NonmonotoneArmijo, ProjectionArc, SpectralProjectedGradient

__all__ = [
    "AbstractProjectedLeastSquares",
    "AbstractSet",
    "Balls",
    "Box",
    "Certificate",
    "ConstrainedNewton",
    "DampedQuadratic",
    "FixedPointAdjoint",
    "Intersection",
    "NonmonotoneArmijo",
    "ProjectedDogleg",
    "ProjectedDoglegDescent",
    "ProjectedGaussNewton",
    "ProjectedLevenbergMarquardt",
    "ProjectionArc",
    "QuadraticMinimum",
    "SpectralProjectedGradient",
    "certify",
    "minimise_quadratic",
    "project",
]
