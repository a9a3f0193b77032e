"""The planar elastica clamped at both ends: an independent boundary-value solution of the shape of a cable at rest.

A uniform, inextensible, unloaded rod with tangent angle `theta(s)` carries one constant internal force `F`, and the
balance of moments is (Love, *A treatise on the mathematical theory of elasticity*, chapter XIX)

    EI theta'' = Fx sin(theta) - Fy cos(theta),   x' = cos(theta),   y' = sin(theta).

Both ends are clamped: six boundary conditions for four first-order equations and the two unknowns `f = F / EI`. The
shape therefore does not depend on EI. `scipy.integrate.solve_bvp` solves it by collocation; a continuation leads from
a nearly straight rod, where the answer is known, to the wanted ends. Nothing here is shared with the link chain of the
simulators, so it can check them.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.integrate import cumulative_trapezoid, solve_bvp

from cablejax.arrays import positions_at
from cablejax.poses import planar_rows

MESH = 61
"""Points of the initial collocation mesh."""
SMALL_ANGLE = 0.15
"""Angle [rad] between an end's tangent and the chord up to which the small-deflection beam is a good first guess."""
SMALLEST_STEP = 1 / 512
"""Smallest step of the continuation, as a fraction of the whole way, before it gives up."""

LARGEST_TURN = 0.6
"""Largest change of the tangent's angle [rad] anywhere in one step of the continuation."""


class ElasticaError(ValueError):
    """No equilibrium was found for these ends."""


@dataclasses.dataclass(frozen=True)
class Elastica:
    """A clamped elastica, sampled along its arc length.

    Attributes:
        arclength: from gripper 0 [m], shape [S].
        position: centreline [m], shape [S, 2].
        angle: tangent's angle [rad], continuous along the rod, shape [S].
        curvature: [1/m], shape [S].
        force: constant internal force over EI [1/m^2], shape [2].
    """

    arclength: Float[np.ndarray, " S"]
    position: Float[np.ndarray, "S 2"]
    angle: Float[np.ndarray, " S"]
    curvature: Float[np.ndarray, " S"]
    force: Float[np.ndarray, " 2"]

    def stability(self, n_nodes: int = 241) -> float:
        """Smallest eigenvalue [1/m^2] of the second variation of the bending energy over EI; positive = stable.

        The variations `phi` of the angle vanish at both clamps and keep the ends in place, `int phi sin = int phi cos
        = 0`; on them the second variation is `int phi'^2 + (f . t) phi^2 ds` with the tangent `t`, here by second-order
        finite differences on `n_nodes` nodes.
        """
        s = np.linspace(0.0, self.arclength[-1], n_nodes)[1:-1]
        angle = np.interp(s, self.arclength, self.angle)
        tangent = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        h = s[1] - s[0]
        off = np.full(len(s) - 1, -1.0)
        second = (np.diag(np.full(len(s), 2.0)) + np.diag(off, 1) + np.diag(off, -1)) / h**2
        second += np.diag(tangent @ self.force)
        basis, _ = np.linalg.qr(tangent, mode="complete")
        free = basis[:, 2:]
        return float(np.linalg.eigvalsh(free.T @ second @ free)[0])


def solve_elastica(
    gripper_pose: Float[np.ndarray, "2 3"],
    length: float,
    *,
    guess: Float[np.ndarray, "S 2"] | None = None,
    n_samples: int = 241,
) -> Elastica:
    """Equilibrium shape of a uniform rod between two clamps.

    Several shapes can fit the same clamps. Without `guess` the solver follows the one that grows out of a nearly
    straight rod as the ends turn and approach in proportion, and another one where that is unstable; for ends (almost)
    on their chord that is an arch to the side to which they lean, to the left of the chord where they do not.

    Args:
        gripper_pose: (x, y, theta) of the two ends [m, rad], shape [2, 3]; theta is the tangent's direction in the
            sense of growing arc length, and counts turns: 0 and 2 pi are different rods.
        length: of the rod [m].
        guess: points of a similar shape, uniform in arc length [m], shape [S, 2]; picks one of several solutions.
        n_samples: samples returned, uniform in arc length.

    Raises:
        ElasticaError: the chord is not shorter than the rod, or no solution was found.
    """
    pose = planar_rows(gripper_pose, "gripper_pose")
    delta = pose[1, :2] - pose[0, :2]
    chord = float(np.hypot(*delta)) / length
    if chord >= 1.0:
        raise ElasticaError(
            f"The ends are {chord * length:.4g} m apart but the rod is {length:.4g} m long: bring them closer."
        )
    # Work on a rod of unit length along its own chord; the chord's direction takes the turn count of the ends' mean.
    direction = np.arctan2(delta[1], delta[0]) if chord > 0 else 0.0
    direction += 2 * np.pi * np.round((pose[:, 2].mean() - direction) / (2 * np.pi))
    ends = np.array([pose[0, 2] - direction, pose[1, 2] - direction, chord])

    def placed(solution) -> Elastica:
        s = np.linspace(0.0, 1.0, n_samples)
        x, y, angle, curvature = solution.sol(s)
        cos, sin = np.cos(direction), np.sin(direction)
        turn = np.array([[cos, -sin], [sin, cos]])
        return Elastica(
            arclength=s * length,
            position=pose[0, :2] + length * np.stack([x, y], axis=1) @ turn.T,
            angle=angle + direction,
            curvature=curvature / length,
            force=turn @ solution.p / length**2,
        )

    if guess is not None:
        solution = _solve(ends, *_from_points(np.asarray(guess, float), direction))
        if solution is None:
            raise ElasticaError("No equilibrium near the given guess: pass a guess closer to the wanted shape.")
        return placed(solution)
    shapes = []
    for solution in _continue(ends):
        shapes.append(placed(solution))
        if shapes[-1].stability() > 0:
            return shapes[-1]
    if not shapes:
        raise ElasticaError(
            f"No equilibrium found for end angles {ends[0]:.3f} and {ends[1]:.3f} rad against the chord and a chord of "
            f"{ends[2]:.3f} lengths: with such large end angles so close together, no equilibrium can be reached "
            "continuously from a straight cable. Choose smaller angles or pass a guess."
        )
    return shapes[0]


def elastica(
    gripper_pose: Float[np.ndarray, "2 3"],
    length: float,
    arclength: Float[np.ndarray, " N"],
    *,
    guess: Float[np.ndarray, "S 2"] | None = None,
) -> Float[np.ndarray, "N 2"]:
    """Points of the clamped elastica at given arc lengths [m]; see `solve_elastica`."""
    shape = solve_elastica(gripper_pose, length, guess=guess, n_samples=2001)
    return positions_at(arclength, shape.arclength, shape.position)


def _rod(s, state, force):
    _, _, angle, curvature = state
    sin, cos = np.sin(angle), np.cos(angle)
    return np.stack([cos, sin, curvature, force[0] * sin - force[1] * cos])


def _solve(ends, mesh, state, force):
    """Collocation solution for ends (angle 0, angle 1, chord) from a guess, or None."""

    def residual(left, right, _):
        return np.array([left[0], left[1], left[2] - ends[0], right[0] - ends[2], right[1], right[2] - ends[1]])

    solution = solve_bvp(_rod, residual, mesh, state, p=force, tol=1e-7, max_nodes=4000)
    return solution if solution.success else None


def _continue(ends):
    """Solutions for `ends`, followed from a nearly straight rod in two ways.

    On the first way the ends approach in proportion as they turn. Early on they are then closer than their small angles
    ask for, so that the rod buckles: for an S this may end at a fork, or in a shape that does not last. On the second
    they approach with the square of the way, as the ends of a beam do.
    """
    start, solution = _start(ends)
    if solution is not None:
        for power in (1, 2):
            if found := _follow(start, ends, solution, power):
                yield found


def _follow(start, ends, solution, power):
    """The solution for `ends` that grows out of one for `start`, or None. Steps halve where the solver fails.

    The ends' angles change in proportion to the way, and their approach, to the power 1 / `power`, does as well.
    """
    done, step = 0.0, 0.25
    slack = (1.0 - np.array([start[2], ends[2]])) ** (1 / power)
    while done < 1.0:
        fraction = min(1.0, done + step)
        at = start + fraction * (ends - start)
        at[2] = 1.0 - (slack[0] + fraction * (slack[1] - slack[0])) ** power
        trial = _solve(at, solution.x, solution.y, solution.p)
        # A jump to another branch shows as an angle that changes by much more than the ends did.
        moved = np.inf if trial is None else np.abs(trial.sol(_PROBE)[2] - solution.sol(_PROBE)[2]).max()
        if trial is not None and moved < LARGEST_TURN:
            solution, done = trial, fraction
            step *= 1.5
        else:
            step /= 2
            if step < SMALLEST_STEP:
                return None
    return solution


def _start(ends):
    """Ends near the straight rod on the way to `ends`, and the solution there, from small-deflection beam theory."""
    s = np.linspace(0.0, 1.0, MESH)
    largest = np.abs(ends[:2]).max()
    if largest < 0.5 * SMALL_ANGLE:
        # The first buckling mode of a clamped column: angle = A sin(2 pi s), shortening A^2 / 4, force -(2 pi)^2.
        amplitude = SMALL_ANGLE if ends[0] >= ends[1] else -SMALL_ANGLE
        angle = amplitude * np.sin(2 * np.pi * s)
        curvature = 2 * np.pi * amplitude * np.cos(2 * np.pi * s)
        start, force = np.array([0.0, 0.0, 1 - amplitude**2 / 4]), np.array([-4 * np.pi**2, 0.0])
    else:
        # A beam with end slopes a and b: cubic deflection, shortening (2 a^2 - a b + 2 b^2) / 30, shear -6 (a + b).
        a, b = ends[:2] * (SMALL_ANGLE / largest)
        angle = a * (1 - 4 * s + 3 * s**2) + b * (3 * s**2 - 2 * s)
        curvature = a * (6 * s - 4) + b * (6 * s - 2)
        start, force = np.array([a, b, 1 - (2 * a**2 - a * b + 2 * b**2) / 30]), np.array([0.0, -6 * (a + b)])
    return start, _solve(start, s, _from_angle(s, angle, curvature), force)


def _from_angle(s, angle, curvature):
    x = cumulative_trapezoid(np.cos(angle), s, initial=0.0)
    y = cumulative_trapezoid(np.sin(angle), s, initial=0.0)
    return np.stack([x, y, angle, curvature])


def _from_points(points, direction):
    """Mesh, state and force of a guess given as points uniform in arc length."""
    edges = np.diff(points, axis=0)
    middle = (np.arange(len(edges)) + 0.5) / len(edges)
    angle = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0])) - direction
    angle -= 2 * np.pi * np.round(angle.mean() / (2 * np.pi))
    s = np.linspace(0.0, 1.0, MESH)
    smooth = np.interp(s, middle, angle)
    curvature = np.gradient(smooth, s)
    # The force that balances the guess best: least squares on theta'' = fx sin - fy cos.
    columns = np.stack([np.sin(smooth), -np.cos(smooth)], axis=1)
    force = np.linalg.lstsq(columns, np.gradient(curvature, s), rcond=None)[0]
    return s, _from_angle(s, smooth, curvature), force


_PROBE = np.linspace(0.0, 1.0, 41)
