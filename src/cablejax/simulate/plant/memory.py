"""Bends that the cable remembers: plasticity and internal friction, one state per joint, updated before every step."""

from __future__ import annotations

import mujoco
import numpy as np

from cablejax.simulate.plant.config import PlantConfig
from cablejax.simulate.plant.model import bending_joints, quaternions
from cablejax.simulate.pose import wrapped


class Memory:
    """Plastic bends and internal friction about the table's normal.

    Both act through MuJoCo's own joint springs, which its integrator takes implicitly: torques of the same size,
    applied from outside, are unstable at 5 ms because links are light. The spring is as stiff as cable and internal
    friction together, and its rest angle is such that its moment at the beginning of the step is the sum of both.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, config: PlantConfig):
        physics, joints = config.physics, bending_joints(model)
        self._model, self._data, self._physics = model, data, physics
        self._h = config.discretisation.link_length
        self._joints = joints
        self._position = model.jnt_qposadr[joints][:, None] + np.arange(4)
        slope = np.asarray(physics.hysteresis_moment) / physics.hysteresis_curvature
        self._stiffness = np.asarray(physics.stiffness) + slope
        self.reset()

    def reset(self) -> None:
        """A new cable: no set, no internal friction, and none to come until `update` is called."""
        self._set_curvature = np.zeros(len(self._joints))
        self._friction_state = np.zeros(len(self._joints))
        self._curvature: np.ndarray | None = None
        self._model.qpos_spring[self._position] = quaternions(self._h * np.asarray(self._physics.rest_curvature))
        self._model.jnt_stiffness[self._joints] = np.asarray(self._physics.stiffness) / self._h

    def update(self) -> None:
        """Takes note of the last step's bending, and sets the springs for the next one.

        Dahl's law (Dahl 1968) is exact for a constant direction; plasticity is the return mapping with linear
        kinematic hardening (Simo and Hughes 1998, 1.5).
        """
        physics = self._physics
        rotation = self._data.qpos[self._position]
        curvature = 2.0 * np.arctan2(rotation[:, 3], rotation[:, 0])
        curvature = wrapped(curvature) / self._h
        if self._curvature is not None:
            change = curvature - self._curvature
            sign = np.where(change < 0, -1.0, 1.0)
            worn = np.exp(-np.abs(change) / physics.hysteresis_curvature)
            self._friction_state = sign + (self._friction_state - sign) * worn
        self._curvature = curvature
        hardened = 1.0 + float(physics.hardening)
        driven = curvature - physics.rest_curvature - hardened * self._set_curvature
        beyond = driven - np.clip(driven, -physics.yield_curvature, physics.yield_curvature)
        self._set_curvature += beyond / hardened
        elastic = curvature - physics.rest_curvature - self._set_curvature
        moment = physics.stiffness * elastic + physics.hysteresis_moment * self._friction_state
        rest = self._h * (curvature - moment / self._stiffness)
        self._model.qpos_spring[self._position] = quaternions(rest)
        self._model.jnt_stiffness[self._joints] = self._stiffness / self._h
