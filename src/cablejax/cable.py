"""The cable as a physical object, and its discretisation into links.

A `Cable` is the physical object on its table. A `Discretisation` is that cable cut into links for a simulator. The same
two objects go into simulators, data sets, trained weights and logs, so that any two stages can be compared.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

import numpy as np

from cablejax.limits import LIMITS, check, shown

GRAVITY = 9.81
"""Magnitude of gravity [m/s^2]."""


@dataclasses.dataclass(frozen=True)
class Cable:
    """A uniform cable held at both ends, and the table it lies on. The defaults are the reference cable.

    Attributes:
        length: free length between the grippers [m].
        diameter: [m].
        linear_density: mass per length [kg/m].
        bending_stiffness: EI [N m^2].
        damping_time: Kelvin-Voigt time constant tau [s] in `M = EI (kappa - kappa_0 + tau dkappa/dt)`.
        rest_curvature: kappa_0, the curvature without load [1/m].
        friction_coefficient: kinetic Coulomb coefficient of the table; 0 = a smooth table.
        n_keypoints: observed keypoints N, both ends included.
        marks: arc length of each keypoint from gripper 0 [m], N increasing numbers from 0 to `length`; None = uniform.
        grasp: how grippers 0 and 1 hold the cable. Simulators know "clamped": position and direction are held.

    Raises:
        ValueError: a number is outside of its limit, or the marks do not fit.
    """

    length: float = 1.0
    diameter: float = 0.01
    linear_density: float = 0.08
    bending_stiffness: float = 0.02
    damping_time: float = 0.1
    rest_curvature: float = 0.0
    friction_coefficient: float = 0.1
    n_keypoints: int = 13
    marks: tuple[float, ...] | None = None
    grasp: tuple[str, str] = ("clamped", "clamped")

    def __post_init__(self):
        # each of these has a limit of its name
        numbers = (field.name for field in dataclasses.fields(self) if isinstance(field.default, float))
        check(self, *numbers, n_keypoints="keypoints")
        if self.diameter >= self.length:
            raise ValueError(
                f"Cable.diameter is {self.diameter} m and its length {self.length} m: expected a cable that is longer "
                "than it is thick."
            )
        if tuple(self.grasp) != ("clamped", "clamped"):
            grasp = shown(self.grasp)
            raise ValueError(f'Cable.grasp is {grasp}, expected ("clamped", "clamped"), the only grasp simulated.')
        self._check_marks()
        # lists and arrays are taken too, but a cable is hashable
        object.__setattr__(self, "grasp", tuple(self.grasp))
        if self.marks is not None:
            object.__setattr__(self, "marks", tuple(map(float, self.marks)))

    def _check_marks(self) -> None:
        if self.marks is None:
            return
        marks = np.asarray(self.marks, float)
        if marks.shape != (self.n_keypoints,) or not (np.diff(marks) > 0).all():
            raise ValueError(
                f"Cable.marks holds {marks.size} arc lengths, expected {self.n_keypoints}, increasing, one per "
                "keypoint."
            )
        if np.abs(marks[[0, -1]] - [0.0, self.length]).max() > 1e-6 * self.length:
            raise ValueError(
                f"Cable.marks goes from {marks[0]:g} to {marks[-1]:g} m, expected 0 to the cable's length of "
                f"{self.length:g} m: the first and the last keypoint are at the grippers."
            )

    def check_material(self) -> None:
        """Rejects combinations of values that no material has.

        Raises:
            ValueError: names the field, and the density or Young's modulus of a solid rod of this diameter.
        """
        rod = {
            "density": ("linear_density", self.linear_density / (np.pi / 4 * self.diameter**2)),
            "elastic_modulus": ("bending_stiffness", self.bending_stiffness / (np.pi / 64 * self.diameter**4)),
        }
        for limit, (name, value) in rod.items():
            if value not in LIMITS[limit]:
                raise ValueError(
                    f"Cable.{name} is {getattr(self, name):g} {LIMITS[name].unit} at a diameter of {self.diameter:g} "
                    f"m. A solid rod would have {value:.3g} {LIMITS[limit].unit}, expected at most "
                    f"{LIMITS[limit].high:g}, which no material exceeds. Check the units of both."
                )

    @property
    def keypoint_arclength(self) -> np.ndarray:
        """Arc length of each keypoint from gripper 0 [m], shape [N]."""
        if self.marks is not None:
            return np.asarray(self.marks, float)
        return np.linspace(0.0, self.length, self.n_keypoints)


@dataclasses.dataclass(frozen=True)
class Discretisation:
    """A cable cut into rigid links, and the time step of its simulation.

    `n_links` links have `n_links - 1` bending joints between them, spaced `length / (n_links - 1)` apart: the two links
    held by the grippers have half that length, so that clamping them takes no bending length away.

    Attributes:
        cable: what is simulated.
        n_links: number of rigid links, at least 3.
        timestep: integration step [s].
        dimension: 2 for a cable on a table (z-hinges), 3 for a cable in space (ball joints).
        friction_speed: speed v0 [m/s] below which Coulomb friction turns viscous:
            `f = -mu w v / sqrt(|v|^2 + v0^2)`.

    Raises:
        ValueError: a number is out of range; the message names it.
    """

    cable: Cable = Cable()
    n_links: int = 33
    timestep: float = 0.02
    dimension: Literal[2, 3] = 2
    friction_speed: float = 2e-4

    def __post_init__(self):
        # two held links and one free
        check(self, "timestep", "friction_speed", n_links="links")
        if self.dimension not in (2, 3):
            raise ValueError(f"Discretisation.dimension is {self.dimension}, expected 2 (table plane) or 3 (space).")

    @property
    def link_length(self) -> float:
        """Spacing h of the bending joints, and length of every link but the two half-length ones at the ends [m]."""
        return self.cable.length / (self.n_links - 1)

    @property
    def n_joints(self) -> int:
        """Number of bending joints J."""
        return self.n_links - 1

    def dividing(self, interval: float) -> Discretisation:
        """The same with the largest time step, at most its own, of which an interval [s] is a multiple."""
        return dataclasses.replace(self, timestep=interval / math.ceil(interval / self.timestep * (1 - 1e-6)))

    def steps_in(self, interval: float, name: str = "The interval") -> int:
        """Number of time steps in an interval [s]. Raises `ValueError` if it is not a whole number."""
        count = round(interval / self.timestep)
        if count < 1 or abs(count * self.timestep - interval) > 1e-6 * interval:
            raise ValueError(
                f"{name} is {interval} s, expected a multiple of the time step, {self.timestep} s: change one of them."
            )
        return count


def differing(one: Cable, other: Cable) -> dict[str, tuple[Any, Any]]:
    """The fields in which two cables differ by more than rounding, with both values; evenly spaced marks equal None."""
    found = {}
    for field in dataclasses.fields(Cable):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name == "marks":
            here, there = one.keypoint_arclength, other.keypoint_arclength
            same = here.shape != there.shape or np.allclose(here / one.length, there / other.length, rtol=0, atol=1e-9)
        else:
            same = abs(a - b) <= 1e-9 * max(abs(a), abs(b)) if isinstance(a, (int, float)) else a == b
        if not same:
            found[field.name] = (a, b)
    return found
