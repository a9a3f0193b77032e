"""Friction of the table that differs from place to place or falls with the speed, link by link."""

from __future__ import annotations

import mujoco
import numpy as np

from cablejax.simulate.friction import PATCH_EDGE, STRIBECK_SPEED
from cablejax.simulate.plant.config import PlantConfig
from cablejax.simulate.plant.model import FRICTIONLESS


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
