"""Physical parameters of a cable in space."""

from __future__ import annotations

import dataclasses

import jax
from jaxtyping import Array, Float


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RodPhysics:
    """Everything that moves a cable in space, or how it is seen, apart from the grippers' motion.

    Attributes:
        length: between the two clamps [m], shape [].
        stiffness: EI / rho along the cable, at J evenly spaced places from clamp to clamp [m^4/s^2], shape [J].
        rest_curvature: along the cable, about the second and third axis of the material [1/m], shape [K, 2].
        damping_time: Kelvin-Voigt time constant of bending [s].
        drag: force per mass and speed [1/s].
        quadratic_drag: force per mass and squared speed [1/m].
        twist_stiffness: GJ / rho [m^4/s^2].
        stretch: EA / rho [m^2/s^2].
        marker_mass: of each marker, as length of cable of the same mass [m].
        clamp_rotation: slope of the cable against either gripper, the tangent of its angle about its second and third
            axis, shape [2, 2].
        arclength: of every free marker from the first clamp [m], shape [N].
        offset: of every free marker from the centreline along the second and third axis [m], shape [N, 2].
        gravity: [m/s^2], shape [3].
    """

    length: Float[Array, ""]
    stiffness: Float[Array, "J"]
    rest_curvature: Float[Array, "K 2"]
    damping_time: Float[Array, ""]
    drag: Float[Array, ""]
    quadratic_drag: Float[Array, ""]
    twist_stiffness: Float[Array, ""]
    stretch: Float[Array, ""]
    marker_mass: Float[Array, ""]
    clamp_rotation: Float[Array, "2 2"]
    arclength: Float[Array, "N"]
    offset: Float[Array, "N 2"]
    gravity: Float[Array, "3"]
