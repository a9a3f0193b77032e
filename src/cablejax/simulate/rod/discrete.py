"""Discretised forces of one cable in space on its nodes and edges, apart from the constraints.

Interpolation along the cable between nodes, joints and markers, forces of rest curvature and twist, the directors that
follow the edges, and the shape through observed markers from which a motion begins.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cablejax.simulate.rod.constrained import (
    TOLERANCE,
    ElasticChain,
    bends_of,
    constrained,
    spread_bends,
    with_held,
)
from cablejax.simulate.rod.material import joint_frames, transport, turned, twist, twist_matrix, unit
from cablejax.simulate.rod.physics import RodPhysics

# Pull of an observed marker on the first shape, over the mass of a length of cable [m/s^2 per m].
_PIN = 1.5e3
# The same on a moving cable, which follows its markers within 5 ms, for the cable from one marker to the next.
_FOLLOWS = 4e4


def along_joints(values: Float[Array | np.ndarray, "J"], count: int) -> Float[Array, "count"]:
    """Linear interpolation of evenly spaced values to the joints, half an edge from either end."""
    if values.shape[0] == 1:
        return jnp.broadcast_to(values, (count,))
    return jnp.interp((np.arange(count) + 0.5) / count, jnp.linspace(0.0, 1.0, values.shape[0]), values)


def cubic_weights(s: Float[Array | np.ndarray, "N"], h: Float[Array | np.ndarray, ""], n: int) -> Float[Array, "N n"]:
    """Cubic interpolation from the nodes, at arc lengths (j - 1/2) h, to arc lengths `s` [m]."""
    begin = jnp.clip(jnp.floor(s / h + 0.5).astype(int) - 1, 0, n - 4)
    u = s / h + 0.5 - begin
    weight = jnp.stack(
        [
            -(u - 1) * (u - 2) * (u - 3) / 6,
            u * (u - 2) * (u - 3) / 2,
            -u * (u - 1) * (u - 3) / 2,
            u * (u - 1) * (u - 2) / 6,
        ],
        axis=1,
    )
    rows = jnp.arange(s.shape[0])[:, None]
    return jnp.zeros((s.shape[0], n)).at[rows, begin[:, None] + jnp.arange(4)].set(weight)


@dataclasses.dataclass(frozen=True)
class DiscreteRod:
    """Constants of one cable of n nodes, J = n - 2 joints, f = n - 4 free nodes and N markers.

    Attributes:
        physics: of the cable.
        n: number of nodes.
        h: length of an edge [m].
        weights: interpolation from nodes to markers, shape [N, n].
        bending: stiffness of each joint, EI / rho / h^4 [1/s^2], shape [J].
        curve: rest curvature at each joint about the second and third axis [1/m], shape [J, 2].
        mass: of each free node with its share of the markers, over that of the bare cable, shape [f, 1].
        compliance: of the edges, see `ElasticChain`.
        turn_matrix: from `twist_matrix`.
    """

    physics: RodPhysics
    n: int
    h: Float[Array | np.ndarray, ""]
    weights: Float[Array, "N n"]
    bending: Float[Array, "J"]
    curve: Float[Array, "J 2"]
    mass: Float[Array | np.ndarray, "f 1"]
    compliance: Float[Array | np.ndarray, ""]
    turn_matrix: Float[Array, "e e"]

    @classmethod
    def of(cls, physics: RodPhysics, n_edges: int) -> DiscreteRod:
        """Cuts a cable into edges."""
        n, h = n_edges + 2, physics.length / n_edges
        weights = cubic_weights(physics.arclength, h, n)
        curve = jax.vmap(lambda c: along_joints(c, n - 2), in_axes=1, out_axes=1)(physics.rest_curvature)
        return cls(
            physics=physics,
            n=n,
            h=h,
            weights=weights,
            bending=along_joints(physics.stiffness, n - 2) / h**4,
            curve=curve,
            mass=1.0 + physics.marker_mass * weights.sum(axis=0)[2:-2, None] / h,
            compliance=h**4 / physics.stretch,
            turn_matrix=twist_matrix(physics, curve, h, n),
        )

    def forces(self, directors: Float[Array, "m 3"], tangents: Float[Array, "m 3"]) -> Float[Array, "f 3"]:
        """Forces of rest curvature and twist at the free nodes, per mass [m/s^2]."""
        h = self.h
        a, b = joint_frames(tangents, directors)
        # a curvature about the second axis bends towards minus the third
        wanted = self.curve[:, 1:] * a - self.curve[:, :1] * b
        force = spread_bends((self.bending * h**2)[:, None] * wanted)
        moment = self.physics.twist_stiffness / h**2 * twist(tangents, directors) / (2 * h)
        binormal = jnp.cross(tangents[:-1], tangents[1:]) * moment[:, None]
        # the twist of a joint grows with the node before it along binormal/2h, and against it with the node after
        return force + binormal[2:] - binormal[:-2]

    def relaxed(
        self, nodes: Float[Array, "n 3"], directors: Float[Array, "m 3"], tangents: Float[Array, "m 3"]
    ) -> Float[Array, "m 3"]:
        """Directors one step nearer to the equilibrium of twist; those of the held edges stay."""
        h, curve = self.h, self.curve
        a, b = joint_frames(tangents, directors)
        bend = bends_of(nodes)
        torque = (self.bending * h**2) * (
            curve[:, 1] * jnp.sum(bend * b, axis=1) + curve[:, 0] * jnp.sum(bend * a, axis=1)
        )
        torque = 0.5 * (torque[:-1] + torque[1:])
        moment = self.physics.twist_stiffness / h**2 * twist(tangents, directors)
        angle = self.turn_matrix @ (torque + jnp.diff(moment))
        return turned(directors, tangents, jnp.concatenate([jnp.zeros(1), angle, jnp.zeros(1)]))

    def followed(
        self,
        nodes: Float[Array, "n 3"],
        directors: Float[Array, "m 3"],
        tangents: Float[Array, "m 3"],
        side: Float[Array, "2 3"],
    ) -> tuple[Float[Array, "m 3"], Float[Array, "m 3"]]:
        """Directors and tangents after the nodes have moved; `side` are the directors of the held edges."""
        after = unit(jnp.diff(nodes, axis=0))
        directors = transport(directors, tangents, after)
        directors = jnp.concatenate([side[:1], directors[1:-1], side[1:]])
        directors = unit(directors - after * jnp.sum(directors * after, axis=1, keepdims=True))
        return self.relaxed(nodes, directors, after), after

    def first_frames(
        self, nodes: Float[Array, "n 3"], side: Float[Array, "2 3"]
    ) -> tuple[Float[Array, "m 3"], Float[Array, "m 3"]]:
        """Directors in equilibrium of twist, and tangents, from the nodes alone."""
        tangents = unit(jnp.diff(nodes, axis=0))

        def along(director, pair):
            director = transport(director, *pair)
            return director, director

        pairs = (tangents[:-1], tangents[1:])
        last, directors = jax.lax.scan(along, side[0], pairs)
        directors = jnp.concatenate([side[:1], directors])
        # spread the twist that the second gripper asks for evenly, then let it settle
        last = twist(tangents[-1:].repeat(2, 0), jnp.stack([last, side[1]]))[0]
        directors = turned(directors, tangents, jnp.linspace(0.0, 1.0, self.n - 1) * last)
        return jax.lax.fori_loop(0, 20, lambda _, d: self.relaxed(nodes, d, tangents), directors), tangents

    def marker_offsets(self, directors: Float[Array, "m 3"], tangents: Float[Array, "m 3"]) -> Float[Array, "N 3"]:
        """Vectors from the centreline to each marker [m]."""
        a, b = joint_frames(tangents, directors)
        mark, offset = self.weights[:, 1:-1], jnp.asarray(self.physics.offset)
        return offset[:, :1] * (mark @ a) + offset[:, 1:] * (mark @ b)

    def through(
        self,
        markers: Float[Array, "N 3"],
        held: Float[Array, "4 3"],
        guess: Float[Array, "f 3"],
        forces: Float[Array, "f 3"] | float = 0.0,
    ) -> tuple[Float[Array, "n 3"], Bool[Array, ""]]:
        """Nodes of the cable at rest that observed markers pull towards themselves, and whether they were found.

        Args:
            markers: where the centreline is to pass [m].
            held: the first two and the last two nodes [m].
            guess: free nodes to start from [m]; no derivative passes through it.
            forces: of rest curvature and twist, see `forces` [m/s^2].
        """
        n = self.n
        pins, pull = self._pulled(markers, held, jnp.sqrt(_PIN / self.h))
        pinned = ElasticChain(jnp.zeros(n - 4), self.bending, self.h, self.compliance, pins)
        force = pull + self.mass * self.physics.gravity + forces
        free, _, error = constrained(True, pinned, force, held, *jax.lax.stop_gradient((guess, jnp.zeros(n - 3))))
        return with_held(free, held), error <= TOLERANCE

    def following(
        self, markers: Float[Array, "N 3"], held: Float[Array, "4 3"]
    ) -> tuple[Float[Array, "N f"], Float[Array, "f 3"]]:
        """Pins and forces with which observed markers pull a moving cable towards themselves; NaN = not observed."""
        seen = jnp.isfinite(markers).all(axis=1, keepdims=True)
        spacing = self.physics.length / (len(markers) + 1)
        root = jnp.where(seen, jnp.sqrt(_FOLLOWS * spacing / self.h), 0.0)
        return self._pulled(jnp.where(seen, markers, 0.0), held, root)

    def _pulled(self, markers: Float[Array, "N 3"], held: Float[Array, "4 3"], root):
        """Pins to markers, with these roots of their strengths, and what they add to the forces on the free nodes."""
        pins = root * self.weights
        at_ends = pins[:, :2] @ held[:2] + pins[:, -2:] @ held[2:]
        return pins[:, 2:-2], pins[:, 2:-2].T @ (root * markers - at_ends)
