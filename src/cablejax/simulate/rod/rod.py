"""A cable in space between two moving clamps: an inextensible rod in node coordinates, integrated by BDF2.

All quantities are per mass: the motion of a freely hanging cable does not depend on its weight. Nodes x_j lie at arc
lengths (j - 1/2) h, so that a clamp at s = 0 sits in the middle of the first edge and holds nodes 0 and 1; the same at
the other end. With D1, D2 the first and second differences,

    a_j + c v_j + q |v_j| v_j + h^-4 [D2' B (D2 x - h^2 k + tau (D2 v - w x D2 x))]_j = g + t_j - [D1' lambda D1 x]_j,
    |D1 x| = h,

where B = EI/rho [m^4/s^2], k the rest curvature turned with the material, tau the Kelvin-Voigt time, w the angular
velocity, c and q linear and quadratic drag and t the forces of twist. The bending moment is 2 sin(phi/2) instead of the
angle phi between two edges, phi (1 - phi^2/24): linear in the nodes. What is stiff is implicit; the rest (w, q, k, t)
is extrapolated to the end of the step to second order. See `constrained` for the solution of a step and its derivative.

BDF2 is of second order, and damps what is slow hardly at all: at 10 ms a vibration of 1 Hz loses 2e-4 of its
amplitude in a second, one of 5 Hz a tenth.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.simulate.rod.clamps import held_nodes
from cablejax.simulate.rod.constrained import ElasticChain, bends_of, constrained, spread_bends, with_held
from cablejax.simulate.rod.discrete import DiscreteRod
from cablejax.simulate.rod.material import transport, unit
from cablejax.simulate.rod.physics import RodPhysics

# With two iterations a step may end off the solution and blow up, where a cable swings fast at a sharply turned clamp.
_NEWTON = 3


class _Motion(NamedTuple):
    """State of a rollout: nodes and velocities of the last two time steps, tensions, directors and tangents."""

    nodes: Float[Array, "n 3"]
    nodes_before: Float[Array, "n 3"]
    velocity: Float[Array, "n 3"]
    velocity_before: Float[Array, "n 3"]
    tension: Float[Array, "e"]
    directors: Float[Array, "m 3"]
    tangents: Float[Array, "m 3"]


@dataclasses.dataclass(frozen=True)
class Rod:
    """Simulates `RodPhysics`. Pure, to be vmapped and jitted by the caller, in double precision.

    Attributes:
        n_edges: from clamp to clamp, the two held halves counted as one.
        substeps: time steps between two samples.
        twisting: whether the material frame is followed. Without it rest curvature, twist and offsets across the cable
            have no effect, and a step costs half.
    """

    n_edges: int = 20
    substeps: int = 1
    twisting: bool = True

    def rollout(
        self,
        physics: RodPhysics,
        position: Float[Array | np.ndarray, "T 2 3"],
        frames: Float[Array | np.ndarray, "T 2 3 3"],
        seen: Float[Array | np.ndarray, "2 N 3"],
        interval: Float[Array, ""] | float,
    ) -> Float[Array, "T N 3"]:
        """Free markers at every sample [m]; the first two are fits to `seen`, all others follow from the motion.

        Args:
            physics: of this cable.
            position: of the grippers [m].
            frames: of the grippers, rows are axes in the world, the first along the cable.
            seen: free markers at the first two samples [m].
            interval: between samples [s].
        """
        dt = interval / self.substeps
        position, frames, seen = jnp.asarray(position), jnp.asarray(frames), jnp.asarray(seen)
        discrete = DiscreteRod.of(jax.tree.map(jnp.asarray, physics), self.n_edges)
        held, side = held_nodes(discrete.physics, position, frames, discrete.h)
        first_points, state = self._begin(discrete, held, side, seen, interval)
        chain = ElasticChain(
            weight=discrete.mass[:, 0],
            bending=(1.0 + 1.5 / dt * discrete.physics.damping_time) * discrete.bending,
            edge=discrete.h,
            compliance=discrete.compliance,
            pins=jnp.zeros((0, discrete.n - 4)),
        )

        def sample(state, window):
            if self.substeps == 1:
                state = self._step(discrete, chain, dt, state, *(leaf[2] for leaf in window))
            else:
                state, _ = jax.lax.scan(
                    lambda s, i: (
                        self._step(
                            discrete, chain, dt, s, *(_between(leaf, (i + 1) / self.substeps) for leaf in window)
                        ),
                        None,
                    ),
                    state,
                    jnp.arange(self.substeps),
                )
            points = discrete.weights @ state.nodes
            if self.twisting:
                points = points + discrete.marker_offsets(state.directors, state.tangents)
            return state, points

        _, points = jax.lax.scan(sample, state, (_windows(held), _windows(side)))
        return jnp.concatenate([first_points, points])

    def _begin(self, discrete: DiscreteRod, held, side, seen, interval) -> tuple[Float[Array, "2 N 3"], _Motion]:
        """The free markers at the first two samples, and the motion from there on."""
        n, h = discrete.n, discrete.h
        nodes_s = (jnp.arange(n) - 0.5) * h
        arclength = discrete.physics.arclength
        guess = jnp.stack([jnp.interp(nodes_s, arclength, seen[0, :, k]) for k in range(3)], axis=1)[2:-2]
        start = discrete.through(seen[0], held[0], guess, 20)
        offsets = jnp.zeros_like(seen[0])
        if self.twisting:
            offsets = discrete.marker_offsets(*discrete.first_frames(start, side[0]))
            start = discrete.through(seen[0] - offsets, held[0], start[2:-2], 8)
        second = discrete.through(seen[1] - offsets, held[1], start[2:-2], 8)
        velocity = (second - start) / interval
        frames = discrete.first_frames(second, side[0]) if self.twisting else (jnp.zeros((n - 1, 3)),) * 2
        dt = interval / self.substeps
        motion = _Motion(second, second - dt * velocity, velocity, velocity, jnp.zeros(n - 3), *frames)
        return jnp.stack([discrete.weights @ start + offsets, discrete.weights @ second + offsets]), motion

    def _step(self, discrete: DiscreteRod, chain: ElasticChain, dt, state: _Motion, ends, side) -> _Motion:
        """One time step of BDF2, to where the held nodes are at `ends` and the held edges' directors are `side`.

        `chain` is that of a step but for the weights, which change with the drag.
        """
        physics, bending, mass = discrete.physics, discrete.bending, discrete.mass
        x, x_old, v, v_old, tension, u, t = state
        x_next, v_next = 2 * x - x_old, 2 * v - v_old
        edges, turning = jnp.diff(x_next, axis=0), jnp.diff(v_next, axis=0)
        spin = jnp.cross(edges, turning) / discrete.h**2
        spin = 0.5 * (spin[1:] + spin[:-1])
        objective = jnp.cross(spin, bends_of(x_next))
        speed = jnp.sqrt(jnp.sum(v_next**2, axis=1, keepdims=True) + 1e-12)
        known = (4 * x - x_old) / (2 * dt)
        damped = (bending * physics.damping_time)[:, None] * (bends_of(known) + objective)
        inertia = (3 * known / (2 * dt)) + (4 * v - v_old) / (2 * dt) + physics.gravity
        drag = physics.drag + physics.quadratic_drag * speed[2:-2]
        force = mass * inertia[2:-2] + drag * known[2:-2] + spread_bends(damped)
        chain = dataclasses.replace(chain, weight=2.25 / dt**2 * mass[:, 0] + 1.5 / dt * drag[:, 0])
        if self.twisting:
            force = force + discrete.forces(x_next, transport(u, t, unit(edges)), unit(edges))
        free, tension = constrained(_NEWTON, chain, force, ends, x_next[2:-2], tension)
        new = with_held(free, ends)
        if self.twisting:
            u, t = discrete.followed(new, u, t, side)
        return _Motion(new, x, (3 * new - 4 * x + x_old) / (2 * dt), v, tension, u, t)


def _windows(leaf: Float[Array, "T *shape"]) -> Float[Array, "T2 4 *shape"]:
    """Four neighbouring samples about each interval from the second sample on."""
    padded = jnp.concatenate([leaf, leaf[-1:]])
    return jnp.stack([padded[:-3], padded[1:-2], padded[2:-1], padded[3:]], axis=1)


def _between(leaf: Float[Array, "4 *shape"], w: Float[Array, ""]) -> Float[Array, "*shape"]:
    """Cubic through four samples at `w` between the middle two: a broken line of poses would shake the cable."""
    weight = jnp.stack(
        [-w * (1 - w) * (2 - w) / 6, (1 - w * w) * (2 - w) / 2, w * (1 + w) * (2 - w) / 2, -w * (1 - w * w) / 6]
    )
    return jnp.tensordot(weight, leaf, axes=1)
