"""A wire that hangs at rest between two clamps, in a vertical plane: the elastica with weight.

Links of equal length h at the angles theta_i, bending joints between them and half a link inside each clamp. At rest
the energy

    E(theta) = sum_j EI_j / (2 l_j) (Delta theta_j - l_j kappa_j)^2 + sum_i w (L - s_i) h sin(theta_i)

is stationary under the two conditions that the last link ends where the second clamp is; here w is the weight per
length, s_i the arc length of the middle of link i, l_j = h the length that belongs to joint j, h / 2 at the clamps, and
kappa_j the rest curvature. In the limit this is

    EI (theta'' - kappa_0') = (w (L - s) + Fy) cos(theta) - Fx sin(theta).

Only EI / w shows in a shape. A rest curvature that is the same all along does not show at all: with both clamp angles
held, its work is that of the total turn, which is given. Newton's method solves the conditions; derivatives are those
of the solution, by the implicit function theorem, in both modes, in everything that `Wire` and the clamps hold.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_MOST_STEPS = 40
_CONVERGED = 1e-9
"""Largest change of a link's angle [rad] after which Newton's method ends."""
_LARGEST_TURN = 0.3
"""Largest change of a link's angle [rad] in one step of Newton's method."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Wire:
    """Parameters of the shape of a hanging wire of M links.

    Attributes:
        stiffness: EI over the weight per length [m^3], at each of the M + 1 joints, the two at the clamps included.
        rest_curvature: [1/m], at the same joints; its sign is that of the angle theta, counter-clockwise.
        length: [m].
    """

    stiffness: Float[Array, "*B J"]
    rest_curvature: Float[Array, "*B J"]
    length: Float[Array, "*B"]


def joint_arclength(links: int, length: Any) -> Any:
    """Arc length of the joints, the clamps first and last [m], shape [links + 1]."""
    return jnp.linspace(0.0, 1.0, links + 1) * length


def hanging_angles(
    wire: Wire,
    clamps: Float[Array, "2 3"],
    guess: Float[Array, " M"],
) -> Float[Array, " M"]:
    """Angles of the links of a wire at rest [rad], counter-clockwise from the horizontal, shape [M].

    Which of several equilibria is found, or whether one is, depends on the guess. Differentiable in the wire and the
    clamps, in both modes.

    Args:
        wire: of M links.
        clamps: x, z and angle of the first and second clamp; the angle is not taken modulo a turn [m, rad].
        guess: angles near the wanted equilibrium [rad]; no derivatives are taken in it.
    """
    start = jnp.append(jax.lax.stop_gradient(guess), jnp.zeros(2, guess.dtype))

    def solve(residual, unknowns):
        def going_on(state):
            _, change, step = state
            return (jnp.abs(change[:-2]).max() > _CONVERGED) & (step < _MOST_STEPS)

        def newton(state):
            unknowns, _, step = state
            change = jnp.linalg.solve(_jacobian(unknowns, wire), -residual(unknowns))
            largest = jnp.abs(change[:-2]).max()
            return unknowns + change * jnp.minimum(1.0, _LARGEST_TURN / (largest + 1e-300)), change, step + 1

        return jax.lax.while_loop(going_on, newton, (unknowns, jnp.full_like(unknowns, jnp.inf), 0))[0]

    def tangent_solve(linear, value):
        # The zeros do not depend on the value: many tangents share one factorisation.
        return jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros(value.shape, value.dtype)), value)

    return jax.lax.custom_root(lambda u: _residual(u, wire, clamps), start, solve, tangent_solve)[:-2]


def hanging_points(
    angles: Float[Array, " M"], clamps: Float[Array, "2 3"], length: Any, count: int
) -> Float[Array, "N 2"]:
    """Points at equal arc lengths [m], ends included, shape [count, 2]; M must be a multiple of count - 1."""
    links = angles.shape[0]
    step = length / links * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    nodes = clamps[0, :2] + jnp.concatenate([jnp.zeros((1, 2), step.dtype), jnp.cumsum(step, axis=0)])
    return nodes[:: links // (count - 1)]


def _residual(unknowns: Float[Array, " U"], wire: Wire, clamps: Float[Array, "2 3"]) -> Float[Array, " U"]:
    """Moments on the links over the weight per length [m^2], and what the end misses the clamp by [m]."""
    angles, force = unknowns[:-2], unknowns[-2:]
    links = angles.shape[0]
    h = wire.length / links
    turn = jnp.diff(angles, prepend=clamps[0, 2], append=clamps[1, 2])
    moment = wire.stiffness * (turn / _belongs(links, h) - wire.rest_curvature)
    below = _below(links, wire.length)
    cosine, sine = jnp.cos(angles), jnp.sin(angles)
    balance = moment[:-1] - moment[1:] + h * ((below + force[1]) * cosine - force[0] * sine)
    ends = clamps[1, :2] - clamps[0, :2] - h * jnp.stack([cosine.sum(), sine.sum()])
    return jnp.concatenate([balance, ends])


def _jacobian(unknowns: Float[Array, " U"], wire: Wire) -> Float[Array, "U U"]:
    """Derivative of `_residual` in the unknowns."""
    angles, force = unknowns[:-2], unknowns[-2:]
    links = angles.shape[0]
    h = wire.length / links
    spring = wire.stiffness / _belongs(links, h)
    cosine, sine = jnp.cos(angles), jnp.sin(angles)
    below = _below(links, wire.length)
    diagonal = spring[:-1] + spring[1:] - h * ((below + force[1]) * sine + force[0] * cosine)
    inner = jnp.diag(diagonal) - jnp.diag(spring[1:-1], 1) - jnp.diag(spring[1:-1], -1)
    lever = h * jnp.stack([-sine, cosine], axis=-1)
    return jnp.block([[inner, lever], [-lever.T, jnp.zeros((2, 2), inner.dtype)]])


def _belongs(links: int, h: Any) -> Float[Array, " J"]:
    """Length that belongs to each joint [m]."""
    return jnp.full(links + 1, h).at[jnp.array([0, -1])].set(0.5 * h)


def _below(links: int, length: Any) -> Float[Array, " M"]:
    """Length of wire from the middle of each link to the second clamp [m]: what hangs on that link."""
    return length - (jnp.arange(links) + 0.5) * (length / links)
