"""Model predictive control of a cable's shape: feasible motions, the planning problem, its solvers, the controller."""

from cablejax.mpc.config import MPCConfig
from cablejax.mpc.controller import MPC
from cablejax.mpc.feasible import FeasibleSet, feasible_from
from cablejax.mpc.plan import Plan, Solver, differentiable_plan
from cablejax.mpc.planners import (
    SOLVERS,
    Dogleg,
    GaussNewton,
    LevenbergMarquardt,
    ProjectedGradient,
)
from cablejax.mpc.problem import ObjectiveConfig, Rollout, ShapingProblem
from cablejax.mpc.sampling import CrossEntropy, PathIntegral
from cablejax.mpc.state import Action, MPCInfo, MPCState

__all__ = [
    "MPC",
    "SOLVERS",
    "Action",
    "CrossEntropy",
    "Dogleg",
    "FeasibleSet",
    "GaussNewton",
    "LevenbergMarquardt",
    "MPCConfig",
    "MPCInfo",
    "MPCState",
    "ObjectiveConfig",
    "PathIntegral",
    "Plan",
    "ProjectedGradient",
    "Rollout",
    "ShapingProblem",
    "Solver",
    "differentiable_plan",
    "feasible_from",
]
