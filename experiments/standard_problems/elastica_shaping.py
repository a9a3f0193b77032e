"""Shaping an ideal rod: move its two clamped ends in bounded steps until it has a wanted shape.

The rod is the planar elastica of `simulate.elastica`, uniform, inextensible and without weight, in equilibrium after
every step. From one end it is an initial value problem with three unknowns, the curvature there and the internal force,

    theta'' = f_x sin(theta) - f_y cos(theta),   x' = cos(theta),   y' = sin(theta),

which the pose of the other end determines. They are found by Newton's method along the plan, each step from the last
one's solution, and the derivative is that of the implicit function theorem: one more Newton step, written so that only
the residual is differentiated. Exact to the order of the Runge-Kutta steps in value, exact in first derivatives.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.simulate.elastica import solve_elastica
from standard_problems.base import BoundedProblem

STEPS = 4
"""Motions of a plan; each moves both ends, (dx, dy, ROTATION dtheta) in metres."""
ROTATION = 0.15
"""Length that a rotation of one radian counts as [m/rad]."""
MOTION_WEIGHT = 1e-3
"""Weight of the squared motion relative to the squared distance to the target."""
POINTS = 13
"""Points of the shape that is compared; the rod is 1 m long."""
_SUBSTEPS = 4
"""Runge-Kutta steps between two points."""
_NEWTON = 8
"""Newton iterations per motion; a motion changes the unknowns little, and three or four suffice."""


@dataclasses.dataclass(frozen=True, eq=False)
class ElasticaShaping:
    """One task.

    Attributes:
        start: (x, y, theta) of both ends at the beginning [m, rad], shape [2, 3].
        target: wanted points [m], shape [N, 2].
        unknowns: curvature [1/m] and force over EI [1/m^2] at the beginning, shape [3].
    """

    start: Float[np.ndarray, "2 3"]
    target: Float[np.ndarray, "N 2"]
    unknowns: Float[np.ndarray, "3"]

    def shapes(self, motion: Float[Array, "T 2 3"]) -> Float[Array, "T N 2"]:
        """Points of the rod after every motion [m]."""
        pose = jnp.asarray(self.start) + jnp.cumsum(motion / jnp.array([1.0, 1.0, ROTATION]), axis=0)

        def one_step(unknowns, pose):
            unknowns = _equilibrium(unknowns, pose)
            return unknowns, _points(unknowns, pose)[0]

        return jax.lax.scan(one_step, jnp.asarray(self.unknowns), pose)[1]

    def residuals(self, motion: Float[Array, "T 2 3"]) -> Float[Array, " M"]:
        """Distances of all shapes to the target and motions, weighted [m]."""
        distance = (self.shapes(motion) - jnp.asarray(self.target)) / POINTS**0.5
        return jnp.concatenate([distance.ravel(), MOTION_WEIGHT**0.5 * motion.ravel()])


def elastica_problems() -> list[BoundedProblem]:
    """An arch to another arch and to a hook, with balls that bind in no, some and most steps, and with boxes."""
    arch = np.array([[-0.45, 0.0, 0.5], [0.45, 0.0, -0.5]])
    # A shape, its ends' poses, and the best objective known for each bound on the steps.
    bows = np.array([[-0.42, 0.02, 0.75], [0.44, 0.0, -0.6]])
    hook = np.array([[-0.42, 0.0, 1.0], [0.46, 0.05, 0.0]])
    problems = []
    for name, goal, radii in (("arch", bows, (0.2, 0.03, 0.01)), ("hook", hook, (0.2, 0.05, 0.02))):
        task = _task(arch, goal)
        for radius in radii:
            problems.append(
                BoundedProblem(
                    f"elastica to {name}, steps <= {radius} m",
                    "elastica",
                    np.zeros((STEPS, 2, 3)),
                    OPTIMA[name, radius],
                    residuals=task.residuals,
                    radius=radius,
                    note="best of many starts",
                )
            )
        bound = np.full((STEPS, 2, 3), radii[1])
        problems.append(
            BoundedProblem(
                f"elastica to {name}, coordinates <= {radii[1]} m",
                "elastica",
                np.zeros((STEPS, 2, 3)),
                OPTIMA[name, "box"],
                residuals=task.residuals,
                lower=-bound,
                upper=bound,
                note="best of many starts",
            )
        )
    return problems


OPTIMA: dict[tuple[str, float | str], float] = {
    ("arch", 0.2): 1.46423399135e-06,
    ("arch", 0.03): 2.60792827365e-05,
    ("arch", 0.01): 0.000381084564438,
    ("arch", "box"): 1.85797667297e-06,
    ("hook", 0.2): 7.18844875775e-06,
    ("hook", 0.05): 5.69715885175e-05,
    ("hook", 0.02): 0.000327398842135,
    ("hook", "box"): 3.76129651601e-05,
}


def _task(start: np.ndarray, goal: np.ndarray) -> ElasticaShaping:
    """The target is where the rod rests between the ends `goal`."""
    at_start, at_goal = (solve_elastica(pose, 1.0, n_samples=1201) for pose in (start, goal))
    arclength = np.linspace(0.0, 1.0, POINTS)
    target = np.stack([np.interp(arclength, at_goal.arclength, at_goal.position[:, i]) for i in range(2)], axis=1)
    return ElasticaShaping(start, target, np.array([at_start.curvature[0], *at_start.force]))


def _points(unknowns: Float[Array, "3"], pose: Float[Array, "2 3"]) -> tuple[Float[Array, "N 2"], Float[Array, "3"]]:
    """Points of the rod that leaves the first end with these unknowns [m], and (x, y, theta) where it ends."""

    def slope(state):
        angle, curvature = state[2], state[3]
        bending = unknowns[1] * jnp.sin(angle) - unknowns[2] * jnp.cos(angle)
        return jnp.stack([jnp.cos(angle), jnp.sin(angle), curvature, bending])

    h = 1.0 / ((POINTS - 1) * _SUBSTEPS)

    def runge_kutta(state, _):
        a = slope(state)
        b = slope(state + 0.5 * h * a)
        c = slope(state + 0.5 * h * b)
        d = slope(state + h * c)
        state = state + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        return state, state

    state = jnp.concatenate([pose[0], unknowns[:1]])
    end, states = jax.lax.scan(runge_kutta, state, length=(POINTS - 1) * _SUBSTEPS)
    return jnp.concatenate([state[None, :2], states[_SUBSTEPS - 1 :: _SUBSTEPS, :2]]), end[:3]


def _equilibrium(unknowns: Float[Array, "3"], pose: Float[Array, "2 3"]) -> Float[Array, "3"]:
    """Curvature and force of the rod between these ends, from those of a similar one."""

    def miss(unknowns, pose):
        return _points(unknowns, pose)[1] - pose[1]

    def newton(unknowns, pose, _):
        jacobian = jax.jacfwd(miss)(unknowns, pose)
        return unknowns - jnp.linalg.solve(jacobian, miss(unknowns, pose))

    fixed = jax.lax.stop_gradient(pose)
    root = jax.lax.fori_loop(0, _NEWTON, lambda i, u: newton(u, fixed, i), jax.lax.stop_gradient(unknowns))
    root = jax.lax.stop_gradient(root)
    jacobian = jax.lax.stop_gradient(jax.jacfwd(miss)(root, fixed))
    return root - jnp.linalg.solve(jacobian, miss(root, pose))
