"""Corrects a learned model online from its last errors."""

from cablejax.residual.jacobian import Corrected, Dynamics
from cablejax.residual.learner import PAPER, STATIC, Candidate, LearnerConfig
from cablejax.residual.ridge import ResidualModel, RidgeConfig, apply, fit, zero_residual

__all__ = [
    "PAPER",
    "STATIC",
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
