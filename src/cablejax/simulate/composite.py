"""Builds the cable for MuJoCo: a chain of capsules, in the plane (z-hinges) or in space (ball joints).

The chain is made of plain bodies and joints, which MuJoCo 3 and 4 share. MuJoCo 3 compiles the same model from its
`<composite type="cable">`, which MuJoCo 4 removed.

Bending stiffness is a joint spring, `EI / link_length`. MuJoCo 3's elasticity plugin states the same law, but MJX drops
plugins without a word.

Two variants of the same chain are built:

  * `build_chain`: the bare chain. `MjxEngine` solves the grasps itself, in closed form (`grasp.py`).
  * `build_grasped_chain`: the chain welded to two mocap bodies, with friction carried by actuators, for C MuJoCo.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from cablejax.cable import GRAVITY, Discretisation

# A weld is as soft as the lighter body is light. The held links are held anyway, so C MuJoCo gets them heavy: in masses
# of the cable, and of that mass times its length squared. One mass for every cable is too light for the moments of a
# stiff one, and so heavy for a short one that rounding moves the rest.
_HELD_MASS = 125.0
_HELD_INERTIA = 0.5
# Constraint impedance, as close to a rigid weld as MuJoCo allows.
_RIGID = (0.9999, 0.9999, 0.001, 0.5, 2.0)


def build_chain(config: Discretisation) -> mujoco.MjModel:
    """The free chain: root link free in the plane (x, y, theta) or in space, `n_links - 1` bending joints."""
    return _chain_spec(config)[0].compile()


def build_grasped_chain(config: Discretisation) -> mujoco.MjModel:
    """The chain welded at both ends to mocap bodies `gripper_0`, `gripper_1`, with friction actuators in the plane.

    The welds are deadbeat: with `k = 1/dt^2` and `b = 1/dt` the held end reaches the mocap pose within the very step,
    so a mocap pose set to the end of the step leaves no lag.

    Friction: MuJoCo has no Coulomb friction in a plane without contacts. Every free link carries two actuators along
    the world's x and y with force `-c v`; the engine sets `c = mu w / sqrt(|v|^2 + v0^2)` before each step, and
    `implicitfast` treats the force implicitly in `v`.

    Args:
        config: the cable.
    """
    spec, links = _chain_spec(config)
    # a simulation that diverges shall say so, not start again in silence
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    mass = config.cable.linear_density * config.cable.length
    for link in (links[0], links[-1]):
        link.mass = _HELD_MASS * mass
        link.inertia = [_HELD_INERTIA * mass * config.cable.length**2] * 3
    tip = [config.link_length / 2, 0.0, 0.0]
    dt = config.timestep
    for index, (link, anchor) in enumerate(((links[0], [0.0, 0.0, 0.0]), (links[-1], tip))):
        spec.worldbody.add_body(name=f"gripper_{index}", mocap=True)
        weld = spec.add_equality(
            name=f"grasp_{index}",
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=f"gripper_{index}",
            name2=link.name,
            solref=[-1.0 / dt**2, -1.0 / dt],
            solimp=_RIGID,
        )
        # anchor in the link, then the link's pose relative to the mocap body (none), then the torque scale
        weld.data[:11] = [*anchor, 0, 0, 0, 1, 0, 0, 0, 1]
    if config.dimension == 2:
        spec.worldbody.add_site(name="world")
        for k, link in enumerate(links[1:-1], start=1):
            link.add_site(name=f"node_{k}", pos=link.ipos)
            for axis in range(2):
                actuator = spec.add_actuator(
                    name=f"friction_{k}_{'xy'[axis]}",
                    trntype=mujoco.mjtTrn.mjTRN_SITE,
                    target=f"node_{k}",
                    refsite="world",
                    gear=np.eye(6)[axis],
                )
                actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
                actuator.gainprm[0] = 0.0
    return spec.compile()


def stable_damping_time(damping_time: Any, timestep: float) -> Any:
    """The Kelvin-Voigt time [s] that MuJoCo's step can integrate: at least half a time step.

    The step takes elastic moments where it starts and damping where it ends. Bending waves of short cables of links are
    much faster than a step, and with less damping than this they grow without bound.
    """
    return damping_time.__array_namespace__().maximum(damping_time, 0.5 * timestep)


def add_links(
    spec: mujoco.MjSpec, lengths: np.ndarray, radius: float, *, dimension: int, **contact: Any
) -> list[mujoco.MjsBody]:
    """Adds a chain of capsules along x to the world: bodies whose names begin with "cable", in order of arc length.

    The root moves freely, in the plane by the joints x, y and theta. Every other link turns about the end of the link
    before: in space by a ball joint, in the plane by a hinge about z. Joints have neither springs nor dampers.

    Args:
        spec: where to add the chain.
        lengths: length of each link [m], shape [n_links].
        radius: of the capsules [m].
        dimension: 2 for a chain in the plane, 3 for one in space.
        contact: fields of every capsule, for example `contype`.
    """
    kind, links, parent = mujoco.mjtJoint, [], spec.worldbody
    for k, (origin, length) in enumerate(zip([0.0, *lengths[:-1]], lengths, strict=True)):
        link = parent.add_body(name=f"cable_{k}", pos=[origin, 0.0, 0.0])
        link.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, length, 0, 0], size=[radius, 0, 0], **contact
        )
        if dimension == 3:
            link.add_joint(name=f"bend_{k}" if k else "root", type=kind.mjJNT_BALL if k else kind.mjJNT_FREE)
        elif k:
            link.add_joint(name=f"bend_{k}", type=kind.mjJNT_HINGE, axis=[0, 0, 1])
        else:
            link.add_joint(name="root_x", type=kind.mjJNT_SLIDE, axis=[1, 0, 0])
            link.add_joint(name="root_y", type=kind.mjJNT_SLIDE, axis=[0, 1, 0])
            link.add_joint(name="root_theta", type=kind.mjJNT_HINGE, axis=[0, 0, 1])
        links.append(link)
        parent = link
    return links


def link_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Indices of the bodies that are the cable's links, in order of arc length, shape [n]."""
    return np.array([i for i in range(model.nbody) if model.body(i).name.startswith("cable")])


def link_lengths(config: Discretisation) -> np.ndarray:
    """Length of each link [m], shape [n_links]: half-length links at the held ends."""
    lengths = np.full(config.n_links, config.link_length)
    lengths[[0, -1]] /= 2
    return lengths


def node_offsets(config: Discretisation) -> np.ndarray:
    """Offset of each link's node along the link from the link's origin [m], shape [n_links].

    Node j sits at arc length `j * link_length`: the middle of a free link, the outer end of a held one.
    """
    offsets = np.full(config.n_links, config.link_length / 2)
    offsets[0] = 0.0
    return offsets


def _chain_spec(config: Discretisation) -> tuple[mujoco.MjSpec, list[mujoco.MjsBody]]:
    """The bare chain and its links, in order of arc length."""
    lengths, offsets = link_lengths(config), node_offsets(config)
    spec = mujoco.MjSpec()
    spec.modelname = "cable"
    spec.option.timestep = config.timestep
    spec.option.gravity = [0.0, 0.0, 0.0 if config.dimension == 2 else -GRAVITY]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    stiffness = config.cable.bending_stiffness / config.link_length
    links = add_links(spec, lengths, config.cable.diameter / 2, dimension=config.dimension, contype=0, conaffinity=0)
    for link, length, offset in zip(links, lengths, offsets, strict=True):
        link.explicitinertial = True
        link.mass = config.cable.linear_density * length
        link.ipos = [offset, 0.0, 0.0]
        # A thin rod, with the roll inertia of a solid cylinder. No body has more than its two other moments together,
        # which links shorter than they are thick would.
        transverse = link.mass * length**2 / 12
        roll = min(link.mass * config.cable.diameter**2 / 8, 1.999 * transverse)
        link.inertia = [roll, transverse, transverse]
    for link in links[1:]:
        # linear terms of polynomial laws
        link.joints[0].stiffness = [stiffness, 0.0, 0.0]
        link.joints[0].damping = [config.cable.damping_time * stiffness, 0.0, 0.0]
    return spec, links
