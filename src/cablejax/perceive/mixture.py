"""The terms that a registration weighs: how well the cloud fits the cable, and how well the cable keeps its structure.

The cloud is taken as samples from a Gaussian mixture along the cable, with one uniform component for outliers. Wang et
al., RA-L 2022, place one round Gaussian on each keypoint, all of the same weight and variance, and one uniform
component of weight mu for noise and outliers. Round Gaussians pull their centres along the cable towards wherever
points are dense, although a cloud says nothing about sliding along the cable. Here every link of a fine chain has a
Gaussian of its own that is as long as the link and as wide as sigma, and its residual is the distance across the cable
alone. Links of the same length have the same weight, as in the paper.

Tang and Tomizuka, "Track deformable objects from point clouds with structure preserved registration", IJRR 2018, add
two terms to the mixture's likelihood. The displacement since the last frame shall be smooth, as the norm of a coherent
displacement field; and every point shall keep its place relative to its neighbours, as in local linear embedding.
Neighbours here are neighbours along the cable, so that two parts of it may cross without being tied to each other.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cablejax.arrays import quarter_turn
from cablejax.perceive.curve import Curve

ELONGATION = 0.4
"""Standard deviation of a Gaussian along its link, in lengths of the link."""
NEIGHBOURS = 4
"""Neighbours that each point is expressed by: two on either side, or the nearest four at the ends. In the plane three
express any point; the fourth makes it a fit."""
STRIDE = 3
"""Links from one neighbour to the next: they are about as far apart as keypoints are. Direct neighbours would only feel
wiggles from link to link."""
RIDGE = 1e-5
"""Ridge of the local fits, relative to the trace of their Gram matrices."""


class Moments(NamedTuple):
    """Sums over the points, weighted with the responsibility of each link for each point.

    With `a` a point's position along the link and `r` its distance across:

    Attributes:
        weight: sum of the responsibilities, shape [n].
        along: sum of a [m], shape [n].
        along_squared: sum of a^2 [m^2], shape [n].
        across: sum of r [m], shape [n].
        along_across: sum of a r [m^2], shape [n].
        across_squared: sum of r^2 [m^2], shape [n].
        log_likelihood: of all points [nats; areas in m^2], shape [].
    """

    weight: Float[Array, " n"]
    along: Float[Array, " n"]
    along_squared: Float[Array, " n"]
    across: Float[Array, " n"]
    along_across: Float[Array, " n"]
    across_squared: Float[Array, " n"]
    log_likelihood: Float[Array, ""]


def expectation(
    points: Float[Array, "S 2"],
    mask: Bool[Array, " S"],
    shape: Curve,
    lengths: Any,
    sigma: Float[Array, ""],
    *,
    outlier_weight: float,
    area: float,
) -> Moments:
    """E-step: responsibility of each link for each point. Differentiable in `points`, `shape` and `sigma`.

    A point's distance across a link is taken to the osculating parabola, `n d - curvature a^2 / 2`, so that a bent
    cable is not drawn to the inside of its bend.

    Args:
        points: the cloud on the table [m].
        mask: false where a row of `points` is only padding.
        shape: the cable's curve.
        lengths: of its links [m], shape [n].
        sigma: standard deviation of the points across the cable [m].
        outlier_weight: mu, prior probability that a point is an outlier.
        area: over which outliers are spread [m^2].
    """
    lengths = jnp.asarray(lengths, points.dtype)
    along, across = _along_across(points, shape)
    spread = (ELONGATION * lengths) ** 2 + sigma**2
    scale = jnp.log((1.0 - outlier_weight) * lengths / jnp.sum(lengths)) - jnp.log(
        2.0 * jnp.pi * sigma * jnp.sqrt(spread)
    )
    density = jnp.exp(scale - 0.5 * along**2 / spread - 0.5 * (across / sigma) ** 2)
    total = jnp.sum(density, axis=-1) + outlier_weight / area
    share = jnp.where(mask[:, None], density / total[:, None], 0.0)
    return Moments(
        weight=jnp.sum(share, axis=0),
        along=jnp.sum(share * along, axis=0),
        along_squared=jnp.sum(share * along**2, axis=0),
        across=jnp.sum(share * across, axis=0),
        along_across=jnp.sum(share * along * across, axis=0),
        across_squared=jnp.sum(share * across**2, axis=0),
        log_likelihood=jnp.sum(jnp.where(mask, jnp.log(total), 0.0)),
    )


def distance_to(points: Float[Array, "S 2"], shape: Curve, lengths: Any) -> Float[Array, " S"]:
    """Distance [m] of every point to the curve, shape [S]."""
    half = 0.5 * jnp.asarray(lengths, points.dtype)
    along, across = _along_across(points, shape)
    excess = jax.nn.relu(jnp.abs(along) - half)
    return jnp.sqrt(jnp.min(across**2 + excess**2, axis=-1))


def _along_across(points: Float[Array, "S 2"], shape: Curve) -> tuple[Float[Array, "S n"], Float[Array, "S n"]]:
    """Position of each point along each link, from its middle, and distance across it [m]."""
    normal = quarter_turn(shape.tangent)
    along = points @ shape.tangent.T - jnp.sum(shape.centre * shape.tangent, axis=-1)
    across = points @ normal.T - jnp.sum(shape.centre * normal, axis=-1) - 0.5 * shape.curvature * along**2
    return along, across


def embedding_stiffness(centre: Float[Array, "n 2"]) -> Float[Array, "n n"]:
    """`(I - W)' (I - W)`, with the weights W that best express each point by its neighbours and sum to one.

    The energy `x' E x` is zero wherever the neighbourhoods keep their shape, up to a local affine map and the ridge.
    Differentiable in `centre`.
    """
    n = centre.shape[0]
    # int32 whether or not JAX is in 64-bit mode
    index = np.array([_neighbours(k, n) for k in range(n)], dtype=np.int32)
    arms = centre[index] - centre[:, None]
    gram = arms @ jnp.swapaxes(arms, -1, -2)
    trace = jnp.trace(gram, axis1=-2, axis2=-1)[:, None, None]
    gram = gram + RIDGE * trace * jnp.eye(NEIGHBOURS, dtype=centre.dtype)
    weight = jnp.linalg.solve(gram / trace, jnp.ones((n, NEIGHBOURS, 1), gram.dtype))[..., 0]
    weight = weight / jnp.sum(weight, axis=-1, keepdims=True)
    difference = jnp.eye(n, dtype=centre.dtype).at[np.arange(n, dtype=np.int32)[:, None], index].add(-weight)
    return difference.T @ difference


def _neighbours(k: int, n: int) -> list[int]:
    reachable = [j for j in range(k % STRIDE, n, STRIDE) if j != k]
    return sorted(sorted(reachable, key=lambda j: abs(j - k))[:NEIGHBOURS])
