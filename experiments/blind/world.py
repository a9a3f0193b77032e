"""The true cable, table, arms and camera of one recorded log.

The values without effect are those a log states; every effect, named or unknown, sets a few fields. A family of
simulators reads the fields it has a law for and refuses the others.
"""

from __future__ import annotations

import dataclasses
import math

GRAVITY = 9.81
"""[m/s^2]"""


@dataclasses.dataclass(frozen=True)
class World:
    """One cable on one table, as it is.

    Attributes:
        length, linear_density, stiffness, damping_time, friction: [m], [kg/m], EI [N m^2], tau [s], kinetic mu.
        diameter: [m].
        stiffness_patch: (centre [m], full width [m], EI ratio, edge) with the edge 0 = Gaussian bump, 1 = tanh steps.
        curvature_patch: (centre [m], full width [m], rest curvature [1/m], edge).
        yield_curvature: elastic curvature beyond which the cable flows [1/m].
        hardening: back stress per plastic curvature, over EI.
        returned, return_time: share of a plastic bend that comes back, and how soon [s].
        hysteresis_moment, hysteresis_transition: Bouc-Wen moment [N m] and the curvature in which it builds up [1/m].
        axial_stiffness: EA [N].
        static_excess, stribeck_speed: (mu_s - mu_k) / mu_k and the speed that takes it away [m/s].
        friction_patch: (x, y, radius [m], mu).
        drag: [N s/m^2].
        tilt, tilt_direction: angle of the table and direction of the downhill pull [rad].
        lump: (centre [m], mass [kg]).
        slip: (gripper, time [s], change of the free length [m]).
        grasp_offset: error of the grasp angle of each gripper [rad].
        grasp_stiffness: rotational stiffness of each grasp [N m/rad].
        obstacle: (x, y, radius to the centreline [m]).
        magnet: (x, y, strength [N/m], reach [m]): pulls every point of the cable towards a place under the table.
        drift: relative change of EI that an episode approaches within `drift_time` [s].
        anisotropy: mu along y over mu along x, less one.
        tether: (centre [m], x, y, stiffness [N/m], slack [m]): a spring from the cable to a point of the table.
        shake: (amplitude [m], frequency [Hz], direction [rad]) of the table under the cable.
        creep: stiffness of a Maxwell branch over EI.
        lubrication: speed at which the friction has doubled, quadratic in the speed [m/s].
        signed_stiffness: relative difference of EI between left and right bends.
    """

    length: float = 1.0
    linear_density: float = 0.08
    stiffness: float = 0.02
    damping_time: float = 0.1
    friction: float = 0.1
    diameter: float = 0.01
    stiffness_patch: tuple[float, float, float, int] | None = None
    curvature_patch: tuple[float, float, float, int] | None = None
    yield_curvature: float = math.inf
    hardening: float = 0.15
    returned: float = 0.2
    return_time: float = 8.0
    hysteresis_moment: float = 0.0
    hysteresis_transition: float = 1.0
    axial_stiffness: float = 3e4
    static_excess: float = 0.0
    stribeck_speed: float = 0.005
    friction_patch: tuple[float, float, float, float] | None = None
    drag: float = 0.0
    tilt: float = 0.0
    tilt_direction: float = 0.0
    lump: tuple[float, float] | None = None
    slip: tuple[int, float, float] | None = None
    grasp_offset: tuple[float, float] = (0.0, 0.0)
    grasp_stiffness: tuple[float, float] = (math.inf, math.inf)
    obstacle: tuple[float, float, float] | None = None
    magnet: tuple[float, float, float, float] | None = None
    drift: float = 0.0
    drift_time: float = 12.0
    anisotropy: float = 0.0
    tether: tuple[float, float, float, float, float] | None = None
    shake: tuple[float, float, float] | None = None
    creep: float = 0.0
    creep_time: float = 5.0
    lubrication: float = math.inf
    signed_stiffness: float = 0.0

    def unlike_nominal(self) -> set[str]:
        """Names of the fields beyond the cable and its table that differ from their defaults."""
        plain = {"length", "linear_density", "stiffness", "damping_time", "friction", "diameter"}
        return {f.name for f in dataclasses.fields(self) if f.name not in plain and getattr(self, f.name) != f.default}


def bump(s, centre: float, width: float, edge: int):
    """A section of full width `width` with soft edges: the integral over s is the width, 1 inside, 0 outside."""
    import numpy as np

    s = np.asarray(s, float)
    if edge == 0:
        return np.exp(-math.pi * ((s - centre) / width) ** 2)
    soft = width / 8
    return 0.5 * (np.tanh((s - centre + width / 2) / soft) - np.tanh((s - centre - width / 2) / soft))
