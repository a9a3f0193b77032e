"""The cable's free length: stretched by its tension, or changed by a slip through a gripper."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from cablejax.simulate.chain.step import SLIP_DURATION
from cablejax.simulate.plant.config import PlantConfig


class Extension:
    """Slides between the links carry both: the springs' rest lengths grow with the slip."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, config: PlantConfig):
        self._model, self._data, self._physics, self._cable = model, data, config.physics, config.cable
        self._slides = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE]

    def slipped(self, time: float) -> Float[np.ndarray, "2"]:
        """Free length that has come in through either gripper until then [m]."""
        late = np.clip((time - float(self._physics.slip_time)) / SLIP_DURATION, -50.0, 50.0)
        return np.asarray(self._physics.slip) / (1.0 + np.exp(-late))

    def update(self, time: float) -> None:
        """Sets the springs for a step that ends at this time [s]."""
        self._model.qpos_spring[self._slides] = self.slipped(time).sum() / len(self._slides)

    def stretch(self) -> float:
        """Relative change of the free length."""
        return float(self._data.qpos[self._slides].sum()) / self._cable.length
