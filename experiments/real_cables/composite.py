"""The true cable as links on ball joints in MuJoCo: a second simulator, without any code of the rod that is fitted.

Links are rigid, so the cable keeps its length exactly. Its joints are springs and dampers, alike in bending and
torsion, drag acts on the middle of every link, and both ends are welded to grippers that move as prescribed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from real_cables.synthetic import SyntheticCable

_LINKS = 32, 48
"""Links of the cable's length, at least and at most: one more, for half a link at each end is in a gripper."""
_STEP = 5e-4
"""Longest time step [s]."""
_STABLE = 1.2
"""And as a phase of the fastest vibration [rad], for springs are explicit in MuJoCo. More links vibrate faster."""
_SHORTER = 1, 4, 16
"""It is divided by these in turn where a recording breaks down."""
_DENSITY = 0.05
"""Mass per length [kg/m]; a hanging cable's motion does not depend on it."""
_RADIUS = 0.28
"""Of the links, over their length: thinner ones turn about themselves faster than the time step can follow."""
_JUMP = 0.2
"""No motion moves a marker so far from one sample to the next, over the cable's length."""
_DAMPED = 200.0
"""Damping time times the fastest vibration's frequency, at most: welds of grips yield to stiffer dampers."""
_SETTLE, _SETTLE_DRAG = 1.0, 8.0
"""Time before the grippers move in which the cable comes to rest [s], and the drag that brings it there [1/s]."""
_WELD = "0.0015 1"
"""Time constant [s] and damping ratio of a grip."""
_LAG = 3e-3
"""By which a link that is welded to a moving body follows it late [s]: two time constants."""

Ends = list[tuple[np.ndarray, np.ndarray]]
"""Position and quaternion of both grippers."""


def simulated(
    cable: SyntheticCable,
    arclength: Float[np.ndarray, "N"],
    position: Float[np.ndarray, "R T 2 3"],
    frames: Float[np.ndarray, "R T 2 3 3"],
    interval: float,
) -> Float[np.ndarray, "R T N 3"]:
    """Free markers at every sample [m].

    Args:
        cable: what is true of it; rest curvature, offsets of markers and roll are not simulated.
        arclength: of the free markers from the first gripper [m].
        position, frames: of the grippers; rows of a frame are its axes in the world.
        interval: between samples [s].
    """
    count = _links(cable)
    model = mujoco.MjModel.from_xml_string(_xml(cable, count, arclength))
    step, found = min(_STEP, _STABLE / _fastest(cable, count)), []
    for motion in zip(position, frames, cable.grips, strict=True):
        ends, seen = _ends(*motion), np.zeros(0)
        for shorter in _SHORTER:
            # samples are whole numbers of steps
            model.opt.timestep = interval / (shorter * math.ceil(interval / step))
            seen = _recording(model, cable, count, arclength, ends, interval)
            if not broken(seen, cable.length):
                break
        found.append(seen)
    return np.stack(found)


def broken(markers: Float[np.ndarray, "*R T N 3"], length: float) -> bool:
    """Whether the simulation of a cable of this length [m] broke down: MuJoCo begins anew where it becomes unstable."""
    return not np.isfinite(markers).all() or np.abs(np.diff(markers, axis=-3)).max() > _JUMP * length


def longest_damping(cable: SyntheticCable) -> float:
    """The damping time up to which links can be simulated [s]: about half of what is critical for the first mode."""
    return _DAMPED / _fastest(cable, _LINKS[0])


def _fastest(cable: SyntheticCable, count: int) -> float:
    """Angular frequency of the fastest vibration of so many links [1/s]."""
    return float(4 * np.sqrt(cable.stiffness * np.exp(cable.profile.max())) * (count / cable.length) ** 2)


def _links(cable: SyntheticCable) -> int:
    """As many as neither take shorter time steps nor a shorter damping."""
    fastest = min(_STABLE / _STEP, _DAMPED / cable.damping_time)
    return int(np.clip(_LINKS[0] * np.sqrt(fastest / _fastest(cable, _LINKS[0])), *_LINKS))


def _recording(model, cable, count, arclength, ends: list[Ends], interval: float) -> Float[np.ndarray, "T N 3"]:
    """One recording."""
    edge = cable.length / count
    data = mujoco.MjData(model)
    data.qpos[:] = _standing(_bend_between(cable.length, ends[0], count), ends[0], edge)
    begin = _first(data, model, edge)
    links = slice(model.body("link0").id, model.body("link0").id + count + 1)
    weight = _DENSITY * edge

    def advance(samples: list[Ends], seconds: float, extra: float):
        steps = round(seconds / model.opt.timestep)
        for i in range(len(samples) - 1):
            for k in range(steps):
                # the grips are where they are recorded
                place = min(i + (k + 1) / steps + _LAG / seconds, len(samples) - 1)
                first = min(int(place), len(samples) - 2)
                before, after = samples[first : first + 2]
                for q in range(2):
                    data.mocap_pos[q], data.mocap_quat[q] = _between(before[q], after[q], place - first)
                axes = data.xmat[links].reshape(-1, 3, 3)
                middle = data.xpos[links] + 0.5 * edge * axes[:, :, 0]
                # MuJoCo gives the velocity of the body's point at the tree's centre of mass
                spin, velocity = data.cvel[links, :3], data.cvel[links, 3:]
                velocity = velocity + np.cross(spin, middle - data.subtree_com[links.start])
                speed = np.linalg.norm(velocity, axis=1, keepdims=True)
                data.xfrc_applied[links, :3] = -weight * (cable.drag + extra + cable.quadratic_drag * speed) * velocity
                mujoco.mj_step(model, data)
            yield

    for _ in advance([begin, ends[0]], _SETTLE, _SETTLE_DRAG):
        pass
    link, along = _places(arclength, edge, count)
    seen = []
    for _ in advance([ends[0], *ends], interval, 0.0):
        seen.append(data.xpos[links][link] + data.xmat[links].reshape(-1, 3, 3)[link, :, 0] * along[:, None])
    return np.array(seen)


def _xml(cable, count, arclength) -> str:
    edge = cable.length / count
    joints = (np.arange(1, count + 1) - 0.5) * edge
    knots = np.linspace(0.0, cable.length, len(cable.profile))
    spring = _DENSITY * cable.stiffness * np.exp(np.interp(joints, knots, cable.profile)) / edge
    markers = {int(link): along for link, along in zip(*_places(arclength, edge, count), strict=True)}
    text, end = [], []
    for k in range(count + 1):
        joint = (
            "<freejoint/>"
            if k == 0
            else f'<joint type="ball" stiffness="{spring[k - 1]}" damping="{spring[k - 1] * cable.damping_time}"/>'
        )
        text.append(
            f'<body name="link{k}" pos="{edge if k else 0} 0 0">{joint}'
            f'<geom type="capsule" fromto="0 0 0 {edge} 0 0" size="{_RADIUS * edge}" mass="{_DENSITY * edge}"/>'
        )
        if k in markers and cable.marker_mass > 0:
            mass = _DENSITY * cable.marker_mass
            text.append(f'<geom type="sphere" pos="{markers[k]} 0 0" size="0.002" mass="{mass}"/>')
        end.append("</body>")
    welds = [
        f'<weld body1="grip{q}" body2="link{link}" relpose="{-edge / 2} 0 0 1 0 0 0" solref="{_WELD}" '
        'solimp="0.999 0.9999 0.001"/>'
        for q, link in enumerate((0, count))
    ]
    return (
        '<mujoco><option integrator="implicitfast" jacobian="dense" solver="PGS"><flag contact="disable"/></option>'
        + '<worldbody><body name="grip0" mocap="true"/><body name="grip1" mocap="true"/>'
        + "".join([*text, *end])
        + f"</worldbody><equality>{''.join(welds)}</equality></mujoco>"
    )


def _places(arclength, edge, count):
    """Link of every marker, and how far along it the marker is [m]; the first gripper holds the middle of link 0."""
    link = np.minimum(((arclength + 0.5 * edge) / edge).astype(int), count)
    return link, arclength + 0.5 * edge - edge * link


def _ends(position, frames, grips) -> list[Ends]:
    """Of the cable in the grippers at every sample, gripped without twist where it hangs in a plane."""
    # as the effect is defined, see `cablejax.simulate.rod.clamps.held_nodes`
    along = frames[:, :, 0] + grips[:, 1:] * frames[:, :, 1] - grips[:, :1] * frames[:, :, 2]
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.array([0.0, 1.0, 0.0])
    side = across - along * (along @ across)[..., None]
    side = side / np.linalg.norm(side, axis=-1, keepdims=True)
    axes = np.stack([along, side, np.cross(along, side)], axis=-1)
    turns = Rotation.from_matrix(axes.reshape(-1, 3, 3)).as_quat(scalar_first=True).reshape(*axes.shape[:2], 4)
    return [[(position[t, q], turns[t, q]) for q in range(2)] for t in range(len(position))]


def _between(one, other, part):
    """Of two poses of a gripper that are near each other."""
    sign = np.where(one[1] @ other[1] < 0, -1.0, 1.0)
    turn = (1 - part) * one[1] + part * sign * other[1]
    return (1 - part) * one[0] + part * other[0], turn / np.linalg.norm(turn)


def hanging(
    length: float, position: Float[np.ndarray, "2 3"], arclength: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N 3"]:
    """A guess of where markers are that hang between two places at about the same height [m]."""
    count = _LINKS[0]
    bend = _bend_between(length, [(position[q], np.zeros(4)) for q in range(2)], count)
    way = position[1] - position[0]
    across = np.append(way[:2] / np.linalg.norm(way[:2]), 0.0)
    steps = np.cos(bend)[:, None] * across + np.sin(bend)[:, None] * np.array([0.0, 0.0, 1.0])
    middle = 0.5 * (steps[1:] + steps[:-1])
    nodes = np.concatenate([np.zeros((1, 3)), np.cumsum(middle, axis=0) * length / count])
    nodes = position[0] + nodes + np.linspace(0, 1, count + 1)[:, None] * (way - nodes[-1])
    s = np.linspace(0, length, count + 1)
    return np.stack([np.interp(arclength, s, column) for column in nodes.T], axis=1)


def _bend_between(length: float, ends: Ends, count: int) -> Float[np.ndarray, "K"]:
    """Angle of every link to the horizontal, from downwards to upwards, so that the cable reaches both ends [rad]."""
    way = np.linalg.norm((ends[1][0] - ends[0][0])[:2])
    u = np.linspace(-1.0, 1.0, count + 1)

    def angles(power):
        return 0.5 * np.pi * np.sign(u) * np.abs(u) ** power

    power = brentq(lambda power: length * np.cos(angles(power)).mean() - way, 0.02, 20.0)
    return angles(power)


def _standing(bend, ends: Ends, edge: float) -> Float[np.ndarray, "Q"]:
    """Positions of the joints: from the first gripper on in the plane of both and the vertical."""
    way = ends[1][0] - ends[0][0]
    plane = Rotation.from_euler("z", np.arctan2(way[1], way[0]))
    first = plane * Rotation.from_euler("y", -bend[0])
    others = Rotation.from_euler("y", -np.diff(bend)[:, None])
    origin = ends[0][0] - 0.5 * edge * first.apply([1.0, 0.0, 0.0])
    return np.concatenate([origin, first.as_quat(scalar_first=True), others.as_quat(scalar_first=True).ravel()])


def _first(data, model, edge: float) -> Ends:
    """The grippers where the cable is to begin with."""
    mujoco.mj_forward(model, data)
    links = [model.body("link0").id, model.nbody - 1]
    return [(data.xpos[i] + 0.5 * edge * data.xmat[i].reshape(3, 3)[:, 0], data.xquat[i].copy()) for i in links]
