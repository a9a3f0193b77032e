"""The cable as an inextensible curve between two grippers: a chain of rigid links with both ends given.

Link 0 starts in gripper 0 and has its direction, the last link ends in gripper 1 and has its direction, and the
unknowns are the J = n - 1 joint angles between the n links. The length of the curve cannot change whatever the angles
are, so a point at a given arc length stays at that arc length: the chain cannot slide within itself.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.arrays import quarter_turn
from cablejax.cable import Cable, Discretisation
from cablejax.simulate.composite import link_lengths, node_offsets
from cablejax.simulate.keypoints import hermite, hermite_weights

KERNEL_FLOOR = 1e-3
"""Added to the diagonal of the motion kernel, whose smallest eigenvalues are beyond floating point."""


class CurveMatrices(NamedTuple):
    """Constant matrices of one cable; n links, J joints, N keypoints. Read only: cached.

    Attributes:
        lengths, node_offsets: of the links [m], and from a link's start to its node [m], shape [n].
        keypoints_of_nodes, keypoints_of_tangents: Hermite weights of nodes and of tangents [m], shape [N, n].
        beyond: 1 where the link lies beyond the joint, shape [n, J].
        arclength: of the links' middles, as a fraction of the length, shape [n].
        stiffness_of_motion: inverse of the kernel of coherent motion, shape [n, n].
    """

    lengths: Any
    node_offsets: Any
    keypoints_of_nodes: Any
    keypoints_of_tangents: Any
    beyond: Any
    arclength: Any
    stiffness_of_motion: Any


class Curve(NamedTuple):
    """Geometry of the chain at given angles.

    Attributes:
        centre: middle of every link [m], shape [n, 2].
        tangent: its unit direction, shape [n, 2].
        curvature: of the smooth curve there [1/m], shape [n].
        joint: position of every joint [m], shape [J, 2].
        end: where the last link ends [m], shape [2].
    """

    centre: Float[Array, "*b n 2"]
    tangent: Float[Array, "*b n 2"]
    curvature: Float[Array, "*b n"]
    joint: Float[Array, "*b J 2"]
    end: Float[Array, "*b 2"]


@functools.lru_cache(maxsize=32)
def curve_matrices(n_links: int, n_keypoints: int, length: float, kernel_width: float) -> CurveMatrices:
    """The matrices of a cable of given length [m]; `kernel_width` is that of the motion kernel, in lengths."""
    config = Discretisation(Cable(length=length, n_keypoints=n_keypoints, diameter=1e-3 * length), n_links=n_links)
    lengths = link_lengths(config)
    arclength = (np.cumsum(lengths) - lengths / 2) / length
    kernel = np.exp(-0.5 * ((arclength[:, None] - arclength) / kernel_width) ** 2)
    return CurveMatrices(
        lengths,
        node_offsets(config),
        *hermite_weights(config),
        np.tri(n_links, n_links - 1, -1),
        arclength,
        np.linalg.inv(kernel + KERNEL_FLOOR * np.eye(n_links)),
    )


def curve(matrices: CurveMatrices, angles: Float[Array, "J"], pose: Float[Array, "Q 3"]) -> Curve:
    """The chain that leaves gripper 0 with these joint angles [rad]. Differentiable in `angles` and `pose`."""
    lengths = jnp.asarray(matrices.lengths, angles.dtype)
    theta = pose[0, 2] + jnp.concatenate([jnp.zeros(1, angles.dtype), jnp.cumsum(angles)])
    tangent = jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=-1)
    ends = pose[0, :2] + jnp.cumsum(lengths[:, None] * tangent, axis=0)
    padded = jnp.concatenate([angles[:1], angles, angles[-1:]])
    return Curve(
        centre=ends - 0.5 * lengths[:, None] * tangent,
        tangent=tangent,
        curvature=0.5 * (padded[1:] + padded[:-1]) / lengths[1],
        joint=ends[:-1],
        end=ends[-1],
    )


def keypoints_of(matrices: CurveMatrices, shape: Curve) -> Float[Array, "N 2"]:
    """Keypoints of a curve, uniform in arc length, both ends included. Differentiable in the curve."""
    dtype = shape.centre.dtype
    offsets = jnp.asarray(matrices.node_offsets - matrices.lengths / 2, dtype)
    nodes = shape.centre + offsets[:, None] * shape.tangent
    of_nodes, of_tangents = (
        jnp.asarray(m, dtype) for m in (matrices.keypoints_of_nodes, matrices.keypoints_of_tangents)
    )
    return of_nodes @ nodes + of_tangents @ shape.tangent


def centre_jacobian(matrices: CurveMatrices, shape: Curve) -> Float[Array, "n J 2"]:
    """Derivative of every link's middle by every joint angle [m/rad]: links beyond a joint turn about it."""
    arm = shape.centre[:, None] - shape.joint
    return jnp.asarray(matrices.beyond, arm.dtype)[..., None] * quarter_turn(arm)


def carried(
    matrices: CurveMatrices, centre: Float[Array, "n 2"], before: Float[Array, "Q 3"], after: Float[Array, "Q 3"]
) -> Float[Array, "n 2"]:
    """The curve after the grippers have moved, predicted from their motion alone.

    Cubic Hermite interpolation along the arc of the ends' displacements and of their tangents' change. Exact if both
    grippers translate alike. Differentiable in all three arrays.
    """
    s = jnp.asarray(matrices.arclength, centre.dtype)[:, None]
    length = float(np.sum(matrices.lengths))
    heading = jnp.stack([jnp.cos(after[:, 2]), jnp.sin(after[:, 2])], axis=-1)
    moved = after[:, :2] - before[:, :2]
    turned = length * (heading - jnp.stack([jnp.cos(before[:, 2]), jnp.sin(before[:, 2])], axis=-1))
    return centre + hermite(s, moved, turned)
