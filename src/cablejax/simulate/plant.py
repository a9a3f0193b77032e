"""The plant: a cable that stands for reality, with contact and friction that the trained simulator does not have.

C MuJoCo, in space: a chain of capsules on ball joints lies on a table under gravity and touches it by capsule-plane
contacts with elliptic friction cones. The planar simulator that yields training data has another resolution, another
time step, hinges instead of ball joints and a regularised friction law without contacts.

Two choices make it usable. MuJoCo's "discrete" integrator solves the constraints in the effective metric
`M + dt D + dt^2 K` and so takes steps of 2-5 ms where the others blow up below 1 ms. And the grasp is a weld without
damping whose stiffness is far above `m / dt^2`: under that integrator the held link is at the mocap body's pose at
the end of every single step, so the grippers neither lag nor yield.
"""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float

from cablejax.cable import GRAVITY, Cable, Discretisation
from cablejax.simulate.composite import link_bodies, link_lengths, node_offsets
from cablejax.simulate.elastica import solve_elastica
from cablejax.simulate.table_plant import Observation, TablePlant, check_camera

GRASP_STIFFNESS = 100.0
"""Stiffness of the grasp in units of `1 / dt^2`: a held link trails a jump of the command's speed by dv dt / 100."""
HELD_MASS, HELD_RADIUS = 10.0, 0.1
"""Sphere [kg, m] at each held link: a gripper is heavy, and the heavier the link the stiffer MuJoCo's grasp."""
CONTACT_IMPEDANCE = "0.3 0.99 0.0003"
"""MuJoCo's impedance of the table's contacts: at first touch, at depth, and the depth [m]. Contacts that are stiff from
the first touch on chatter: the mean normal force then is up to three times the weight, and so is friction."""
FRICTIONLESS = 1e-5
"""MuJoCo's smallest friction coefficient."""


@dataclasses.dataclass(frozen=True)
class PlantConfig:
    """What the plant is made of; the defaults are the reference cable, finer than the trained one.

    Attributes:
        discretisation: the cable, its links and time step. `friction_speed` has no meaning here and
            `dimension` must be 3.
        stiffness_ratio: the plant's EI over the nominal one, a factor on `cable.bending_stiffness`.
        cone_ratio: MuJoCo's `impratio`: how much harder the friction cone's tangent is than its normal direction; it
            sets how slowly a cable at rest creeps.
        contact_time: time constant of the table's contacts [s].
        keypoint_noise: standard deviation of the observed keypoints [m] per coordinate, the held ends included.
        keypoint_dropout: probability with which a keypoint is not observed (NaN), except the first and last, which the
            grippers hold.
        settle_time: simulated time [s] given to a new cable to settle: without friction, with it, and once more after
            the grippers have come down to the height at which it lies.
        seed: of noise and gaps.
    """

    discretisation: Discretisation = Discretisation(n_links=40, dimension=3, timestep=0.005)
    stiffness_ratio: float = 1.0
    cone_ratio: float = 100.0
    contact_time: float = 0.01
    keypoint_noise: float = 0.0
    keypoint_dropout: float = 0.0
    settle_time: float = 0.5
    seed: int = 0

    @property
    def cable(self) -> Cable:
        """What is simulated."""
        return self.discretisation.cable

    def __post_init__(self):
        if self.discretisation.dimension != 3:
            raise ValueError(
                f"PlantConfig.discretisation.dimension is {self.discretisation.dimension}, expected 3, the plant's."
            )
        for name in ("stiffness_ratio", "cone_ratio", "contact_time", "settle_time"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"PlantConfig.{name} is {value}, expected a positive finite number.")
        check_camera(self)


def plant_model(config: PlantConfig) -> mujoco.MjModel:
    """The MuJoCo model of the plant: table, composite cable, and one mocap body welded to each held link."""
    cable = config.cable
    h, dt = config.discretisation.link_length, config.discretisation.timestep
    stiffness = config.stiffness_ratio * cable.bending_stiffness / h
    vertices = np.concatenate([[0.0], np.cumsum(link_lengths(config.discretisation))])
    spec = mujoco.MjSpec.from_string(f"""
        <mujoco>
          <option timestep="{dt}" integrator="discrete" cone="elliptic" impratio="{config.cone_ratio}"
                  gravity="0 0 {-GRAVITY}" tolerance="1e-8"/>
          <worldbody>
            <geom name="table" type="plane" size="5 5 0.1" contype="1" conaffinity="0" condim="3" priority="1"
                  solref="{config.contact_time} 1" solimp="{CONTACT_IMPEDANCE}"/>
            <composite type="cable" prefix="cable" initial="free" vertex="{" ".join(f"{s:.9g} 0 0" for s in vertices)}">
              <joint kind="main" stiffness="{stiffness}" damping="{stiffness * cable.damping_time}"/>
              <geom type="capsule" size="{cable.diameter / 2}" contype="0" conaffinity="1"/>
            </composite>
          </worldbody>
        </mujoco>""")
    links = link_bodies(spec)
    for link, length in zip(links, link_lengths(config.discretisation), strict=True):
        link.geoms[0].mass = cable.linear_density * length
    for gripper, (link, offset) in enumerate(((links[0], 0.0), (links[-1], h / 2))):
        link.geoms[0].conaffinity = 0  # the gripper carries its link: it neither rubs on the table nor weighs on it
        link.gravcomp = 1.0
        link.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[HELD_RADIUS, 0, 0], pos=[offset, 0, 0], mass=HELD_MASS,
            contype=0, conaffinity=0,
        )  # fmt: skip
        mocap = spec.worldbody.add_body(name=f"gripper_{gripper}", mocap=True)
        weld = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1=mocap.name, name2=link.name,
            solref=[-GRASP_STIFFNESS / dt**2, 0.0], solimp=[0.9999, 0.9999, 0.001, 0.5, 2.0],
        )  # fmt: skip
        data = np.zeros(12)
        data[6], data[10] = 1.0, 1.0  # identity quaternion between mocap and link, unit weight of the rotation
        weld.data = data
    model = spec.compile()
    model.geom("table").friction[0] = max(cable.friction_coefficient, FRICTIONLESS)
    return model


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
        data.qpos[3:] = _quaternions(np.diff(angles, prepend=0.0)).ravel()
        self._height = cable.diameter / 2
        self._restart(pose)
        still, settle = np.zeros((2, 3)), self._steps(self.config.settle_time)
        friction = self.model.geom("table").friction
        friction[0] = FRICTIONLESS
        self._advance(still, settle)
        friction[0] = max(cable.friction_coefficient, FRICTIONLESS)
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

    def _place_grippers(self, pose: np.ndarray) -> None:
        """Mocap bodies coincide with the frames of the held links, whose origins are their starts."""
        data = self._data
        heading = np.array([np.cos(pose[1, 2]), np.sin(pose[1, 2])])
        data.mocap_pos[:, :2] = pose[:, :2]
        data.mocap_pos[1, :2] -= 0.5 * self.config.discretisation.link_length * heading
        data.mocap_pos[:, 2] = self._height
        data.mocap_quat[:] = _quaternions(pose[:, 2])


def _quaternions(angles: np.ndarray) -> np.ndarray:
    """Rotations about z as (w, x, y, z), shape [..., 4]."""
    zero = np.zeros_like(angles)
    return np.stack([np.cos(angles / 2), zero, zero, np.sin(angles / 2)], axis=-1)
