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

import mujoco
import numpy as np
from jaxtyping import Float

from cablejax.effects.physics import Physics
from cablejax.simulate.composite import link_bodies, link_lengths
from cablejax.simulate.plant.config import PlantConfig

GRASP_STIFFNESS = 100.0
"""Stiffness of the grasp in units of `1 / dt^2`: a held link trails a jump of the command's speed by dv dt / 100."""
HELD_MASS, HELD_RADIUS = 10.0, 0.1
"""Sphere [kg, m] at each held link: a gripper is heavy, and the heavier the link the stiffer MuJoCo's grasp."""
CONTACT_IMPEDANCE = "0.3 0.99 0.0003"
"""MuJoCo's impedance of the table's contacts: at first touch, at depth, and the depth [m]. Contacts that are stiff from
the first touch on chatter: the mean normal force then is up to three times the weight, and so is friction."""
FRICTIONLESS = 1e-5
"""MuJoCo's smallest friction coefficient."""


def plant_model(config: PlantConfig) -> mujoco.MjModel:
    """The MuJoCo model of the plant: table, composite cable, and one mocap body welded to each held link."""
    cable, physics = config.cable, config.physics
    h, dt = config.discretisation.link_length, config.discretisation.timestep
    lengths = link_lengths(config.discretisation)
    vertices = np.concatenate([[0.0], np.cumsum(lengths)])
    stiffness = cable.bending_stiffness / h
    gravity = " ".join(map(str, gravity_of(physics)))
    spec = mujoco.MjSpec.from_string(f"""
        <mujoco>
          <option timestep="{dt}" integrator="discrete" cone="elliptic" impratio="{config.cone_ratio}"
                  gravity="{gravity}" tolerance="1e-8"/>
          <worldbody>
            <geom name="table" type="plane" size="5 5 0.1" contype="1" conaffinity="0" condim="3"/>
            <composite type="cable" prefix="cable" initial="free" vertex="{" ".join(f"{s:.9g} 0 0" for s in vertices)}">
              <joint kind="main" stiffness="{stiffness}" damping="{stiffness * cable.damping_time}"/>
              <geom type="capsule" size="{cable.diameter / 2}" contype="0" conaffinity="1" condim="3" priority="1"
                    solref="{config.contact_time} 1" solimp="{CONTACT_IMPEDANCE}"/>
            </composite>
          </worldbody>
        </mujoco>""")
    links = link_bodies(spec)
    for link, mass in zip(links, np.asarray(physics.density) * lengths + physics.extra_mass, strict=True):
        link.geoms[0].mass = mass
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
    _set_bending(model, config)
    return model


def bending_joints(model: mujoco.MjModel) -> np.ndarray:
    """Indices of the ball joints, in order of arc length, shape [J]."""
    return np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_BALL)


def _set_bending(model: mujoco.MjModel, config: PlantConfig) -> None:
    """Stiffness, damping and rest shape of every joint. Rest curvature is about the table's normal."""
    physics, h = config.physics, config.discretisation.link_length
    stiffness = np.asarray(physics.stiffness) / h
    rest = quaternions(h * np.asarray(physics.rest_curvature))
    for joint, own, shape in zip(bending_joints(model), stiffness, rest, strict=True):
        first, position = model.jnt_dofadr[joint], model.jnt_qposadr[joint]
        model.jnt_stiffness[joint] = own
        model.dof_damping[first : first + 3] = own * physics.damping_time
        model.qpos_spring[position : position + 4] = shape


def gravity_of(physics: Physics) -> Float[np.ndarray, "3"]:
    """Gravity in the table's frame [m/s^2]: its magnitude stays where the table is tilted."""
    normal = np.sqrt(max(float(physics.gravity) ** 2 - float(np.sum(np.square(physics.tilt))), 0.0))
    return np.array([*np.asarray(physics.tilt), -normal])


def quaternions(angles: np.ndarray) -> np.ndarray:
    """Rotations about z as (w, x, y, z), shape [..., 4]."""
    zero = np.zeros_like(angles)
    return np.stack([np.cos(angles / 2), zero, zero, np.sin(angles / 2)], axis=-1)
