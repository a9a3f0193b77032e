"""A cable in space between two moving clamps: an inextensible rod in node coordinates, integrated by BDF2.

Everything is per mass: no motion of a cable that hangs free tells its weight. Nodes x_j lie at arc lengths
(j - 1/2) h, so that a clamp at s = 0 sits in the middle of the first edge and holds nodes 0 and 1; the same at the
other end. With D1, D2 the first and second differences,

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

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cablejax.simulate.rod.clamps import held_nodes
from cablejax.simulate.rod.constrained import Chain, bends_of, constrained, spread_bends, with_held
from cablejax.simulate.rod.interpolation import along_joints, between_samples, cubic_weights
from cablejax.simulate.rod.material import joint_frames, transport, turned, twist, twist_matrix, unit
from cablejax.simulate.rod.physics import RodPhysics

# With two iterations a step may end off the solution and blow up, where a cable swings fast at a sharply turned clamp.
_NEWTON = 3
_NEAR = 4
# Weight of the observed markers when the first shape is drawn through them [1/s^2].
_PIN = 3e4


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
        n, dt = self.n_edges + 2, interval / self.substeps
        physics = jax.tree.map(jnp.asarray, physics)
        position, frames, seen = jnp.asarray(position), jnp.asarray(frames), jnp.asarray(seen)
        h = physics.length / self.n_edges
        held, held_side = held_nodes(physics, position, frames, h)
        weights = cubic_weights(physics.arclength, h, n)

        bending = along_joints(physics.stiffness, n - 2) / h**4
        curve = jax.vmap(lambda c: along_joints(c, n - 2), in_axes=1, out_axes=1)(physics.rest_curvature)
        mass = 1.0 + physics.marker_mass * weights.sum(axis=0)[2:-2, None] / h
        compliance = h**4 / physics.stretch
        chain = Chain(
            weight=mass[:, 0],
            bending=(1.0 + 1.5 / dt * physics.damping_time) * bending,
            edge=h,
            compliance=compliance,
            pins=jnp.zeros((0, n - 4)),
        )
        pins = _PIN**0.5 * weights
        pinned = Chain(jnp.zeros(n - 4), bending, h, compliance, pins[:, 2:-2])
        turn_matrix = twist_matrix(physics, curve, h, n)

        def forces(nodes, directors, tangents):
            """Of rest curvature and twist at the free nodes."""
            if not self.twisting:
                return 0.0
            a, b = joint_frames(tangents, directors)
            # a curvature about the second axis bends towards minus the third
            wanted = curve[:, 1:] * a - curve[:, :1] * b
            force = spread_bends((bending * h**2)[:, None] * wanted)
            moment = physics.twist_stiffness / h**2 * twist(tangents, directors) / (2 * h)
            binormal = jnp.cross(tangents[:-1], tangents[1:]) * moment[:, None]
            # the twist of a joint grows with the node before it along binormal/2h, and against it with the node after
            return force + binormal[2:] - binormal[:-2]

        def relax(nodes, directors, tangents):
            """Directors one step nearer to the equilibrium of twist; those of the held edges stay."""
            a, b = joint_frames(tangents, directors)
            bend = bends_of(nodes)
            torque = (bending * h**2) * (
                curve[:, 1] * jnp.sum(bend * b, axis=1) + curve[:, 0] * jnp.sum(bend * a, axis=1)
            )
            torque = 0.5 * (torque[:-1] + torque[1:])
            moment = physics.twist_stiffness / h**2 * twist(tangents, directors)
            angle = turn_matrix @ (torque + jnp.diff(moment))
            return turned(directors, tangents, jnp.concatenate([jnp.zeros(1), angle, jnp.zeros(1)]))

        def follow(nodes, directors, tangents, side):
            after = unit(jnp.diff(nodes, axis=0))
            directors = transport(directors, tangents, after)
            directors = jnp.concatenate([side[:1], directors[1:-1], side[1:]])
            directors = unit(directors - after * jnp.sum(directors * after, axis=1, keepdims=True))
            return relax(nodes, directors, after), after

        def through(markers, held, guess, iterations):
            at_ends = pins[:, :2] @ held[:2] + pins[:, -2:] @ held[2:]
            pull = pins[:, 2:-2].T @ (_PIN**0.5 * markers - at_ends) + physics.gravity
            near = constrained(iterations, pinned, pull, held, guess, jnp.zeros(n - 3))
            free, _ = constrained(_NEAR, pinned, pull, held, *jax.lax.stop_gradient(near))
            return with_held(free, held)

        def first_frames(nodes):
            tangents = unit(jnp.diff(nodes, axis=0))

            def along(director, pair):
                director = transport(director, *pair)
                return director, director

            pairs = (tangents[:-1], tangents[1:])
            last, directors = jax.lax.scan(along, held_side[0, 0], pairs)
            directors = jnp.concatenate([held_side[0, :1], directors])
            # spread the twist that the second gripper asks for evenly, then let it settle
            last = twist(tangents[-1:].repeat(2, 0), jnp.stack([last, held_side[0, 1]]))[0]
            directors = turned(directors, tangents, jnp.linspace(0.0, 1.0, n - 1) * last)
            return jax.lax.fori_loop(0, 20, lambda _, d: relax(nodes, d, tangents), directors), tangents

        def marker_offsets(nodes, directors, tangents):
            a, b = joint_frames(tangents, directors)
            mark = weights[:, 1:-1]
            return physics.offset[:, :1] * (mark @ a) + physics.offset[:, 1:] * (mark @ b)

        nodes_s = (jnp.arange(n) - 0.5) * h
        guess = jnp.stack([jnp.interp(nodes_s, physics.arclength, seen[0, :, k]) for k in range(3)], axis=1)[2:-2]
        start = through(seen[0], held[0], guess, 20)
        offsets = jnp.zeros_like(seen[0])
        if self.twisting:
            offsets = marker_offsets(start, *first_frames(start))
            start = through(seen[0] - offsets, held[0], start[2:-2], 8)
        second_nodes = through(seen[1] - offsets, held[1], start[2:-2], 8)
        velocity = (second_nodes - start) / interval
        directors, tangents = first_frames(second_nodes) if self.twisting else (jnp.zeros((n - 1, 3)),) * 2

        def step(state, ends):
            x, x_old, v, v_old, tension, u, t = state
            ends, side = ends
            x_next, v_next = 2 * x - x_old, 2 * v - v_old
            edges, turning = jnp.diff(x_next, axis=0), jnp.diff(v_next, axis=0)
            spin = jnp.cross(edges, turning) / h**2
            spin = 0.5 * (spin[1:] + spin[:-1])
            objective = jnp.cross(spin, bends_of(x_next))
            speed = jnp.sqrt(jnp.sum(v_next**2, axis=1, keepdims=True) + 1e-12)
            known = (4 * x - x_old) / (2 * dt)
            damped = (bending * physics.damping_time)[:, None] * (bends_of(known) + objective)
            inertia = (3 * known / (2 * dt)) + (4 * v - v_old) / (2 * dt) + physics.gravity
            drag = physics.drag + physics.quadratic_drag * speed[2:-2]
            force = mass * inertia[2:-2] + drag * known[2:-2] + spread_bends(damped)
            now = dataclasses.replace(chain, weight=2.25 / dt**2 * mass[:, 0] + 1.5 / dt * drag[:, 0])
            if self.twisting:
                force = force + forces(x_next, transport(u, t, unit(edges)), unit(edges))
            free, tension = constrained(_NEWTON, now, force, ends, x_next[2:-2], tension)
            new = with_held(free, ends)
            if self.twisting:
                u, t = follow(new, u, t, side)
            return (new, x, (3 * new - 4 * x + x_old) / (2 * dt), v, tension, u, t), None

        state = (
            second_nodes, second_nodes - dt * velocity, velocity, velocity, jnp.zeros(n - 3), directors, tangents,
        )  # fmt: skip

        def sample(state, window):
            if self.substeps == 1:
                state, _ = step(state, jax.tree.map(lambda leaf: leaf[2], window))
            else:
                state, _ = jax.lax.scan(
                    lambda s, i: step(
                        s, jax.tree.map(lambda leaf: between_samples(leaf, (i + 1) / self.substeps), window)
                    ),
                    state,
                    jnp.arange(self.substeps),
                )
            points = weights @ state[0]
            if self.twisting:
                points = points + marker_offsets(state[0], state[5], state[6])
            return state, points

        def windows(leaf):
            padded = jnp.concatenate([leaf, leaf[-1:]])
            return jnp.stack([padded[:-3], padded[1:-2], padded[2:-1], padded[3:]], axis=1)

        _, points = jax.lax.scan(sample, state, (windows(held), windows(held_side)))
        first_points = [weights @ start + offsets, weights @ second_nodes + offsets]
        return jnp.concatenate([jnp.stack(first_points), points])
