"""Online correction of a learned model: ridge regression of its error on the command, and the composition of both."""

from cablejax.residual.corrected import Corrected
from cablejax.residual.jacobian import Dynamics
from cablejax.residual.ridge import ResidualModel, RidgeConfig, apply, fit, zero_residual

__all__ = ["Corrected", "Dynamics", "ResidualModel", "RidgeConfig", "apply", "fit", "zero_residual"]
