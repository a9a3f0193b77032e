"""Laws that MuJoCo does not have, imposed on the plant between its steps.

The cable's free length is stretched by its tension or changed by a slip through a gripper; friction of the table
differs from place to place or falls with the speed; and the cable remembers bends.
"""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.special import expit

from cablejax.arrays import wrapped
from cablejax.simulate.chain.step import SLIP_DURATION, kept_bends
from cablejax.simulate.friction import PATCH_EDGE, STRIBECK_SPEED
from cablejax.simulate.plant.config import PlantConfig
from cablejax.simulate.plant.model import FRICTIONLESS, bending_joints, quaternions


class Extension:
    """The cable's free length. Slides between the links carry stretch and slip: springs' rest lengths grow with it."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, config: PlantConfig):
        self._model, self._data, self._physics, self._cable = model, data, config.physics, config.cable
        self._slides = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE]

    def slipped(self, time: float) -> Float[np.ndarray, "2"]:
        """Free length that has come in through either gripper until then [m]."""
        return np.asarray(self._physics.slip) * expit((time - float(self._physics.slip_time)) / SLIP_DURATION)

    def update(self, time: float) -> None:
        """Sets the springs for a step that ends at this time [s]."""
        self._model.qpos_spring[self._slides] = self.slipped(time).sum() / len(self._slides)

    def stretch(self) -> float:
        """Relative change of the free length."""
        return float(self._data.qpos[self._slides].sum()) / self._cable.length


class TableFriction:
    """The links' friction coefficients, set before every step from where and how fast each link is.

    The law is that of `simulate.chain`; positions and speeds are those at the beginning of the last step.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, links: np.ndarray, config: PlantConfig):
        self._model, self._data, self._physics = model, data, config.physics
        self._links = links
        self._geoms = model.body_geomadr[links]
        self._root = model.body_rootid[links]

    def update(self) -> None:
        """Sets the friction coefficients for the next step."""
        physics, data = self._physics, self._data
        middle = data.geom_xpos[self._geoms]
        distance = np.linalg.norm(middle[:, :2] - physics.patch_centre, axis=1)
        inside = 0.5 * (1.0 + np.tanh(0.5 * (physics.patch_radius - distance) / PATCH_EDGE))
        coefficient = physics.friction + physics.patch_friction * inside
        if physics.static_excess:
            spin, linear = data.cvel[self._links, :3], data.cvel[self._links, 3:]
            velocity = linear + np.cross(spin, middle - data.subtree_com[self._root])
            squared_speed = np.sum(velocity[:, :2] ** 2, axis=1)
            coefficient = coefficient * (1.0 + physics.static_excess * np.exp(-squared_speed / STRIBECK_SPEED**2))
        self._model.geom_friction[self._geoms, 0] = np.maximum(coefficient, FRICTIONLESS)


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
        """Resets to a new cable without plastic bends or internal friction."""
        self._set_curvature = np.zeros(len(self._joints))
        self._friction_state = np.zeros(len(self._joints))
        self._curvature: np.ndarray | None = None
        self._model.qpos_spring[self._position] = quaternions(self._h * np.asarray(self._physics.rest_curvature))
        self._model.jnt_stiffness[self._joints] = np.asarray(self._physics.stiffness) / self._h

    def update(self) -> None:
        """Updates plastic bends from the last step, see `kept_bends`, and sets the springs for the next one."""
        physics = self._physics
        rotation = self._data.qpos[self._position]
        curvature = 2.0 * np.arctan2(rotation[:, 3], rotation[:, 0])
        curvature = wrapped(curvature) / self._h
        change = np.zeros_like(curvature) if self._curvature is None else curvature - self._curvature
        kept = kept_bends(physics, curvature, change, self._set_curvature, self._friction_state)
        self._set_curvature, self._friction_state = kept
        self._curvature = curvature
        elastic = curvature - physics.rest_curvature - self._set_curvature
        moment = physics.stiffness * elastic + physics.hysteresis_moment * self._friction_state
        rest = self._h * (curvature - moment / self._stiffness)
        self._model.qpos_spring[self._position] = quaternions(rest)
        self._model.jnt_stiffness[self._joints] = self._stiffness / self._h
