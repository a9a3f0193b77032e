"""The solvers by name, with the settings that are compared."""

from __future__ import annotations

from types import MappingProxyType

from cablejax.mpc.dogleg import Dogleg
from cablejax.mpc.gauss_newton import GaussNewton
from cablejax.mpc.outcome import Solver
from cablejax.mpc.projected_gradient import ProjectedGradient
from cablejax.mpc.sampling import CrossEntropy, PathIntegral
from cablejax.mpc.trust_region import TrustRegion

SOLVERS: MappingProxyType[str, Solver] = MappingProxyType(
    {
        "trust-region": TrustRegion(),
        "deadline": TrustRegion(max_iterations=1),
        "converged": TrustRegion(max_iterations=20, secant=True, inner_iterations=60),
        "gauss-newton": GaussNewton(),
        "dogleg": Dogleg(),
        "projected-gradient": ProjectedGradient(),
        "cross-entropy": CrossEntropy(),
        "path-integral": PathIntegral(),
    }
)
"""All settings fit a control interval of a second on two cores but "converged", which is what the others are short of.
"deadline" is one iteration of the first: one linearisation and one trial plan, whatever the problem."""
