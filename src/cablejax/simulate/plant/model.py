"""The MuJoCo model of the contact plant: a cable with contact and friction cones, which no training simulator has.

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

from cablejax.effects.physics import Physics, normal_gravity
from cablejax.simulate.composite import add_links, link_lengths
from cablejax.simulate.plant.config import PlantConfig

GRASP_STIFFNESS = 100.0
"""Stiffness of the grasp in units of `1 / dt^2`: a held link trails a jump of the command's speed by dv dt / 100."""
HELD_MASS, HELD_RADIUS = 10.0, 0.1
"""Sphere [kg, m] at each held link: a gripper is heavy, and the heavier the link the stiffer MuJoCo's grasp."""
CONTACT_IMPEDANCE = (0.3, 0.99, 0.0003)
"""MuJoCo's impedance of the table's contacts: at first touch, at depth, and the depth [m]. Contacts that are stiff from
the first touch on chatter: the mean normal force then is up to three times the weight, and so is friction."""
OBSTACLE_HEIGHT = 0.2
"""How far an obstacle reaches above the table [m]."""
INEXTENSIBLE = 1e4
"""Axial stiffness [N] of a cable whose free length changes by slipping only: a newton stretches 1 m by 0.1 mm."""
AXIAL_DAMPING = 0.01
"""Time constant of the damping along the cable [s]; no measured one is known, and only slow stretch is of interest."""
GRASP_DAMPING = 0.01
"""Time constant of the damping of a compliant grasp [s]."""
CONE_RATIO = 100.0
"""MuJoCo's `impratio`: how much harder the friction cone's tangent is than its normal direction; it sets how slowly a
cable at rest creeps."""
CONTACT_TIME = 0.01
"""Time constant of the table's contacts [s]."""
FRICTIONLESS = 1e-5
"""MuJoCo's smallest friction coefficient."""


def plant_model(config: PlantConfig) -> mujoco.MjModel:
    """The MuJoCo model of the plant: table, chain of links, and one mocap body welded to each held link."""
    cable, physics = config.cable, config.physics
    h, dt = config.discretisation.link_length, config.discretisation.timestep
    lengths = link_lengths(config.discretisation)
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = dt, [*physics.tilt, -normal_gravity(physics)]
    spec.option.integrator, spec.option.cone = mujoco.mjtIntegrator.mjINT_DISCRETE, mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio, spec.option.tolerance = CONE_RATIO, 1e-8
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], contype=1, conaffinity=0, condim=3
    )
    links = add_links(
        spec, lengths, cable.diameter / 2, dimension=3, contype=0, conaffinity=1, condim=3, priority=1,
        solref=[CONTACT_TIME, 1.0], solimp=[*CONTACT_IMPEDANCE, 0.5, 2.0],
    )  # fmt: skip
    for link, mass in zip(links, np.asarray(physics.density) * lengths + physics.extra_mass, strict=True):
        link.geoms[0].mass = mass
    for gripper, (link, offset) in enumerate(((links[0], 0.0), (links[-1], h / 2))):
        _hold(spec, link, gripper, offset, config)
    if extensible(physics):
        _add_extension(links[1:], config)
    if physics.obstacle_radius > 0:
        _add_obstacle(spec, config)
    model = spec.compile()
    _set_bending(model, config)
    if physics.drag > 0:
        _set_drag(model, model.body(links[1].name).id, float(physics.drag) * h)
    return model


def extensible(physics: Physics) -> bool:
    """Whether the cable's free length changes."""
    return bool(physics.axial_compliance > 0 or np.any(physics.slip))


def _hold(spec: mujoco.MjSpec, link: mujoco.MjsBody, gripper: int, offset: float, config: PlantConfig) -> None:
    """Welds a link to its gripper; a compliant grasp has a hand between the two, which turns against the link."""
    link.geoms[0].conaffinity = 0  # the gripper carries its link: it neither rubs on the table nor weighs on it
    link.gravcomp = 1.0
    compliance = float(config.physics.rotation_compliance[gripper])
    hand = link
    if compliance > 0:
        hand, offset = link.add_body(name=f"hand_{gripper}", pos=[offset, 0, 0], gravcomp=1.0), 0.0
        turn = hand.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
        turn.stiffness, turn.damping = [1.0 / compliance, 0, 0], [GRASP_DAMPING / compliance, 0, 0]
    hand.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[HELD_RADIUS, 0, 0], pos=[offset, 0, 0], mass=HELD_MASS,
        contype=0, conaffinity=0,
    )  # fmt: skip
    mocap = spec.worldbody.add_body(name=f"gripper_{gripper}", mocap=True)
    weld = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1=mocap.name, name2=hand.name,
        solref=[-GRASP_STIFFNESS / config.discretisation.timestep**2, 0.0], solimp=[0.9999, 0.9999, 0.001, 0.5, 2.0],
    )  # fmt: skip
    data = np.zeros(12)
    data[6], data[10] = 1.0, 1.0  # identity quaternion between mocap and link, unit weight of the rotation
    weld.data = data


def _add_extension(links: list[mujoco.MjsBody], config: PlantConfig) -> None:
    """Slides between the links, along the cable: springs of its axial stiffness, or stiff ones where it only slips."""
    compliance = max(float(config.physics.axial_compliance), 1.0 / INEXTENSIBLE)
    stiffness = 1.0 / (compliance * config.discretisation.link_length)
    for link in links:
        slide = link.add_joint(name=f"stretch_{link.name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0])
        slide.stiffness, slide.damping = [stiffness, 0, 0], [AXIAL_DAMPING * stiffness, 0, 0]


def _add_obstacle(spec: mujoco.MjSpec, config: PlantConfig) -> None:
    """A smooth upright pole, thinner than the obstacle by the cable's own radius."""
    physics = config.physics
    radius = float(physics.obstacle_radius) - config.cable.diameter / 2
    spec.worldbody.add_geom(
        name="obstacle", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radius, OBSTACLE_HEIGHT, 0],
        pos=[*physics.obstacle_centre, 0.0], contype=1, conaffinity=0, condim=1, priority=2,
        solref=[CONTACT_TIME, 1.0],
    )  # fmt: skip


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


def _set_drag(model: mujoco.MjModel, link: int, coefficient: float) -> None:
    """Viscous drag on the middle of every free link [N s/m]: that of MuJoCo's medium on a link's box of equal inertia.

    The medium is part of the implicit step, at hardly any cost. It drags on `3 pi d` times its viscosity, d the mean
    side of the box (MuJoCo's documentation, "Fluid forces, inertia model"); free links are all alike.
    """
    inertia = model.body_inertia[link]
    sides = np.sqrt(6.0 * (inertia.sum() - 2.0 * inertia) / model.body_mass[link])
    model.opt.viscosity = coefficient / (3.0 * np.pi * sides.mean())


def quaternions(angles: np.ndarray) -> np.ndarray:
    """Rotations about z as (w, x, y, z), shape [..., 4]."""
    zero = np.zeros_like(angles)
    return np.stack([np.cos(angles / 2), zero, zero, np.sin(angles / 2)], axis=-1)
