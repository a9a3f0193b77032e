"""The cable in C MuJoCo between two grippers, on its table, with the calls of every plant."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float

from cablejax.effects.given import GivenEffect
from cablejax.effects.physics import NEVER
from cablejax.simulate.composite import link_bodies, node_offsets
from cablejax.simulate.elastica import solve_elastica
from cablejax.simulate.plant.between_steps import Extension, Memory, TableFriction
from cablejax.simulate.plant.config import PlantConfig
from cablejax.simulate.plant.model import FRICTIONLESS, bending_joints, extensible, plant_model, quaternions
from cablejax.simulate.table_plant import Observation, TablePlant

RESTING = 2e-4
"""Motion within `settle_time` below which a cable has settled [m]."""
LONGEST_SETTLING = 20
"""How often `settle_time` passes before a cable that keeps moving counts as settled."""


class Plant(TablePlant):
    """The cable in C MuJoCo, with the calls of every `TablePlant`."""

    config: PlantConfig
    """Cable, discretisation, effects and noise."""

    def __init__(self, config: PlantConfig | None = None):
        super().__init__(PlantConfig() if config is None else config)
        self._height, self._acting = np.nan, False
        self._assume(self.config.acting(0.0))

    def _assume(self, effects: tuple[GivenEffect, ...]) -> None:
        """Takes on the physics with these lasting effects, in MuJoCo's initial state."""
        self._effects, config = effects, dataclasses.replace(self.config, effects=effects)
        self._take_on(config.physics)
        self.model = plant_model(config)
        self._data = mujoco.MjData(self.model)
        self._links = link_bodies(self.model)
        self._offsets = node_offsets(self.config.discretisation)[:, None]
        self._balls = self.model.jnt_qposadr[bending_joints(self.model)][:, None] + np.arange(4)
        # The mocap bodies coincide with the frames of what they hold: the last link begins before the grasped end.
        physics, h = self._physics, config.discretisation.link_length
        self._inset = 0.0 if physics.rotation_compliance[1] > 0 else 0.5 * h
        remembers = physics.hysteresis_moment > 0 or physics.yield_curvature < NEVER
        uneven = physics.patch_friction or physics.static_excess
        self._memory = Memory(self.model, self._data, config) if remembers else None
        self._friction = TableFriction(self.model, self._data, self._links, config) if uneven else None
        self._extension = Extension(self.model, self._data, config) if extensible(physics) else None

    def _change(self, time: float) -> None:
        """Begins and ends effects that are due at this time [s], at the cable's present state."""
        due = self.config.acting(time)
        if due == self._effects:
            return
        before = self._data
        self._assume(due)
        for name in ("time", "qpos", "qvel", "qacc_warmstart", "mocap_pos", "mocap_quat"):
            setattr(self._data, name, getattr(before, name))
        self._set_friction(float(self._physics.friction))
        mujoco.mj_forward(self.model, self._data)

    def reset(
        self, gripper_pose: Float[np.ndarray, "Q 3"], *, guess: Float[np.ndarray, "S 2"] | None = None
    ) -> Observation:
        """See `TablePlant.reset`."""
        pose = self._checked_start(gripper_pose)
        if self._effects != self.config.acting(0.0):
            self._assume(self.config.acting(0.0))
        cable, data, physics = self.config.cable, self._data, self._physics
        held = pose + np.array([[0.0, 0.0, offset] for offset in physics.rotation_offset])
        # A chain's links follow the elastica's chords; only the held ones have the exact direction in the grippers, to
        # which the others then settle: a cable that is gripped askew may snap over, with no shape near it at rest.
        shape = solve_elastica(pose, cable.length, guess=guess, n_samples=2 * self.config.discretisation.n_joints + 1)
        vertices = np.concatenate([shape.position[:1], shape.position[1:-1:2], shape.position[-1:]])
        chords = np.diff(vertices, axis=0)
        angles = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
        angles[[0, -1]] = held[:, 2]
        mujoco.mj_resetData(self.model, data)
        data.qpos[:2], data.qpos[2] = pose[0, :2], cable.diameter / 2
        turns = quaternions(np.diff(angles, prepend=0.0))
        data.qpos[3:7], data.qpos[self._balls] = turns[0], turns[1:]
        self._height = cable.diameter / 2
        self._restart(pose)
        self._forget()
        still, settle = np.zeros((2, 3)), self.config.discretisation.steps_in(self.config.settle_time, "settle_time")
        self._set_friction(0.0)
        self._settle(still, settle)
        self._set_friction(float(physics.friction))
        self._advance(still, settle)
        # Contacts yield a little. Held at the height at which the rest lies, the ends lift no weight off the table.
        self._height = float(np.median(self.nodes()[0][1:-1, 2]))
        self._advance(still, settle)
        self._steps_done = 0
        self._acting = True
        return self.observe()

    def _settle(self, still: np.ndarray, steps: int) -> None:
        """To rest, without friction. Effects may bend the cable into another shape, which takes longer."""
        for _ in range(LONGEST_SETTLING if self._effects else 1):
            before = self.nodes()[0]
            self._advance(still, steps)
            if np.abs(self.nodes()[0] - before).max() < RESTING:
                break

    def _forget(self) -> None:
        """Clears the state of the last cable: set bends, slipped length. None of these acts until the new one rests."""
        self._acting = False
        if self._memory is not None:
            self._memory.reset()
        if self._extension is not None:
            self._extension.update(-np.inf)

    def _act(self, time: float) -> None:
        """Effects that change with time, place, speed or bending, for the step that ends at `time`."""
        if self._memory is not None:
            self._memory.update()
        if self._friction is not None:
            self._friction.update()
        if self._extension is not None:
            self._extension.update(time)

    def _slipped(self) -> Float[np.ndarray, "2"] | None:
        if self._extension is None:
            return None
        return self._extension.slipped(self.time if self._acting else -np.inf)

    def _free_length(self, time: float) -> float:
        slipped = 0.0 if self._extension is None else float(self._extension.slipped(time).sum())
        return self.config.cable.length + slipped

    def _stretch(self) -> float:
        return 0.0 if self._extension is None else self._extension.stretch()

    def nodes(self) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Middle of every link, for the two held links the grasped end [m], and the links' unit directions."""
        data = self._data
        directions = data.xmat[self._links].reshape(-1, 3, 3)[:, :, 0]
        return data.xpos[self._links] + self._offsets * directions, directions.copy()

    def _advance(self, twist: np.ndarray, steps: int) -> None:
        """`steps` time steps under one twist; the mocap bodies lead to the pose at the end of each."""
        start, time, dt = self._pose, self.time, self.config.discretisation.timestep
        lasting = all(effect.lasting for effect in self.config.effects)
        for step in range(1, steps + 1):
            if self._acting and (step == 1 or not lasting):
                self._change(time + (step - 1) * dt)
            self._place_grippers(start + (step * dt) * twist)
            if self._acting:
                self._act(time + step * dt)
            mujoco.mj_step(self.model, self._data)
        data = self._data
        mujoco.mj_kinematics(self.model, data)
        unstable = data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or not np.isfinite(data.qpos).all()
        self._moved(twist, steps, stable=not unstable)

    def _set_friction(self, coefficient: float) -> None:
        """Of all links: they have priority over the table that they touch."""
        self.model.geom_friction[self.model.body_geomadr[self._links], 0] = max(coefficient, FRICTIONLESS)

    def _place_grippers(self, pose: np.ndarray) -> None:
        """Mocap bodies at the frames of what they hold: position of the grippers, angle of the grasps."""
        data = self._data
        angles = pose[:, 2] + self._physics.rotation_offset
        heading = np.array([np.cos(angles[1]), np.sin(angles[1])])
        data.mocap_pos[:, :2] = pose[:, :2]
        data.mocap_pos[1, :2] -= self._inset * heading
        data.mocap_pos[:, 2] = self._height
        data.mocap_quat[:] = quaternions(angles)
