"""The cable in C MuJoCo between two grippers, on its table, with the calls of every plant."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from cablejax.simulate.composite import node_offsets
from cablejax.simulate.elastica import solve_elastica
from cablejax.simulate.plant.config import PlantConfig
from cablejax.simulate.plant.model import FRICTIONLESS, plant_model, quaternions
from cablejax.simulate.table_plant import Observation, TablePlant


class Plant(TablePlant):
    """The cable in C MuJoCo, with the calls of every `TablePlant`."""

    config: PlantConfig

    def __init__(self, config: PlantConfig | None = None):
        super().__init__(PlantConfig() if config is None else config)
        self.model = plant_model(self.config)
        self._data = mujoco.MjData(self.model)
        names = (self.model.body(i).name for i in range(self.model.nbody))
        self._links = np.array([i for i, name in enumerate(names) if name.startswith("cable")])
        self._offsets = node_offsets(self.config.discretisation)[:, None]
        self._height = np.nan

    def reset(
        self, gripper_pose: Float[np.ndarray, "Q 3"], *, guess: Float[np.ndarray, "S 2"] | None = None
    ) -> Observation:
        """See `TablePlant.reset`."""
        pose = self._checked_start(gripper_pose)
        cable, data = self.config.cable, self._data
        # A chain's links follow the elastica's chords; only the held ones have the exact direction of the grippers.
        shape = solve_elastica(pose, cable.length, guess=guess, n_samples=2 * self.config.discretisation.n_joints + 1)
        vertices = np.concatenate([shape.position[:1], shape.position[1:-1:2], shape.position[-1:]])
        chords = np.diff(vertices, axis=0)
        angles = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
        angles[[0, -1]] = pose[:, 2]
        mujoco.mj_resetData(self.model, data)
        data.qpos[:2], data.qpos[2] = pose[0, :2], cable.diameter / 2
        data.qpos[3:] = quaternions(np.diff(angles, prepend=0.0)).ravel()
        self._height = cable.diameter / 2
        self._restart(pose)
        still, settle = np.zeros((2, 3)), self._steps(self.config.settle_time)
        self._set_friction(0.0)
        self._advance(still, settle)
        self._set_friction(float(self.config.physics.friction))
        self._advance(still, settle)
        # Contacts yield a little. Held at the height at which the rest lies, the ends lift no weight off the table.
        self._height = float(np.median(self.nodes()[0][1:-1, 2]))
        self._advance(still, settle)
        self._steps_done = 0
        return self.observe()

    def nodes(self) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Middle of every link, for the two held links the grasped end [m], and the links' unit directions."""
        data = self._data
        directions = data.xmat[self._links].reshape(-1, 3, 3)[:, :, 0]
        return data.xpos[self._links] + self._offsets * directions, directions.copy()

    def _advance(self, twist: np.ndarray, steps: int) -> None:
        """`steps` time steps under one twist; the mocap bodies lead to the pose at the end of each."""
        model, data, dt = self.model, self._data, self.config.discretisation.timestep
        start = self._pose
        for step in range(1, steps + 1):
            self._place_grippers(start + (step * dt) * twist)
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        unstable = data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or not np.isfinite(data.qpos).all()
        self._moved(twist, steps, stable=not unstable)

    def _set_friction(self, coefficient: float) -> None:
        """Of all links: they have priority over the table they touch."""
        self.model.geom_friction[:, 0] = max(coefficient, FRICTIONLESS)

    def _place_grippers(self, pose: np.ndarray) -> None:
        """Mocap bodies coincide with the frames of the held links, whose origins are their starts."""
        data = self._data
        heading = np.array([np.cos(pose[1, 2]), np.sin(pose[1, 2])])
        data.mocap_pos[:, :2] = pose[:, :2]
        data.mocap_pos[1, :2] -= 0.5 * self.config.discretisation.link_length * heading
        data.mocap_pos[:, 2] = self._height
        data.mocap_quat[:] = quaternions(pose[:, 2])
