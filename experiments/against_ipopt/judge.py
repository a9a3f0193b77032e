"""Solves a planning problem by our solver and by IPOPT, and compares objective, feasibility, optimality and time.

The problems are those of the network with rounded corners (`against_ipopt.rounded`): with the network as trained, the
gradient jumps and no point is stationary. The objectives of the plans with the trained network are reported too.

Two KKT residuals are given. The absolute one is that of `certify`, in metres as the objective's gradient is: 1e-5 means
that moving a gripper by 1 mm promises no more than 1e-8 m^2. The scaled one is what IPOPT calls the dual infeasibility,
of the objective divided by its value at the start: the same over `objective(start)`, in 1/m.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from against_ipopt.accurate import Accurate
from against_ipopt.planning_problems import PlanningCase, ProblemMaker, smooth_model
from against_ipopt.referee import RefereeConfig, referee, slope_of, value_of
from against_ipopt.solver_path import PathFinder, SolverPath
from cablejax.bounded import certify
from cablejax.control.shaping import Model
from cablejax.mpc import ShapingProblem
from rows import Rows

EQUAL = 1e-6
"""Relative difference of objectives that counts as none."""
STATIONARY = 1e-5
"""KKT residual of a minimum [m]."""
FEASIBLE = 1e-8
"""By how much a plan may break a bound [m]."""
REACH, POINTS = 1e-5, 101
"""How far along a direction the slope is looked at, to either side [m], and at how many points."""
ACCURATE = Accurate(gradients=100)
"""Ours. In float32 with 1000 times its tolerance on the projected gradient."""

Find = Callable[[ShapingProblem, "Float[Array | np.ndarray, 'T Q 3']", int], SolverPath]


@dataclasses.dataclass(frozen=True)
class Contestant:
    """Our accurate setting, in both precisions.

    Attributes:
        make: problems in float64.
        make_sharp: the same of the network as it was trained.
        make_single: in float32.
        find: `(problem, start, gradients)` to the path of the solver in float64, with so many gradients at most in its
            second part.
        find_single: in float32.
    """

    make: ProblemMaker
    make_sharp: ProblemMaker
    make_single: ProblemMaker
    find: Find
    find_single: Find


def contestant(model: Model) -> Contestant:
    """`ACCURATE` on a model's problems; call it, and all else here, with x64 enabled in JAX."""

    def finder(accurate: Accurate) -> Find:
        first, second = (
            PathFinder(
                lambda motion, problem: problem.residuals(motion),
                solver,
                lambda motion, problem: problem.linearise(motion),
            )
            for solver in accurate.parts()
        )

        def find(problem: ShapingProblem, start: Float[Array | np.ndarray, "T Q 3"], gradients: int) -> SolverPath:
            near = first(problem, problem.feasible, start, accurate.linearisations)
            return near.followed_by(second(problem, problem.feasible, near.points[-1], gradients))

        return find

    smooth = smooth_model(model)
    with jax.enable_x64(False):
        make_single = ProblemMaker(smooth, np.float32)
    coarse = dataclasses.replace(ACCURATE, tolerance=1000 * ACCURATE.tolerance)
    return Contestant(ProblemMaker(smooth), ProblemMaker(model), make_single, finder(ACCURATE), finder(coarse))


def judge(
    ours: Contestant, case: PlanningCase, referees: Sequence[RefereeConfig], gradients: int = ACCURATE.gradients
) -> dict[str, Any]:
    """One problem by all, ours with so many gradients at most; both begin at the same feasible plan.

    Returns:
        A row that JSON can hold: of ours `start` and `objective` [m^2], `start_slope` (largest element of the gradient
        there) [m], `violation` [m], `kkt` and `kkt_scaled` (see above), `steps`, `converged`, `seconds`,
        `motion`, `sharp_objective` by the network as it was trained, `single_objective` and `single_violation` of the
        plan found in float32, evaluated in float64; and for each referee, under `limited` or `exact`, what it found and
        the seconds in which either first reached the objective that both reach.
    """
    problem, sharp, limits = ours.make(case), ours.make_sharp(case), case.limits()
    start = np.asarray(problem.feasible.project(jnp.asarray(case.guess)))
    path = ours.find(problem, start, gradients)
    scale = float(path.objectives[0])
    kkt = kkt_residual(problem, path.points[-1])
    row: dict[str, Any] = {
        "name": case.name,
        "start": scale,
        "start_slope": float(jnp.abs(slope_of(problem, jnp.asarray(start))).max()),
        "objective": float(path.objectives[-1]),
        "sharp_objective": float(value_of(sharp, jnp.asarray(path.points[-1]))),
        "violation": limits.violation(path.points[-1]),
        "kkt": kkt,
        "kkt_scaled": kkt / scale,
        "steps": len(path.seconds) - 1,
        "converged": path.converged,
        "seconds": float(path.seconds[-1]),
        "motion": path.points[-1].tolist(),
    }
    with jax.enable_x64(False):
        single = ours.make_single(case)
        plan = ours.find_single(single, start.astype(np.float32), gradients).points[-1]
    row["single_objective"] = float(value_of(problem, jnp.asarray(plan, jnp.float64)))
    row["single_violation"] = limits.violation(plan)
    for config in referees:
        found = referee(problem, limits, start, config)
        both = max(found.objective, row["objective"]) * (1 + EQUAL)
        kkt = kkt_residual(problem, found.motion)
        row["exact" if config.exact else "limited"] = {
            "objective": found.objective,
            "sharp_objective": float(value_of(sharp, jnp.asarray(found.motion))),
            "violation": found.violation,
            "kkt": kkt,
            "kkt_scaled": kkt / scale,
            "status": found.status,
            "iterations": found.iterations,
            "evaluations": found.evaluations,
            "seconds": found.seconds,
            "seconds_to_both": found.seconds_to(both),
            "ours_seconds_to_both": path.seconds_to(both),
            "motion": found.motion.tolist(),
        }
    return row


def kkt_residual(problem: ShapingProblem, motion) -> float:
    """The worst of stationarity, feasibility and complementarity at a plan [m]."""
    point = jnp.asarray(motion)
    return float(_certificate(problem, slope_of(problem, point), point).residual)


def excess(row: dict[str, Any], which: str) -> float:
    """By how much our objective is above the referee's, relative to it."""
    return (row["objective"] - row[which]["objective"]) / row[which]["objective"]


def better_referee(row: dict[str, Any]) -> dict[str, Any]:
    """What the referee with the lower objective found."""
    return min((row[which] for which in ("limited", "exact") if which in row), key=lambda found: found["objective"])


def as_good(found: dict[str, Any], row: dict[str, Any]) -> bool:
    """Whether a plan of ours, the row's own or one from another start, is as good as every referee's."""
    return found["objective"] <= better_referee(row)["objective"] * (1 + EQUAL)


def meets_all(found: dict[str, Any], row: dict[str, Any]) -> bool:
    """Whether it is as good, feasible and stationary."""
    return as_good(found, row) and found["violation"] <= FEASIBLE and found["kkt"] < STATIONARY


def explain(ours: Contestant, case: PlanningCase, row: dict[str, Any], starts: int) -> dict[str, Any]:
    """Why the plan of a row does not have all that is asked: whether a plan has it that is found from elsewhere.

    Args:
        ours: the solver.
        case: the problem.
        row: of `judge`.
        starts: at random, at most; no other is tried once a plan has all.

    Returns:
        A row that JSON can hold: `steepness` of the model at the row's plan and `their_steepness` at the referee's;
        what was found from `starts`, and `from_theirs`, begun at the referee's plan, None where a start has led to all.
    """
    problem, limits, rng = ours.make(case), case.limits(), np.random.default_rng([len(case.name), 12])
    theirs, mine = np.asarray(better_referee(row)["motion"]), np.asarray(row["motion"])

    def find(start) -> dict[str, Any]:
        path = ours.find(problem, start, ACCURATE.gradients)
        plan = path.points[-1]
        return {
            "objective": float(path.objectives[-1]),
            "kkt": kkt_residual(problem, plan),
            "violation": limits.violation(plan),
            "apart": float(np.linalg.norm(plan - mine, axis=-1).max()),
        }

    found = []
    for start in rng.uniform(-1.0, 1.0, (starts, *case.guess.shape)) * case.radius / 3**0.5:
        found.append(find(start))
        if meets_all(found[-1], row):
            from_theirs = None
            break
    else:
        from_theirs = find(theirs)
    return {
        "name": case.name,
        "steepness": steepness(problem, mine),
        "their_steepness": steepness(problem, theirs),
        "starts": found,
        "from_theirs": from_theirs,
    }


def rows_of(folder: pathlib.Path, kind: str = "rows") -> Rows:
    """Rows of a kind in a folder, one for each problem: "rows", "explained", "kinks" or "calls"."""
    return Rows(folder / f"{kind}.jsonl", ("name",))


def comparable_seconds(
    rows: Sequence[dict[str, Any]], which: str, equal: float = EQUAL
) -> tuple[np.ndarray, np.ndarray]:
    """Our and the referee's seconds to the worse of their final objectives, where these are within `equal`, relative.

    Left out are problems whose start is already as good as that: they say nothing about speed.
    """
    pairs = [
        (row[which]["ours_seconds_to_both"], row[which]["seconds_to_both"])
        for row in rows
        if which in row and abs(excess(row, which)) <= equal
    ]
    both = np.array([pair for pair in pairs if pair[0] > 0 and np.isfinite(pair[1])]).reshape(-1, 2)
    return both[:, 0], both[:, 1]


def slopes_along(
    problem: ShapingProblem, motion: np.ndarray, rng: np.random.Generator, reach: float, points: int
) -> np.ndarray:
    """Slope of the objective along a random unit direction, at points up to `reach` [m] to either side of a plan."""
    direction = rng.normal(size=motion.shape)
    direction /= np.linalg.norm(direction)
    along = np.linspace(-reach, reach, points)
    return np.array(
        [np.sum(np.asarray(slope_of(problem, jnp.asarray(motion + t * direction))) * direction) for t in along]
    )


def keypoints_apart(problem: ShapingProblem, other: ShapingProblem, motion: np.ndarray) -> float:
    """Largest distance of a keypoint, predicted under a plan, from where the other problem's model expects it [m]."""
    apart = _rollout(problem, jnp.asarray(motion)) - _rollout(other, jnp.asarray(motion))
    return float(jnp.linalg.norm(apart, axis=-1).max())


def steepness(problem: ShapingProblem, motion: np.ndarray) -> float:
    """Largest singular value of the residuals' Jacobian at a plan [m/m]: some 5, but where the cable snaps through."""
    return float(np.linalg.norm(np.asarray(_jacobian(problem, jnp.asarray(motion))), 2))


@jax.jit
def _jacobian(problem: ShapingProblem, motion):
    return problem.linearise(motion)[1]


@jax.jit
def _rollout(problem: ShapingProblem, motion):
    return problem.rollout(motion).shapes


@jax.jit
def _certificate(problem: ShapingProblem, slope, motion):
    return certify(slope, problem.feasible, motion)
