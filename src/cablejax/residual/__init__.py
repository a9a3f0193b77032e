"""Online correction of a learned model: ridge regression of its error on the command, and the composition of both."""

from cablejax.residual.jacobian import Corrected, Dynamics
from cablejax.residual.learner import PAPER, Candidate, LearnerConfig
from cablejax.residual.ridge import ResidualModel, RidgeConfig, apply, fit, zero_residual

__all__ = [
    "PAPER",
    "Candidate",
    "Corrected",
    "Dynamics",
    "LearnerConfig",
    "ResidualModel",
    "RidgeConfig",
    "apply",
    "fit",
    "zero_residual",
]
