"""Model predictive control of a cable's shape: feasible motions, the planning problem, its solvers, the controller."""

from cablejax.mpc.controller import (
    ControlInfo,
    Controller,
    ControllerState,
    MPCConfig,
    control,
    initial_state,
    planning_problem,
)
from cablejax.mpc.dogleg import Dogleg
from cablejax.mpc.feasible import FeasibleSet, feasible_from, project_ball
from cablejax.mpc.gauss_newton import GaussNewton
from cablejax.mpc.named import SOLVERS
from cablejax.mpc.outcome import Outcome, Plan, Solver
from cablejax.mpc.problem import ObjectiveConfig, ShapingProblem
from cablejax.mpc.projected_gradient import ProjectedGradient
from cablejax.mpc.sampling import CrossEntropy, PathIntegral
from cablejax.mpc.solution import Solution, multi_start, random_starts, solve
from cablejax.mpc.timing import ControlTiming, time_control
from cablejax.mpc.trust_region import TrustRegion

__all__ = [
    "SOLVERS",
    "ControlInfo",
    "ControlTiming",
    "Controller",
    "ControllerState",
    "CrossEntropy",
    "Dogleg",
    "FeasibleSet",
    "GaussNewton",
    "MPCConfig",
    "ObjectiveConfig",
    "Outcome",
    "PathIntegral",
    "Plan",
    "ProjectedGradient",
    "ShapingProblem",
    "Solution",
    "Solver",
    "TrustRegion",
    "control",
    "feasible_from",
    "initial_state",
    "multi_start",
    "planning_problem",
    "project_ball",
    "random_starts",
    "solve",
    "time_control",
]
