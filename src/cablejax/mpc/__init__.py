"""Model predictive control of a cable's shape: feasible motions, the planning problem, its solvers, the controller."""

from cablejax.mpc.controller import ControlInfo, Controller, ControllerState, MPCConfig, control, initial_state
from cablejax.mpc.feasible import FeasibleSet, project_ball
from cablejax.mpc.problem import ObjectiveConfig, Outcome, Plan, ShapingProblem, Solver
from cablejax.mpc.projected_gradient import ProjectedGradient
from cablejax.mpc.timing import ControlTiming, time_control
from cablejax.mpc.trust_region import TrustRegion

__all__ = [
    "ControlInfo",
    "ControlTiming",
    "Controller",
    "ControllerState",
    "FeasibleSet",
    "MPCConfig",
    "ObjectiveConfig",
    "Outcome",
    "Plan",
    "ProjectedGradient",
    "ShapingProblem",
    "Solver",
    "TrustRegion",
    "control",
    "initial_state",
    "project_ball",
    "time_control",
]
