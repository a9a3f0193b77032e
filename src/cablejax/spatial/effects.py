"""What the simulator in space can be taught: the effects, their parameters, and their place in one flat vector.

All effects sit side by side in one vector of physical values that the simulator is compiled for once; an effect that is
off is at its null value there. Names are those of the gap log where one fits. Two are not among them: `quadratic_drag`,
air drag with the square of the speed, and `twist_stiffness` does not appear at all: it is a nuisance of
`intrinsic_curvature`, without which it is hardly seen.

Weight is no effect here: a cable that hangs free moves the same whatever its density. Only ratios to it are found. In
the vector they are ratios to the mass of the bare cable, as the simulator needs them. What is told of a cable is per
mass of the cable as it was recorded, markers included (`Layout.laden`): markers all along a cable slow it down as if it
were softer, and motion hardly tells how much of its mass is theirs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.cable import GRAVITY
from cablejax.simulate.rod import RodPhysics

PROFILE_KNOTS = 5
CURVATURE_KNOTS = 5
# Torsional over bending stiffness of a round cord with Poisson's ratio 0.45.
TWIST_RATIO = 0.7
# Two markers that sit 5 mm off the centreline on different sides, 30 mm apart, see a gripper turned by so much [rad].
# It turns about the cable with the roll, which is not seen, and is another one when the cable is gripped anew.
_GRIP = 0.3
# Almost inextensible: 1 m of cable that hangs by its end stretches by 0.2 mm.
_STRETCH = 5e4


@dataclasses.dataclass(frozen=True)
class Block:
    """One effect's part of the parameter vector.

    Attributes:
        effect: name.
        field: what it is, unique.
        size: number of values.
        scale: prior standard deviation of each value, or of its logarithm where `start` is set.
        start: of a positive value, its prior median, which is where derivatives are taken when it is off; None = the
        value
            has either sign and is 0 when off.
        templates: values that are tried before a fit begins.
        spread: prior standard deviation between recordings, for which the value is set up anew; 0 = it stays the same.
    """

    effect: str
    field: str
    size: int
    scale: float
    start: float | None = None
    templates: tuple[float, ...] = ()
    spread: float = 0.0


def blocks(n_markers: int, *, twisting: bool) -> tuple[Block, ...]:
    """All parameters for a cable with so many free markers."""
    result = [
        Block("bending_stiffness", "log_stiffness", 1, 1.0, templates=(-1.0, 1.0, 2.0)),
        Block("bending_damping", "damping_time", 1, 1.0, 0.03, (0.01, 0.03, 0.1)),
        Block("viscous_drag", "drag", 1, 1.0, 0.3, (0.2, 0.8)),
        Block("quadratic_drag", "quadratic_drag", 1, 1.0, 0.05, (0.05, 0.3)),
        Block("stiffness_profile", "log_profile", PROFILE_KNOTS, 0.5),
        Block("gripper_rotation_offset", "clamp_rotation", 4, _GRIP, spread=_GRIP),
        Block("keypoint_bias", "along", n_markers + 1, 0.005),
        Block("lumped_mass", "marker_mass", 1, 1.0, 0.01, (0.01, 0.04)),
    ]
    if twisting:
        result += [
            Block("intrinsic_curvature", "rest_curvature", 2 * CURVATURE_KNOTS, 1.0),
            Block("intrinsic_curvature", "log_twist", 1, 1.0),
        ]
    return tuple(result)


def effect_names() -> tuple[str, ...]:
    """Names of all effects that a log in space is searched for."""
    return tuple(dict.fromkeys(block.effect for block in blocks(1, twisting=True)))


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where each block sits in the vector.

    Attributes:
        blocks: in order.
        nominal_stiffness: EI / rho believed true [m^4/s^2].
        arclength: of the free markers and of the second clamp, from the first [m], shape [N + 1].
        gravity: [m/s^2].
    """

    blocks: tuple[Block, ...]
    nominal_stiffness: float
    arclength: tuple[float, ...]
    gravity: tuple[float, ...] = (0.0, 0.0, -GRAVITY)

    @property
    def size(self) -> int:
        return sum(block.size for block in self.blocks)

    @property
    def slices(self) -> dict[str, slice]:
        ends = np.cumsum([0, *(block.size for block in self.blocks)])
        return {b.field: slice(int(i), int(j)) for b, i, j in zip(self.blocks, ends[:-1], ends[1:], strict=True)}

    @property
    def effects(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(block.effect for block in self.blocks))

    def active(self, effects) -> np.ndarray:
        """Which values belong to one of the effects, shape [P]."""
        return np.concatenate([np.full(block.size, block.effect in effects) for block in self.blocks])

    @property
    def scales(self) -> Float[np.ndarray, "P"]:
        return np.concatenate([np.full(block.size, block.scale) for block in self.blocks])

    @property
    def starts(self) -> Float[np.ndarray, "P"]:
        """Start of positive values, NaN for the others."""
        return np.concatenate([np.full(b.size, np.nan if b.start is None else b.start) for b in self.blocks])

    @property
    def spreads(self) -> Float[np.ndarray, "P"]:
        """Prior standard deviation of each value between recordings."""
        return np.concatenate([np.full(block.size, block.spread) for block in self.blocks])

    def laden(self, values: Float[Array, "P"] | np.ndarray) -> Float[Array, ""]:
        """Mass of the cable with its markers over that of the bare one; differentiable in `values`.

        A marker's mass counts for the cable from halfway to the last to halfway to the next. For modes that do not move
        at the clamps and are long beside that, it is then no other whether it is there or spread evenly.
        """
        spacing = self.arclength[-1] / len(self.arclength)
        return 1.0 + jnp.asarray(values)[self.slices["marker_mass"].start] / spacing

    def log_stiffness(self, values: Float[Array, "P"] | np.ndarray) -> Float[Array, ""]:
        """Logarithm of EI / rho over the nominal one, mean along the cable, rho with the markers; differentiable."""
        where, values = self.slices, jnp.asarray(values)
        bare = values[where["log_stiffness"]].sum() + values[where["log_profile"]].mean()
        return bare - jnp.log(self.laden(values))

    def templates(self, effect: str) -> list[tuple[slice, float]]:
        """Places and values to try for an effect of one number; none for others."""
        where = self.slices
        return [(where[block.field], v) for block in self.blocks if block.effect == effect for v in block.templates]

    def physics(self, values: Float[Array, "P"] | np.ndarray) -> RodPhysics:
        """What the simulator needs; differentiable in `values`."""
        part: Mapping[str, Array] = {name: jnp.asarray(values)[where] for name, where in self.slices.items()}
        arclength = jnp.asarray(self.arclength) + part["along"]
        stiffness = self.nominal_stiffness * jnp.exp(part["log_stiffness"] + part["log_profile"])
        curved = "rest_curvature" in part
        twist = jnp.exp(part["log_twist"][0]) if curved else 1.0
        points = len(self.arclength) - 1
        return RodPhysics(
            length=arclength[-1],
            stiffness=stiffness,
            rest_curvature=part["rest_curvature"].reshape(-1, 2) if curved else jnp.zeros((1, 2)),
            damping_time=part["damping_time"][0],
            drag=part["drag"][0],
            quadratic_drag=part["quadratic_drag"][0],
            twist_stiffness=TWIST_RATIO * self.nominal_stiffness * jnp.exp(part["log_stiffness"][0]) * twist,
            stretch=jnp.asarray(_STRETCH),
            marker_mass=part["marker_mass"][0],
            clamp_rotation=part["clamp_rotation"].reshape(2, 2),
            clamp_offset=jnp.zeros((2, 3)),
            roll=jnp.zeros(()),
            arclength=arclength[:-1],
            offset=jnp.zeros((points, 2)),
            gravity=jnp.array(self.gravity),
        )
