"""What is fixed about a simulated cable: its geometry, resolution and time step."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np

from cablejax.types import CableParams

GRAVITY = 9.81
"""Magnitude of gravity [m/s^2]."""


@dataclasses.dataclass(frozen=True)
class CableConfig:
    """Static description of a cable and of how finely it is simulated. The defaults are the reference cable.

    A cable of `n_links` links has `n_links - 1` bending joints, spaced `length / (n_links - 1)` apart: the two links
    held by the grippers have half that length, so that clamping them takes no bending length away.

    Attributes:
        length: free length between the grippers [m].
        diameter: [m].
        n_links: number of rigid links, at least 3.
        dimension: 2 for a cable on a table (z-hinges), 3 for a cable in space (ball joints).
        n_keypoints: keypoints observed, uniform in arc length, both ends included.
        timestep: integration step [s].
        friction_speed: speed v0 [m/s] below which Coulomb friction turns viscous:
            `f = -mu w v / sqrt(|v|^2 + v0^2)`.
        bending_stiffness: nominal EI [N m^2].
        damping_time: nominal Kelvin-Voigt time constant [s].
        linear_density: nominal mass per length [kg/m].
        friction_coefficient: nominal Coulomb coefficient; 0 = no table.
    """

    length: float = 1.0
    diameter: float = 0.01
    n_links: int = 33
    dimension: Literal[2, 3] = 2
    n_keypoints: int = 13
    timestep: float = 0.02
    friction_speed: float = 2e-4
    bending_stiffness: float = 0.02
    damping_time: float = 0.1
    linear_density: float = 0.08
    friction_coefficient: float = 0.1

    def __post_init__(self):
        for name in ("length", "diameter", "timestep", "friction_speed", "bending_stiffness", "linear_density"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"CableConfig.{name} is {value}, expected a positive finite number in SI units.")
        for name in ("damping_time", "friction_coefficient"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"CableConfig.{name} is {value}, expected a finite number >= 0.")
        if self.n_links < 3:
            raise ValueError(
                f"CableConfig.n_links is {self.n_links}, expected at least 3: two held links and one free."
            )
        if self.n_keypoints < 2:
            raise ValueError(f"CableConfig.n_keypoints is {self.n_keypoints}, expected at least 2.")
        if self.dimension not in (2, 3):
            raise ValueError(f"CableConfig.dimension is {self.dimension}, expected 2 (table plane) or 3 (space).")
        if self.diameter >= self.link_length:
            raise ValueError(
                f"CableConfig.diameter is {self.diameter} m but a link is only {self.link_length:.4g} m long: "
                "use a thinner cable or fewer links."
            )

    @property
    def link_length(self) -> float:
        """Spacing h of the bending joints, and length of every link but the two half-length ones at the ends [m]."""
        return self.length / (self.n_links - 1)

    @property
    def n_joints(self) -> int:
        """Number of bending joints J."""
        return self.n_links - 1

    @property
    def keypoint_arclength(self) -> np.ndarray:
        """Arc length of each keypoint from gripper 0 [m], shape [N]."""
        return np.linspace(0.0, self.length, self.n_keypoints)

    def params(self, *, stiffness_ratio: float = 1.0) -> CableParams:
        """The nominal parameters as a pytree; `stiffness_ratio` multiplies EI everywhere."""
        joints = (self.n_joints,)
        return CableParams(
            bending_stiffness=jnp.full(joints, self.bending_stiffness * stiffness_ratio),
            damping_time=jnp.asarray(self.damping_time * 1.0),
            rest_curvature=jnp.zeros(joints if self.dimension == 2 else (*joints, 3)),
            linear_density=jnp.asarray(self.linear_density * 1.0),
            friction_coefficient=jnp.asarray(self.friction_coefficient * 1.0),
        )
