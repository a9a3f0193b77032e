"""Ties a graph network's weights so that it commutes with the symmetries of a cable on a table.

A uniform cable looks the same in a mirror, and from either end. Mirroring M and reversal R generate a group of four:
identity, M, R, MR. In the grippers' frame M turns (x, y, angle) into (x, -y, -angle). R exchanges the grippers, so the
frame turns by half a turn: vectors change sign, angles do not, and node i becomes node N - 1 - i, which message passing
does not notice. So the group permutes the columns of every feature and changes their signs. On latent vectors it acts
by permuting four blocks of channels (the regular representation), with which ReLU and layer normalisation commute. That
leaves the linear layers. A matrix W and a bias b commute with the group if each is its own average over it,

    W = 1/4 sum_g  rho_in(g) W rho_out(g)',        b = 1/4 sum_g  rho_out(g) b

(Cohen and Welling, "Group Equivariant Convolutional Networks", ICML 2016). A network with such weights costs what any
other does. The average is a projection, and elementwise optimisers keep tied weights tied if the gradient is projected.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Int

from cablejax.dynamics.config import ModelConfig

ORDER = 4
"""Elements of the group, in the order identity, M, R, MR."""


class Representation(NamedTuple):
    """How the group acts on n columns: `(g x)[i] = sign[g, i] * x[source[g, i]]`.

    Attributes:
        source: the column that each column is taken from, shape [4, n].
        sign: 1 or -1, shape [4, n].
    """

    source: Int[np.ndarray, "4 n"]
    sign: Float[np.ndarray, "4 n"]


def of_signs(mirror: list[int], reversal: list[int]) -> Representation:
    """Columns that stay in place, with their signs under M and under R."""
    sign = np.array([[1] * len(mirror), mirror, reversal, np.multiply(mirror, reversal)], float)
    return Representation(np.tile(np.arange(len(mirror)), (ORDER, 1)), sign)


def regular(width: int) -> Representation:
    """Latent channels: four blocks, exchanged by the group like its own elements."""
    blocks = np.arange(width).reshape(ORDER, -1)
    source = np.stack([blocks[np.arange(ORDER) ^ g].ravel() for g in range(ORDER)])
    return Representation(source, np.ones((ORDER, width)))


def node_representation(config: ModelConfig) -> Representation:
    """Representation of the node features, in the order of `cablejax.dynamics.graph`."""
    vectors, known = config.history, 2 * config.conditioned
    # positions and displacements, arc length, control and heading, which gripper, prior, what is known of the cable
    mirror = [1, -1] * vectors + [1, 1] + [1, -1, -1, 1, -1] + [1, 1] + [1, -1] * 2 + [1] * known
    reversal = [-1, -1] * vectors + [-1, 1] + [-1, -1, 1, 1, 1] + [1, 1] + [-1, -1] * 2 + [1] * known
    source, sign = of_signs(mirror, reversal)
    which = 2 * vectors + 7
    source[2:, [which, which + 1]] = which + 1, which
    return Representation(source, sign)


EDGES = of_signs([1, -1, 1, 1], [-1, -1, 1, -1])
"""Of the edge features: relative position, how much shorter the chord is, signed arc length."""

DISPLACEMENT = of_signs([1, -1], [-1, -1])
"""Of a displacement in the grippers' frame."""


def symmetrised(weights: nnx.State, config: ModelConfig) -> nnx.State:
    """The nearest weights that commute with the group; those of a model that is not `symmetric` as they are.

    Linear, and its own adjoint: it projects gradients too.

    Args:
        weights: of the network, or of the auto-encoders around its encoders, or their gradient.
        config: of the network.
    """
    if not config.symmetric:
        return weights
    return _mapped(weights, config, _average)


def initially_symmetric(weights: nnx.State, config: ModelConfig) -> nnx.State:
    """Random weights, tied. An average of four has half the standard deviation of one, which is restored."""
    if not config.symmetric:
        return weights

    def tied(value: Array, rows: Representation | None, columns: Representation) -> Array:
        return _average(value, rows, columns) * (1.0 if rows is None else ORDER**0.5)

    return _mapped(weights, config, tied)


def _mapped(weights: nnx.State, config: ModelConfig, change) -> nnx.State:
    """`change(array, rows, columns)` of every array, with what its rows (None: a vector) and columns stand for."""
    latent, hidden, nodes = regular(config.latent), regular(config.hidden), node_representation(config)
    ends = {
        "node_encoder": (nodes, latent),
        "edge_encoder": (EDGES, latent),
        "decoder": (latent, DISPLACEMENT),
        "phi_v": (nodes, latent),
        "phi_e": (EDGES, latent),
        "psi_v": (latent, nodes),
        "psi_e": (latent, EDGES),
    }

    def one(path: tuple, variable: nnx.Variable) -> nnx.Variable:
        inputs, outputs = ends.get(path[0], (latent, latent))
        rows = inputs if "first" in path else hidden
        # `rest` ends in the layer that puts out what the normalisation then scales
        at_end = path[-3:-1] == ("rest", config.hidden_layers - 1) or "norm" in path
        value = variable.get_value()
        return variable.replace(change(value, rows if value.ndim == 2 else None, outputs if at_end else hidden))

    return nnx.from_flat_state([(path, one(path, variable)) for path, variable in nnx.to_flat_state(weights)])


def _average(
    value: Float[Array, "*rows columns"], rows: Representation | None, columns: Representation
) -> Float[Array, "*rows columns"]:
    """The average over the group of a matrix, or of a vector where `rows` is None."""

    def acted(g: int) -> Array:
        moved = columns.sign[g].astype(value.dtype) * value[..., columns.source[g]]
        return moved if rows is None else rows.sign[g].astype(value.dtype)[:, None] * moved[rows.source[g]]

    return sum(acted(g) for g in range(ORDER)) / ORDER  # pyright: ignore[reportReturnType]
