"""The planners' names. Imports nothing, so that the command line knows them before JAX is loaded."""

from typing import Literal

SolverName = Literal[
    "trust-region", "projected-gradient", "dogleg", "gauss-newton", "deadline", "cross-entropy", "path-integral"
]
"""A key of `cablejax.mpc.SOLVERS`."""
