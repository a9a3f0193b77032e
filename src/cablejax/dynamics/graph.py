"""The cable as a graph: keypoints are nodes, keypoints near each other along the cable are connected.

Node features, in order, with N keypoints and H history samples (all in the model's frame, divided by their scales):

    2            position at t
    2 (H - 1)    displacements between the history's samples, oldest first
    2            arc-length fraction s, from the middle in a symmetric model, and 4 s (1 - s)
    5            at a grasped node its gripper's control input (vx, vy, omega) and heading (cos, sin); elsewhere 0
    2            1 at the node held by gripper 0, by gripper 1
    2            displacement that the prior expects
    2            distance from the frictionless resting shape: what friction holds (0 without a static prior)
    2            of a conditioned model: log stiffness and log friction over those of the reference cable

Edge features: position of the receiver relative to the sender [2], how much shorter that chord is than the cable
between them, and the signed arc length from sender to receiver.

The physics of a cable on a level table does not change under translation and rotation, so everything is expressed in
a frame whose origin is midway between the grippers and whose x axis runs from gripper 0 to gripper 1. A model in the
world's axes is there to measure what that is worth. This is the only file that imports jraph.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import jraph
import numpy as np
from jaxtyping import Array, Float

from cablejax.dynamics.config import ModelConfig
from cablejax.simulate.chain.statics import clamped, resting_shapes
from cablejax.simulate.compile import full_precision
from cablejax.simulate.keypoints import hermite
from cablejax.types import History


@dataclasses.dataclass(frozen=True, eq=False)
class Topology:
    """Edges of the graph: fixed by the rest shape, so built once and never padded.

    Edges are sorted by their offset `receiver - sender`, then by sender. On keypoints uniform in arc length this makes
    gathering and aggregating a matter of shifted slices, several times faster on a CPU than indexed scatter.

    Attributes:
        senders: int32, shape [E].
        receivers: int32, shape [E].
        offsets: the distinct values of `receiver - sender`, ascending; never 0.
    """

    senders: np.ndarray
    receivers: np.ndarray
    offsets: tuple[int, ...]


class Prior(NamedTuple):
    """Prior of a command's effect, before any learning.

    Attributes:
        displacement: expected X(t + 1) - X(t) [m], shape [N, 2], exact at the two grasped nodes.
        strain: X(t) minus the frictionless resting shape [m], shape [N, 2].
    """

    displacement: Float[Array, "N 2"]
    strain: Float[Array, "N 2"]


@functools.lru_cache(maxsize=32)
def cable_topology(n_keypoints: int, length: float, radius: float) -> Topology:
    """Directed edges between all keypoints at most `radius` [m] apart along the cable. Not to be modified: cached."""
    spacing = length / (n_keypoints - 1)
    reach = min(int(np.floor(radius / spacing * (1 + 1e-9))), n_keypoints - 1)
    offsets = tuple(k for k in range(-reach, reach + 1) if k != 0)
    senders = [np.arange(max(0, -k), n_keypoints - max(0, k), dtype=np.int32) for k in offsets]
    receivers = [part + np.int32(k) for part, k in zip(senders, offsets, strict=True)]
    return Topology(np.concatenate(senders), np.concatenate(receivers), offsets)


def topology_of(config: ModelConfig) -> Topology:
    """The topology that a model of this configuration works on."""
    return cable_topology(config.n_keypoints, config.length, config.radius)


class Frame(NamedTuple):
    """Frame in which a model sees the cable: `axes @ v` expresses a vector in the frame, `v @ axes` brings it back.

    Attributes:
        origin: in the world [m], shape [2].
        axes: rows are the x and y axis, shape [2, 2].
    """

    origin: Float[Array, "2"]
    axes: Float[Array, "2 2"]


def frame_of(gripper_pose: Float[Array, "2 3"]) -> Frame:
    """The grippers' frame, which turns and shifts with the cable. Differentiable as long as the grippers are apart."""
    along = gripper_pose[1, :2] - gripper_pose[0, :2]
    x = along / jnp.sqrt(jnp.sum(along**2))
    return Frame(gripper_pose[:, :2].mean(axis=0), jnp.stack([x, jnp.stack([-x[1], x[0]])]))


@full_precision
def build_graph(
    history: History,
    twist: Float[Array, "2 3"],
    prior: Prior,
    config: ModelConfig,
    frame: Callable[[Float[Array, "2 3"]], Frame] = frame_of,
) -> jraph.GraphsTuple:
    """The graph of one cable at one instant, see the top of this file. Differentiable in `history` and `twist`.

    Args:
        history: the last H samples; vmap for batches.
        twist: control input of both grippers in the world's frame [m/s, rad/s], shape [2, 3].
        prior: what `prior_of` gives for these.
        config: of the model that reads the graph.
        frame: by the grippers' poses, the frame of positions and directions.
    """
    topology, scale = topology_of(config), config.normalisation
    pose = clamped(history.gripper_pose, config.statics)
    origin, axes = frame(pose)
    past = (history.keypoints - origin) @ axes.T
    now = past[-1]

    s = np.linspace(0.0, 1.0, config.n_keypoints)
    # counted from the middle, reversal changes nothing but its sign
    arclength = jnp.asarray(np.stack([s - 0.5 * config.symmetric, 4 * s * (1 - s)], axis=-1), now.dtype)
    heading = jnp.stack([jnp.cos(pose[:, 2]), jnp.sin(pose[:, 2])], axis=-1) @ axes.T
    control = jnp.concatenate(
        [twist[:, :2] @ axes.T / scale.linear_speed, twist[:, 2:] / scale.angular_speed, heading], axis=-1
    )
    grasped = jnp.concatenate([control, jnp.eye(2, dtype=now.dtype)], axis=-1)
    free = jnp.zeros((config.n_keypoints - 2, grasped.shape[-1]), now.dtype)
    displacements = jnp.diff(past, axis=0).swapaxes(0, 1).reshape(config.n_keypoints, -1)
    known = []
    if config.conditioned:
        if history.cable is None:
            raise ValueError("A conditioned model needs History.cable: see `cablejax.types.cable_descriptor`.")
        known = [jnp.broadcast_to(history.cable, (config.n_keypoints, 2)).astype(now.dtype)]
    nodes = jnp.concatenate(
        [
            now / scale.position,
            displacements / scale.displacement,
            arclength,
            jnp.concatenate([grasped[:1], free, grasped[1:]]),
            prior.displacement @ axes.T / scale.displacement,
            prior.strain @ axes.T / scale.residual,
            *known,
        ],
        axis=-1,
    )

    along = (topology.receivers - topology.senders) * config.spacing
    chord = now[topology.receivers] - now[topology.senders]
    # 1 nm keeps the derivative finite should two observed keypoints ever coincide.
    shorter = jnp.asarray(np.abs(along), now.dtype) - jnp.sqrt(jnp.sum(chord**2, axis=-1) + 1e-18)
    edges = jnp.concatenate(
        [
            chord / config.spacing,
            shorter[:, None] / scale.shortening,
            jnp.asarray(along / config.radius, now.dtype)[:, None],
        ],
        axis=-1,
    )
    return jraph.GraphsTuple(
        nodes=nodes,
        edges=edges,
        senders=jnp.asarray(topology.senders),
        receivers=jnp.asarray(topology.receivers),
        globals=None,
        n_node=jnp.asarray([config.n_keypoints]),
        n_edge=jnp.asarray([topology.senders.size]),
    )


@full_precision
def prior_of(history: History, twist: Float[Array, "2 3"], config: ModelConfig) -> Prior:
    """The prior's prediction for a command. Differentiable in `history` and `twist`."""
    now, interval = history.keypoints[-1], config.interval
    if config.prior == "none":
        known = jnp.zeros_like(now).at[0].set(interval * twist[0, :2]).at[-1].set(interval * twist[1, :2])
        return Prior(displacement=known, strain=jnp.zeros_like(now))
    if config.prior == "rigid":
        displacement = rigid_interpolation(
            history.gripper_pose, twist, n_keypoints=config.n_keypoints, length=config.length, interval=interval
        )
        return Prior(displacement=displacement, strain=jnp.zeros_like(now))
    pose = clamped(history.gripper_pose, config.statics)
    before, after = resting_shapes(now, pose, pose + interval * twist, length=config.length, statics=config.statics)
    # exact at the grasped nodes, where nothing is left to predict
    displacement = (after - now).at[0].set(interval * twist[0, :2]).at[-1].set(interval * twist[1, :2])
    return Prior(displacement=displacement, strain=now - before)


def rigid_interpolation(
    gripper_pose: Float[Array, "2 3"],
    twist: Float[Array, "2 3"],
    *,
    n_keypoints: int,
    length: float,
    interval: float = 1.0,
) -> Float[Array, "N 2"]:
    """Displacement of every keypoint over one interval, interpolated from the two grippers' motion alone.

    Cubic Hermite interpolation in the arc-length fraction s of the end displacements `v dt` and of the end tangents'
    change `omega dt perp(tangent)`. It is exact at both ends, and exact everywhere if both grippers translate alike.
    Differentiable in `gripper_pose` and `twist`.

    Args:
        gripper_pose: (x, y, theta) of both grippers; theta is the direction of the cable's tangent, shape [2, 3].
        twist: (vx, vy, omega) of both grippers in the world's frame [m/s, rad/s], shape [2, 3].
        n_keypoints: N, uniform in arc length.
        length: free length of the cable [m].
        interval: duration of the step [s].
    """
    s = jnp.linspace(0.0, 1.0, n_keypoints, dtype=twist.dtype)[:, None]
    theta = gripper_pose[:, 2]
    normal = jnp.stack([-jnp.sin(theta), jnp.cos(theta)], axis=-1)
    moved = interval * twist[:, :2]
    turned = length * interval * twist[:, 2:] * normal
    return hermite(s, moved, turned)
