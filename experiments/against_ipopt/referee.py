"""IPOPT on the controller's planning problems: a solver that shares nothing with ours but the objective.

It gets the same objective, gradient and, if asked, Hessian from JAX. The constraints are written here once more, from
the grippers' positions and bounds, and not taken from the solvers' feasible set, so that an error in that shows:

    (|u|^2 - r^2) / 2 r <= 0,   (|d|^2 - max^2) / 2 max <= 0,   (min^2 - |d|^2) / 2 min <= 0

for every step u of each gripper and every distance d between the grippers. Functions are evaluated in the problem's
precision: float64 to judge where it ends. In float32 its tolerances are out of reach, and only how soon it gets
somewhere says anything. It needs ipyopt, whose wheel carries IPOPT with MUMPS (Waechter and Biegler, Math. Program.
106, 2006).
"""

from __future__ import annotations

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.mpc.problem import ShapingProblem

FOUND = (0, 1)
"""IPOPT's return codes for an optimum to its tolerance, and to its acceptable one."""
SPENT = -4
"""Its code where the time was up."""
_NEVER = 1e20


@dataclasses.dataclass(frozen=True)
class Limits:
    """Bounds of a planning problem, as numbers.

    Attributes:
        separation: position of gripper 1 relative to gripper 0 at the plan's start [m], shape [2].
        radius: bound on the norm of each gripper's motion in each step [m].
        min_distance: least distance of the grippers [m].
        max_distance: greatest distance of the grippers [m].
    """

    separation: Float[np.ndarray, "2"]
    radius: float
    min_distance: float
    max_distance: float

    def violation(self, motion: Float[np.ndarray, "T 2 3"]) -> float:
        """By how much the worst step breaks its worst bound [m], in NumPy."""
        motion = np.asarray(motion, float)
        distance = np.linalg.norm(self.separation + np.cumsum(motion[:, 1, :2] - motion[:, 0, :2], axis=0), axis=1)
        excess = [np.linalg.norm(motion, axis=-1).max() - self.radius, distance.max() - self.max_distance]
        return float(max(0.0, *excess, self.min_distance - distance.min()))


@dataclasses.dataclass(frozen=True)
class RefereeConfig:
    """IPOPT's settings; those not named here are its own.

    Attributes:
        exact: with the exact Hessian of the Lagrangian, not the limited-memory approximation.
        tolerance: of the scaled optimality conditions.
        max_iterations: at most.
        max_seconds: after which it is stopped [s].
    """

    exact: bool = False
    tolerance: float = 1e-9
    max_iterations: int = 500
    max_seconds: float = 600.0


@dataclasses.dataclass(frozen=True)
class RefereeResult:
    """What IPOPT found.

    Attributes:
        motion: plan [m], shape [T, Q, 3].
        objective: its value [m^2].
        violation: largest excess over a bound [m].
        status: IPOPT's return code, see `FOUND`.
        iterations: of IPOPT.
        evaluations: numbers of objectives, gradients and Hessians asked for.
        seconds: wall time, without compilation if the functions are warm [s].
        path: (seconds, objective, largest excess over a bound [m]) after each iteration, shape [I, 3].
    """

    motion: Float[np.ndarray, "T Q 3"]
    objective: float
    violation: float
    status: int
    iterations: int
    evaluations: tuple[int, int, int]
    seconds: float
    path: Float[np.ndarray, "I 3"]

    @property
    def found(self) -> bool:
        """Whether it ended at an optimum."""
        return self.status in FOUND

    def seconds_to(self, objective: float) -> float:
        """When it first had a feasible plan as good as this [s]; infinite = never."""
        good = (self.path[:, 1] <= objective) & (self.path[:, 2] <= 1e-8)
        return float(self.path[good, 0].min()) if good.any() else float("inf")


def referee(
    problem: ShapingProblem,
    limits: Limits,
    start: Float[np.ndarray, "T Q 3"],
    config: RefereeConfig = RefereeConfig(),
) -> RefereeResult:
    """Solves a planning problem with IPOPT.

    Args:
        problem: its feasible set is not looked at.
        limits: the bounds.
        start: where IPOPT begins, the same as ours; it may move it off the bounds.
        config: settings.

    Raises:
        ImportError: ipyopt is not installed.
    """
    try:
        import ipyopt
    except ImportError as error:
        raise ImportError("The referee is IPOPT: install it with `pip install ipyopt`.") from error
    precision = problem.history.keypoints.dtype
    start = np.asarray(start, float)
    shape, n = start.shape, start.size
    bounds = jnp.asarray([*limits.separation, limits.radius, limits.min_distance, limits.max_distance], precision)

    def plan_of(x):
        return jnp.asarray(x.reshape(shape), precision)

    # Objectives range over decades from a run's first step to its last: IPOPT sees them relative to the start's.
    scale = 1.0 / max(float(value_of(problem, plan_of(start))), 1e-12)
    counts = [0, 0, 0]
    latest = start.ravel().copy()
    path: list[tuple[float, float, float]] = []
    began = time.perf_counter()

    def objective(x):
        counts[0] += 1
        return scale * float(value_of(problem, plan_of(x)))

    def gradient(x, out):
        counts[1] += 1
        # Objectives are asked for at more points than gradients, in line searches; gradients mostly where the value
        # is known already.
        out[()] = scale * np.asarray(slope_of(problem, plan_of(x))).ravel()
        latest[()] = x

    def constraints(x, out):
        out[()] = np.asarray(_constraints(bounds, plan_of(x)))

    def normals(x, out):
        out[()] = np.asarray(_normals(bounds, plan_of(x))).ravel()

    def curvature(x, multipliers, factor, out):
        counts[2] += 1
        matrix = _curvature(problem, bounds, plan_of(x), multipliers, factor * scale)
        out[()] = np.asarray(matrix)[lower]

    def watch(mode, count, value, *_):
        # The iterate is where the last gradient was taken, but for the restoration phase (mode 1), which minimises
        # something else. IPOPT's own figure of infeasibility is that of its slacks.
        excess = np.inf if mode == 1 else limits.violation(latest.reshape(shape))
        path.append((time.perf_counter() - began, value / scale, excess))
        return time.perf_counter() - began < config.max_seconds

    n_constraints = int(_constraints(bounds, jnp.asarray(start)).size)
    lower = np.tril_indices(n)
    dense = np.indices((n_constraints, n)).reshape(2, -1)
    solver = ipyopt.Problem(
        n,
        np.full(n, -_NEVER),
        np.full(n, _NEVER),
        n_constraints,
        np.full(n_constraints, -_NEVER),
        np.zeros(n_constraints),
        (dense[0], dense[1]),
        lower,
        objective,
        gradient,
        constraints,
        normals,
        curvature if config.exact else None,
        watch,
        ipopt_options={
            "print_level": 0,
            "sb": "yes",
            "tol": config.tolerance,
            "acceptable_tol": 10 * config.tolerance,
            "constr_viol_tol": 1e-9,
            "bound_relax_factor": 0.0,
            "max_iter": config.max_iterations,
            "hessian_approximation": "exact" if config.exact else "limited-memory",
            "limited_memory_max_history": 20,
            "mu_strategy": "adaptive",
        },
    )
    began = time.perf_counter()
    point, _, status = solver.solve(start.ravel().copy())
    seconds = time.perf_counter() - began
    motion = point.reshape(shape)
    return RefereeResult(
        motion=motion,
        objective=float(value_of(problem, plan_of(motion))),
        violation=limits.violation(motion),
        status=int(status),
        iterations=len(path),
        evaluations=(counts[0], counts[1], counts[2]),
        seconds=seconds,
        path=np.array(path).reshape(-1, 3),
    )


@jax.jit
def value_of(problem: ShapingProblem, motion: Float[Array, "T 2 3"]) -> Float[Array, ""]:
    """The objective of a plan [m^2], compiled."""
    return problem.value(motion)


@jax.jit
def slope_of(problem: ShapingProblem, motion: Float[Array, "T 2 3"]) -> Float[Array, "T 2 3"]:
    """Its gradient [m], compiled."""
    return jax.grad(problem.value)(motion)


@jax.jit
def _constraints(bounds: Float[Array, "5"], motion: Float[Array, "T 2 3"]) -> Float[Array, " K"]:
    separation, radius, least, most = bounds[:2], bounds[2], bounds[3], bounds[4]
    steps = (jnp.sum(motion**2, axis=-1) - radius**2) / (2 * radius)
    between = separation + jnp.cumsum(motion[:, 1, :2] - motion[:, 0, :2], axis=0)
    square = jnp.sum(between**2, axis=-1)
    return jnp.concatenate([steps.ravel(), (square - most**2) / (2 * most), (least**2 - square) / (2 * least)])


_normals = jax.jit(jax.jacrev(_constraints, argnums=1))


@jax.jit
def _curvature(problem, bounds, motion: Float[Array, "T 2 3"], multipliers, factor) -> Float[Array, "P P"]:
    """Hessian of the Lagrangian, forward over reverse, a few columns at a time."""

    def slope(flat):
        def lagrangian(flat):
            motion_ = flat.reshape(motion.shape)
            return factor * problem.value(motion_) + multipliers @ _constraints(bounds, motion_)

        return jax.grad(lagrangian)(flat)

    flat = motion.ravel()
    _, push = jax.linearize(slope, flat)
    return jax.lax.map(push, jnp.eye(flat.size), batch_size=12)
