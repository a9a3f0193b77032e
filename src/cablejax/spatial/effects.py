"""Effects of a cable in space, their parameters, and their place in one flat vector.

All effects sit side by side in one vector of physical values that the simulator is compiled for once
(`Explanation.vector`); an effect that takes no part is at its null value there. Names are those of the gap log where
one fits; `quadratic_drag`, air drag with the square of the speed, is not in it. The stiffness against twist is no
effect of its own: it is fitted along with `intrinsic_curvature`, without which it is hardly seen.

Weight is no effect here: a cable that hangs free moves the same whatever its density. Only ratios to it are found. They
are per mass of the cable as it was recorded, markers included (`Layout.laden`): markers all along a cable slow it down
as if it were softer, and motion hardly shows how much of its mass is theirs. So each effect does one thing: the mass of
the markers moves mass along the cable and adds none, and a stiffness profile moves stiffness and leaves the mean of its
logarithm as it is. Otherwise either could take the place of another stiffness of the whole cable.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.cable import GRAVITY
from cablejax.effects.effect import Effect, Parameter
from cablejax.simulate.rod import RodPhysics

PROFILE_KNOTS = CURVATURE_KNOTS = 5
"""Places along the cable between which a profile and a rest curvature are interpolated."""
TWIST_RATIO = 0.7
"""Torsional over bending stiffness of a round cord with Poisson's ratio 0.45."""
GRIP = 0.3
"""Rotation [rad] of a gripper as two markers see it that sit 5 mm off the centreline on different sides, 30 mm apart.

It turns about the cable with the roll, which is not observed, and differs each time that the cable is gripped."""
# Almost inextensible: 1 m of cable that hangs by its end stretches by 0.2 mm.
_STRETCH = 5e4


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialEffect(Effect):
    """An effect of a cable in space.

    Attributes:
        fields: names of what its parameters are, each with their number, in order.
        templates: values of a single parameter from which fits begin; by default from the null value.
        own: whether each recording adds values of its own, with the prior of the common ones, as set-ups differ.
    """

    fields: tuple[tuple[str, int], ...]
    templates: tuple[float, ...] = ()
    own: bool = False

    def starts(self, context):
        """The templates, or the null value."""
        del context
        return [(0, (value,)) for value in self.templates] or [(0, self.null)]


def _linear(name: str, *fields: tuple[str, int, float], own: bool = False) -> SpatialEffect:
    """Values of either sign that are 0 where the effect is absent; each field has its prior standard deviation."""
    parameters = [
        Parameter(f"{field}[{i}]", "", -50 * scale, 50 * scale, 0.0, scale)
        for field, size, scale in fields
        for i in range(size)
    ]
    named = tuple((field, size) for field, size, _ in fields)
    return SpatialEffect(name=name, parameters=tuple(parameters), null=(0.0,) * len(parameters), fields=named, own=own)


def _positive(
    name: str, field: str, median: float, templates: tuple[float, ...], *, null: float = 0.0
) -> SpatialEffect:
    """A positive value whose logarithm has a prior standard deviation of 1."""
    parameter = Parameter(field, "", 1e-6 * median, 1e4 * median, median, 1.0, log=True)
    return SpatialEffect(name=name, parameters=(parameter,), null=(null,), fields=((field, 1),), templates=templates)


def _from_zero(name: str, field: str, scale: float, templates: tuple[float, ...]) -> SpatialEffect:
    """A value that is 0 where the effect is absent and positive where it is not, with its prior standard deviation."""
    parameter = Parameter(field, "", 0.0, 1e3 * scale, 0.0, scale)
    return SpatialEffect(name=name, parameters=(parameter,), null=(0.0,), fields=((field, 1),), templates=templates)


def effects_of(n_markers: int, damping: float = 0.0) -> tuple[SpatialEffect, ...]:
    """All effects of a cable with so many free markers and this nominal damping time [s]."""
    return (
        _positive("bending_stiffness", "ratio", 1.0, (math.exp(-1), 1.0, math.exp(1), math.exp(2)), null=1.0),
        _positive("bending_damping", "damping_time", 0.03, (0.01, 0.03, 0.1), null=damping),
        _from_zero("viscous_drag", "drag", 0.5, (0.2, 0.8)),
        _from_zero("quadratic_drag", "quadratic_drag", 0.2, (0.05, 0.3)),
        _linear("stiffness_profile", ("log_profile", PROFILE_KNOTS, 0.5)),
        _linear("gripper_rotation_offset", ("clamp_rotation", 4, GRIP), own=True),
        _linear("keypoint_bias", ("along", n_markers + 1, 0.005)),
        _from_zero("lumped_mass", "marker_mass", 0.02, (0.01, 0.04)),
        _linear("intrinsic_curvature", ("rest_curvature", 2 * CURVATURE_KNOTS, 1.0), ("log_twist", 1, 1.0)),
    )


def effect_names() -> tuple[str, ...]:
    """Names of all effects that a log in space is searched for."""
    return tuple(effect.name for effect in effects_of(1))


@dataclasses.dataclass(frozen=True)
class Layout:
    """The effects of one cable, and the layout of their values in one vector.

    Attributes:
        effects: in the order of the vector.
        nominal_stiffness: EI / rho believed true [m^4/s^2].
        arclength: of the free markers and of the second clamp, from the first [m], shape [N + 1].
        gravity: [m/s^2].
    """

    effects: tuple[SpatialEffect, ...]
    nominal_stiffness: float
    arclength: tuple[float, ...]
    gravity: tuple[float, ...] = (0.0, 0.0, -GRAVITY)

    @property
    def size(self) -> int:
        """Size of the vector."""
        return len(self.null)

    @property
    def null(self) -> Float[np.ndarray, "P"]:
        """The vector without any effect."""
        return np.concatenate([effect.null for effect in self.effects])

    @property
    def slices(self) -> dict[str, slice]:
        """Place of every field in the vector."""
        fields = [field for effect in self.effects for field in effect.fields]
        ends = np.cumsum([0, *(size for _, size in fields)])
        return {name: slice(int(i), int(j)) for (name, _), i, j in zip(fields, ends[:-1], ends[1:], strict=True)}

    def named(self, name: str) -> SpatialEffect:
        """The effect of a name."""
        return next(effect for effect in self.effects if effect.name == name)

    def slots(self, effect: str) -> slice:
        """Place of an effect's parameters in the vector."""
        fields = [name for name, _ in self.named(effect).fields]
        return slice(self.slices[fields[0]].start, self.slices[fields[-1]].stop)

    def laden(self, values: Float[Array, "P"] | np.ndarray) -> Float[Array, ""]:
        """Mass of the cable with its markers over that of the bare one; differentiable in `values`.

        A marker's mass counts for the cable from halfway to the last to halfway to the next. For modes that do not move
        at the clamps and are long compared with that, the place of the mass does not matter.
        """
        spacing = self.arclength[-1] / len(self.arclength)
        return 1.0 + jnp.asarray(values)[self.slices["marker_mass"].start] / spacing

    def log_stiffness(self, values: Float[Array, "P"] | np.ndarray) -> Float[Array, ""]:
        """Logarithm of EI / rho over the nominal one, mean over the profile's knots; differentiable in `values`."""
        return jnp.log(jnp.asarray(values)[self.slices["ratio"].start])

    def physics(self, values: Float[Array, "P"] | np.ndarray) -> RodPhysics:
        """Parameters of the simulator, which are per mass of the bare cable; differentiable in `values`."""
        part: Mapping[str, Array] = {name: jnp.asarray(values)[where] for name, where in self.slices.items()}
        arclength = jnp.asarray(self.arclength) + part["along"]
        laden = self.laden(values)
        stiffness = self.nominal_stiffness * laden * part["ratio"]
        profile = jnp.exp(part["log_profile"] - part["log_profile"].mean())
        points = len(self.arclength) - 1
        return RodPhysics(
            length=arclength[-1],
            stiffness=stiffness * profile,
            rest_curvature=part["rest_curvature"].reshape(-1, 2),
            damping_time=part["damping_time"][0],
            drag=laden * part["drag"][0],
            quadratic_drag=laden * part["quadratic_drag"][0],
            twist_stiffness=TWIST_RATIO * stiffness[0] * jnp.exp(part["log_twist"][0]),
            stretch=jnp.asarray(_STRETCH),
            marker_mass=part["marker_mass"][0],
            clamp_rotation=part["clamp_rotation"].reshape(2, 2),
            arclength=arclength[:-1],
            offset=jnp.zeros((points, 2)),
            gravity=jnp.array(self.gravity),
        )
