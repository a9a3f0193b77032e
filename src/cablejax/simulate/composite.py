"""The cable as a MuJoCo composite: a chain of capsules, in the plane (z-hinges) or in space (ball joints).

Bending stiffness is a joint spring, `EI / link_length`. The elasticity plugin of MuJoCo states the same law, but MJX
drops plugins without a word, so a model that carries one is refused.

Two variants of the same chain are built:

  * `build_chain`: the bare chain. `MjxEngine` solves the grasps itself, in closed form (`grasp.py`).
  * `build_grasped_chain`: the chain welded to two mocap bodies, with friction carried by actuators, for C MuJoCo.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from cablejax.cable import GRAVITY, Discretisation

# A weld is as soft as the lighter body is light. The held links are held anyway, so C MuJoCo gets them heavy.
_HELD_MASS = 10.0  # [kg]
_HELD_INERTIA = 0.04  # [kg m^2], a sphere of 10 cm
# Constraint impedance, as close to a rigid weld as MuJoCo allows.
_RIGID = (0.9999, 0.9999, 0.001, 0.5, 2.0)
# Of an obstacle: a link of 2 g that is pressed by 0.1 N goes 0.2 mm deep.
_CONTACT = (0.99, 0.99, 0.001, 0.5, 2.0)


def build_chain(config: Discretisation) -> mujoco.MjModel:
    """The free chain: root link free in the plane (x, y, theta) or in space, `n_links - 1` bending joints."""
    return _chain_spec(config).compile()


def build_grasped_chain(config: Discretisation, obstacle: tuple[float, float, float] | None = None) -> mujoco.MjModel:
    """The chain welded at both ends to mocap bodies `gripper_0`, `gripper_1`, with friction actuators in the plane.

    The welds are deadbeat: with `k = 1/dt^2` and `b = 1/dt` the held end reaches the mocap pose within the very step,
    so a mocap pose set to the end of the step leaves no lag.

    Friction: MuJoCo has no Coulomb friction in a plane without contacts. Every free link carries two actuators along
    the world's x and y with force `-c v`; the engine sets `c = mu w / sqrt(|v|^2 + v0^2)` before each step, and
    `implicitfast` treats the force implicitly in `v`.

    Args:
        config: the cable.
        obstacle: centre and radius of a fixed disc, to the cable's centreline [m]; None = nothing can be touched.
    """
    spec = _chain_spec(config)
    if obstacle is not None:
        _add_obstacle(spec, obstacle, config.timestep)
    # a simulation that diverges shall say so, not start again in silence
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    links = link_bodies(spec)
    for link in (links[0], links[-1]):
        link.mass = _HELD_MASS
        link.inertia = [_HELD_INERTIA] * 3
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


def _add_obstacle(spec: mujoco.MjSpec, obstacle: tuple[float, float, float], dt: float) -> None:
    """Adds a sphere in the cable's plane, without friction.

    Sphere and links have half the radius each, so that it counts to the centreline. A contact is all but resolved
    within one step, like a grasp.
    """
    x, y, radius = obstacle
    for link in link_bodies(spec):
        for geom in link.geoms:
            geom.contype, geom.conaffinity, geom.condim = 1, 0, 1
            geom.size[0] = radius / 2
            geom.solref, geom.solimp = [-1.0 / dt**2, -1.0 / dt], _CONTACT
    spec.worldbody.add_geom(
        name="obstacle",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=[x, y, 0.0],
        size=[radius / 2, 0.0, 0.0],
        contype=0,
        conaffinity=1,
        condim=1,
        solref=[-1.0 / dt**2, -1.0 / dt],
        solimp=_CONTACT,
    )


def refuse_plugins(model: mujoco.MjModel) -> None:
    """Raises `ValueError` if the model carries an engine plugin, which MJX would drop in silence."""
    if model.nplugin:
        raise ValueError(
            f"The MuJoCo model has {model.nplugin} plugin instance(s). MJX ignores plugins, so the cable would have no "
            "bending stiffness. Build it with `cablejax.simulate.composite`, which uses joint springs instead."
        )


def stable_damping_time(damping_time: Any, timestep: float) -> Any:
    """The Kelvin-Voigt time [s] that MuJoCo's step can integrate: at least half a time step.

    The step takes elastic moments where it starts and damping where it ends. Bending waves of short cables of links are
    much faster than a step, and with less damping than this they grow without bound.
    """
    return damping_time.__array_namespace__().maximum(damping_time, 0.5 * timestep)


def link_bodies(spec: mujoco.MjSpec) -> list[mujoco.MjsBody]:
    """The links of the cable in order of arc length."""
    return [body for body in spec.bodies if body.name.startswith("cable")]


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


def _chain_spec(config: Discretisation) -> mujoco.MjSpec:
    lengths, offsets = link_lengths(config), node_offsets(config)
    vertices = np.concatenate([[0.0], np.cumsum(lengths)])
    gravity = 0.0 if config.dimension == 2 else -GRAVITY
    spec = mujoco.MjSpec.from_string(f"""
    <mujoco model="cable">
      <option timestep="{config.timestep:.17g}" gravity="0 0 {gravity}" integrator="implicitfast"/>
      <worldbody>
        <composite type="cable" prefix="cable" initial="free" vertex="{" ".join(f"{v:.9g} 0 0" for v in vertices)}">
          <joint kind="main"/>
          <geom type="capsule" size="{config.cable.diameter / 2:.9g}" contype="0" conaffinity="0"/>
        </composite>
      </worldbody>
    </mujoco>""")
    stiffness = config.cable.bending_stiffness / config.link_length
    origins = np.concatenate([[0.0], vertices[1:-1] - vertices[:-2]])
    for k, (link, length, offset, origin) in enumerate(zip(link_bodies(spec), lengths, offsets, origins, strict=True)):
        link.pos = [origin, 0.0, 0.0]  # the composite keeps vertices in single precision
        link.explicitinertial = True
        link.mass = config.cable.linear_density * length
        link.ipos = [offset, 0.0, 0.0]
        # A thin rod, with the roll inertia of a solid cylinder. No body has more than its two other moments together,
        # which links shorter than they are thick would.
        transverse = link.mass * length**2 / 12
        roll = min(link.mass * config.cable.diameter**2 / 8, 1.999 * transverse)
        link.inertia = [roll, transverse, transverse]
        if config.dimension == 2:
            _make_planar(spec, link, k)
        for joint in link.joints:
            if k > 0:
                # linear terms of polynomial laws
                joint.stiffness = [stiffness, 0.0, 0.0]
                joint.damping = [config.cable.damping_time * stiffness, 0.0, 0.0]
    return spec


def _make_planar(spec: mujoco.MjSpec, link: mujoco.MjsBody, k: int) -> None:
    """Replaces the free joint of the root by slide, slide, hinge and every ball joint by a hinge about z."""
    for joint in list(link.joints):
        spec.delete(joint)
    if k == 0:
        for name, axis in (("root_x", (1, 0, 0)), ("root_y", (0, 1, 0))):
            link.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        link.add_joint(name="root_theta", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1))
    else:
        link.add_joint(name=f"bend_{k}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1))
