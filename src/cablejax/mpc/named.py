"""Every planner by its name, at its defaults."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from cablejax.mpc.cem import CrossEntropy
from cablejax.mpc.mppi import PathIntegral
from cablejax.mpc.plan import Solver
from cablejax.mpc.projected_gradient import ProjectedGradient
from cablejax.mpc.trust_region import Dogleg, GaussNewton, TrustRegion

SOLVERS: Mapping[str, Solver] = MappingProxyType(
    {
        "trust-region": TrustRegion(),
        "projected-gradient": ProjectedGradient(),
        "dogleg": Dogleg(),
        "gauss-newton": GaussNewton(),
        "deadline": TrustRegion(trials_per_linearisation=2),
        "cross-entropy": CrossEntropy(),
        "path-integral": PathIntegral(),
    }
)
