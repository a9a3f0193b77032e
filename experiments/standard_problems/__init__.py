"""Standard problems that bounded solvers are judged on. Tests and experiments import them; the package does not."""

from __future__ import annotations

from standard_problems.base import BoundedProblem
from standard_problems.elastica_shaping import elastica_problems
from standard_problems.hock_schittkowski import hock_schittkowski_problems
from standard_problems.more_garbow_hillstrom import more_garbow_hillstrom_problems
from standard_problems.nist import nist_problems
from standard_problems.rosenbrock import rosenbrock_problems

__all__ = [
    "BoundedProblem",
    "all_problems",
    "elastica_problems",
    "hock_schittkowski_problems",
    "more_garbow_hillstrom_problems",
    "nist_problems",
    "rosenbrock_problems",
]


def all_problems() -> list[BoundedProblem]:
    """Every problem of every family."""
    families = (
        rosenbrock_problems,
        nist_problems,
        hock_schittkowski_problems,
        more_garbow_hillstrom_problems,
        elastica_problems,
    )
    return [problem for family in families for problem in family()]
