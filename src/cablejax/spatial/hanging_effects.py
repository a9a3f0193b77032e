"""Effects of a hanging wire: their parameters, and the shape of the wire with them."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.effects.effect import Effect, Parameter
from cablejax.effects.material import BendingStiffness, IntrinsicCurvature, StiffnessProfile
from cablejax.simulate.hanging import Wire, hanging_angles, hanging_points, joint_arclength

PROFILE_SPREAD = 0.3
"""Prior standard deviation of the logarithm of EI along a wire, which is drawn in one piece: a third."""

LEVEL = 0.014
"""Prior standard deviation of the angle between a photograph and the plumb line [rad]: the slope that the line between
the two clamps, which the rig keeps level, has in the published photographs, root mean square."""

CLAMP_ANGLE = math.radians(10.0)
"""Prior standard deviation of a clamp's angle [rad]: a wire leaves a clamp as level as one can hold it."""

_CENTRES = (0.2, 0.5, 0.8)


class _Section(Effect):
    """An effect on a section of the wire, of either sign; its first two parameters are centre and width over length."""

    def starts(self, context):
        last = self.parameters[2]
        return [(0, (centre, 0.3, float(last.value(np.float64(z))))) for centre in _CENTRES for z in (-0.5, 0.5)]


def _effect(kind: type[Effect], name: str, parameters: tuple[Parameter, ...], null: tuple[float, ...]) -> Effect:
    return kind(name=name, parameters=parameters, null=null, amplitude=len(null) - 1, reversible=True)


_PROFILE = (*StiffnessProfile.parameters[:2], dataclasses.replace(StiffnessProfile.parameters[2], scale=PROFILE_SPREAD))

EFFECTS = (
    _effect(Effect, "bending_stiffness", BendingStiffness.parameters, BendingStiffness.null),
    _effect(_Section, "intrinsic_curvature", IntrinsicCurvature.parameters, IntrinsicCurvature.null),
    _effect(_Section, "stiffness_profile", _PROFILE, StiffnessProfile.null),
    _effect(Effect, "gravity_tilt", (Parameter("angle_rad", "rad", -0.5, 0.5, 0.0, LEVEL),), (0.0,)),
)
"""Effects that a hanging wire can show, with the parameters of the planar diagnosis where these exist."""

PARAMETERS = tuple(parameter for effect in EFFECTS for parameter in effect.parameters)
"""Of all effects, one after the other."""


def wire_shape(
    z: Float[Array, " P"],
    clamps: Float[Array, " 2"],
    traced: Float[Array, "N 2"],
    guess: Float[Array, " M"],
    stiffness: Any,
    length: Any,
) -> Float[Array, "N 2"]:
    """Points of the wire at rest [m], between the ends of the traced one, shape [N, 2]. Differentiable in z and clamps.

    Args:
        z: coordinates of the parameters of all effects.
        clamps: how far the wire's direction at each clamp, first to last, is off the horizontal [rad].
        traced: points of the photograph [m].
        guess: angles of the links [rad].
        stiffness: EI over the weight per length that is believed true [m^3].
        length: [m].
    """
    ratio, centre, width, curvature, other_centre, other_width, other_ratio, tilt = (
        parameter.value(z[k]) for k, parameter in enumerate(PARAMETERS)
    )
    links = guess.shape[0]
    s = joint_arclength(links, 1.0)
    profile = other_ratio ** _section(s, other_centre, other_width)
    wire = Wire(
        stiffness=stiffness * ratio * profile,
        rest_curvature=curvature * _section(s, centre, width),
        length=jnp.asarray(length),
    )
    cosine, sine = jnp.cos(tilt), jnp.sin(tilt)
    turned = jnp.stack([jnp.stack([cosine, -sine]), jnp.stack([sine, cosine])])
    ends = traced[jnp.array([0, -1])] @ turned.T
    # The wire's direction turns by the same whole number of turns as the traced one.
    turns = 2 * jnp.pi * jnp.round((guess[jnp.array([0, -1])]) / (2 * jnp.pi))
    placed = jnp.concatenate([ends, (turns + clamps + tilt)[:, None]], axis=1)
    angles = hanging_angles(wire, placed, guess + tilt)
    return hanging_points(angles, placed, wire.length, traced.shape[0]) @ turned


def _section(s: Array, centre: Any, width: Any) -> Array:
    """Share of the wire about each joint in a section, all over the length; edges of a hundredth of it."""
    return jax.nn.sigmoid((s - centre + 0.5 * width) / 0.01) * jax.nn.sigmoid((centre + 0.5 * width - s) / 0.01)
