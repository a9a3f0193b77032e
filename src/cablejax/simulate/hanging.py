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
import numpy as np
from jaxtyping import Array, Float

_MOST_STEPS = 40
_CONVERGED = 1e-9
"""Largest change of a link's angle [rad] after which Newton's method ends."""
_LARGEST_TURN = 0.3
"""Largest change of a link's angle [rad] in one step of Newton's method."""
_SHARES = 0.5 ** np.arange(6)
"""Of a step that are tried."""
_WAY, _ON_THE_WAY = (0.0, 0.2, 0.4, 0.6, 0.8), 8
"""Shares of the way from one stiffness to another at which the wire is brought to rest, in at most so many steps."""
_MOST_FACTOR = 100.0
"""By which that stiffness may differ."""
_SOLVED = 1e-8
"""What may be left of the conditions, over those of the wire's weight and length; more is no solution."""


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

    Which of several equilibria is found depends on the guess; NaN where none is. Differentiable in the wire and the
    clamps, in both modes.

    Args:
        wire: of M links.
        clamps: x, z and angle of the first and second clamp; the angle is not taken modulo a turn [m, rad].
        guess: angles near the wanted equilibrium [rad]; no derivatives are taken in it.
    """
    guess, given = jax.lax.stop_gradient((guess, (wire, clamps)))
    stiffness, force = _explained_by(guess, *given)
    start = jnp.append(guess, force)

    def solve(residual, unknowns):
        direct = _newton(unknowns, *given, _MOST_STEPS)
        lost = _left(direct, *given) > _SOLVED
        # by way of the stiffness under which the guess is nearest to rest, as it is for a traced wire
        first = jnp.log(stiffness / given[0].stiffness)
        for share in _WAY:
            between = dataclasses.replace(given[0], stiffness=given[0].stiffness * jnp.exp((1 - share) * first))
            unknowns = _newton(unknowns, between, given[1], jnp.where(lost, _ON_THE_WAY, 0))
        return jnp.where(lost, _newton(unknowns, *given, jnp.where(lost, _MOST_STEPS, 0)), direct)

    def tangent_solve(linear, value):
        # The zeros do not depend on the value: many tangents share one factorisation.
        return jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros(value.shape, value.dtype)), value)

    found = jax.lax.custom_root(lambda u: _residual(u, wire, clamps), start, solve, tangent_solve)
    return jnp.where(jax.lax.stop_gradient(_left(found, wire, clamps)) <= _SOLVED, found[:-2], jnp.nan)


def _newton(unknowns: Float[Array, " U"], wire: Wire, clamps: Float[Array, "2 3"], most: Any) -> Float[Array, " U"]:
    """Newton's method, with steps that are halved until less is left; in at most so many of them."""

    def going_on(state):
        _, change, step = state
        return (change > _CONVERGED) & (step < most)

    def newton(state):
        unknowns, _, step = state
        change = jnp.linalg.solve(_jacobian(unknowns, wire), -_residual(unknowns, wire, clamps))
        change = change * jnp.minimum(1.0, _LARGEST_TURN / (jnp.abs(change[:-2]).max() + 1e-300))
        sizes = jax.vmap(lambda share: _left(unknowns + share * change, wire, clamps))(_SHARES)
        # the largest share that lowers it, else the smallest: a step that is worse now may lead on
        lower = sizes < _left(unknowns, wire, clamps)
        share = jnp.asarray(_SHARES)[jnp.where(lower.any(), jnp.argmax(lower), len(_SHARES) - 1)]
        return unknowns + share * change, share * jnp.abs(change[:-2]).max(), step + 1

    return jax.lax.while_loop(going_on, newton, (unknowns, jnp.full((), jnp.inf, unknowns.dtype), 0))[0]


def _explained_by(
    angles: Float[Array, " M"], wire: Wire, clamps: Float[Array, "2 3"]
) -> tuple[Float[Array, " J"], Float[Array, "2"]]:
    """The wire's stiffness times a factor [m^3], and the force at the second clamp over the weight per length [m].

    With these the angles are nearest to rest: moments are linear in both.
    """
    links = angles.shape[0]
    zero = dataclasses.replace(wire, stiffness=jnp.zeros_like(wire.stiffness))
    weight = _residual(jnp.append(angles, jnp.zeros(2)), zero, clamps)[:-2]
    bending = _residual(jnp.append(angles, jnp.zeros(2)), wire, clamps)[:-2] - weight
    lever = wire.length / links * jnp.stack([-jnp.sin(angles), jnp.cos(angles)], axis=-1)
    factor, *force = jnp.linalg.lstsq(jnp.concatenate([bending[:, None], lever], axis=1), -weight)[0]
    return wire.stiffness * jnp.clip(factor, 1 / _MOST_FACTOR, _MOST_FACTOR), jnp.stack(force)


def _left(unknowns: Float[Array, " U"], wire: Wire, clamps: Float[Array, "2 3"]) -> Float[Array, ""]:
    """Norm of the moments over that of the wire's weight at its length, and of what the end misses over the length."""
    residual = _residual(unknowns, wire, clamps)
    return jnp.hypot(jnp.linalg.norm(residual[:-2]) / wire.length**2, jnp.linalg.norm(residual[-2:]) / wire.length)


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
