"""The planners' names. Imports nothing, so that the command line knows them before JAX is loaded."""

from typing import Literal

SolverName = Literal[
    "levenberg-marquardt",
    "projected-gradient",
    "dogleg",
    "gauss-newton",
    "two-trials",
    "cross-entropy",
    "path-integral",
]
"""A key of `cablejax.mpc.SOLVERS`."""
