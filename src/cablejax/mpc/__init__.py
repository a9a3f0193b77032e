"""Model predictive control of a cable's shape: feasible motions, the planning problem, its solvers, the controller."""

from cablejax.mpc.accurate import Accurate
from cablejax.mpc.cem import CrossEntropy
from cablejax.mpc.config import MPCConfig
from cablejax.mpc.controller import Controller, control
from cablejax.mpc.controller_state import ControlInfo, ControllerState, initial_state
from cablejax.mpc.feasible import FeasibleSet, feasible_from, project_ball
from cablejax.mpc.mppi import PathIntegral
from cablejax.mpc.multi_start import multi_start, random_starts
from cablejax.mpc.named import SOLVERS
from cablejax.mpc.plan import Outcome, Plan, Solver
from cablejax.mpc.problem import ObjectiveConfig, ShapingProblem
from cablejax.mpc.projected_gradient import ProjectedGradient
from cablejax.mpc.rollout import Rollout
from cablejax.mpc.sensitivity import differentiable_plan
from cablejax.mpc.timing import ControlTiming, time_control
from cablejax.mpc.trust_region import Dogleg, GaussNewton, TrustRegion

__all__ = [
    "SOLVERS",
    "Accurate",
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
    "Rollout",
    "ShapingProblem",
    "Solver",
    "TrustRegion",
    "control",
    "differentiable_plan",
    "feasible_from",
    "initial_state",
    "multi_start",
    "project_ball",
    "random_starts",
    "time_control",
]
