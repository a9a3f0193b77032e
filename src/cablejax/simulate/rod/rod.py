"""A cable in space between two moving clamps: an inextensible rod in node coordinates, integrated by BDF2.

All quantities are per mass: the motion of a freely hanging cable does not depend on its weight. Nodes x_j lie at arc
lengths (j - 1/2) h, so that a clamp at s = 0 sits in the middle of the first edge and holds nodes 0 and 1; the same at
the other end. With D1, D2 the first and second differences,

    a_j + c v_j + q |v_j| v_j + h^-4 [D2' B (D2 x - h^2 k) + C' tau B C v]_j = g + t_j - [D1' lambda D1 x]_j,
    C v = D2 v - w x D2 x,        |D1 x| = h,

where B = EI/rho [m^4/s^2], k the rest curvature turned with the material, tau the Kelvin-Voigt time, w the angular
velocity of the material, linear in v, c and q linear and quadratic drag and t the forces of twist. The bending moment
is 2 sin(phi/2) instead of the angle phi between two edges, phi (1 - phi^2/24): linear in the nodes. What is stiff is
implicit; the rest (q, k, t and how w couples x, y and z) is extrapolated to the end of the step to second order. See
`constrained` for the solution of a step and its derivative.

BDF2 is of second order, and damps what is slow hardly at all: at 10 ms a vibration of 1 Hz loses 2e-4 of its
amplitude in a second, one of 5 Hz a tenth. A step that is not solved, or whose local error is large, is made again in
shorter ones (`_march`): a jerk of a clamp needs them, and what follows does not.
"""

from __future__ import annotations

import dataclasses
import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Float, Int

from cablejax.simulate.rod.clamps import held_nodes
from cablejax.simulate.rod.discrete import DiscreteRod
from cablejax.simulate.rod.material import unit
from cablejax.simulate.rod.physics import RodPhysics
from cablejax.simulate.rod.time_step import Motion, time_step

_HALVINGS = 5
_WHOLE = 2**_HALVINGS
# Every one of the shortest steps, and those that were too long; a step is tried twice as long as soon as it may be.
_ATTEMPTS = 3 * _WHOLE


class RodResult(enum.IntEnum):
    """How a rollout ended.

    Attributes:
        SOLVED: every step was solved, with a local error of at most `Rod.local_error`.
        COARSE: every step was solved; the shortest ones, 1/32, were too long somewhere for that local error.
        UNSOLVED: a step had no solution, however short. What came before is solved.
    """

    SOLVED = 0
    COARSE = 1
    UNSOLVED = 2


class Rollout(NamedTuple):
    """A simulated motion.

    Attributes:
        points: free markers [m]. Where no step was solved any more, the last solved ones.
        result: a `RodResult`.
        solved: samples up to the first that was not reached.
        steps: number of time steps that were tried.
    """

    points: Float[Array, "T N 3"]
    result: Int[Array, ""]
    solved: Int[Array, ""]
    steps: Int[Array, ""]


class _Progress(NamedTuple):
    """Within one time step: what was reached, in parts of it, and the length of the next attempt."""

    motion: Motion
    done: Int[Array, ""]
    size: Int[Array, ""]
    lost: Bool[Array, ""]
    coarse: Bool[Array, ""]
    attempts: Int[Array, ""]


@dataclasses.dataclass(frozen=True)
class Rod:
    """Simulates `RodPhysics`. Pure, to be vmapped and jitted by the caller, in double precision.

    Attributes:
        n_edges: from clamp to clamp, the two held halves counted as one. With fewer than 20, or more than 40, the first
            shape may have a wrong fold, which no result code reports.
        substeps: time steps between two samples.
        twisting: whether the material frame is followed. Without it rest curvature, twist and offsets across the cable
            have no effect, and a step costs half.
        local_error: a step whose local error is larger is made again in shorter ones; in lengths of an edge, so that it
            is 2 mm where 20 edges make 1 m.
    """

    n_edges: int = 20
    substeps: int = 1
    twisting: bool = True
    local_error: float = 0.04

    def rollout(
        self,
        physics: RodPhysics,
        position: Float[Array | np.ndarray, "T 2 3"],
        frames: Float[Array | np.ndarray, "T 2 3 3"],
        seen: Float[Array | np.ndarray, "K N 3"],
        interval: Float[Array, ""] | float,
        wanted: Int[Array, ""] | int | None = None,
    ) -> Rollout:
        """Free markers at every sample; the first two are fits to `seen`, all others follow from the motion.

        Two samples of a few markers hardly tell how a cable moves between them. Further ones pull the cable towards
        themselves for as long as they last, which brings the motion after them close to the observed one.

        Differentiable in all arguments, in forward and in reverse mode, where the result is not `UNSOLVED`; the lengths
        of time steps are chosen without derivative.

        Args:
            physics: of this cable.
            position: of the grippers [m].
            frames: of the grippers, rows are axes in the world, the first along the cable.
            seen: free markers at the first K samples [m], at least two; from the third on NaN = not observed.
            interval: between samples [s].
            wanted: so many samples are simulated, and the cable stays as it is at the last; None = all.

        Raises:
            ValueError: fewer than two samples of the markers, or more than of the grippers.
        """
        if not 2 <= len(seen) <= len(position):
            raise ValueError(f"{len(seen)} samples of the markers, expected 2 to {len(position)}, as of the grippers.")
        position, frames, seen = jnp.asarray(position), jnp.asarray(frames), jnp.asarray(seen)
        discrete = DiscreteRod.of(jax.tree.map(jnp.asarray, physics), self.n_edges)
        held, side = held_nodes(discrete.physics, position, frames, discrete.h)
        first_points, motion, found = self._begin(discrete, held, side, seen, interval)
        zero = jnp.zeros((), int)
        start = _Progress(motion, zero, zero + _WHOLE, ~found, jnp.zeros((), bool), zero)

        def sample(progress, inputs):
            between, go = inputs

            def step(progress, index):
                return self._march(discrete, interval, progress, between, index), None

            def advanced(progress):
                return jax.lax.scan(step, progress, jnp.arange(self.substeps))[0]

            progress = jax.lax.cond(go, advanced, lambda at: at, progress)
            points = discrete.weights @ progress.motion.nodes
            if self.twisting:
                points = points + discrete.marker_offsets(progress.motion.directors, progress.motion.tangents)
            return progress, (points, progress.lost)

        grippers, shown = _windows(jnp.concatenate([held, side], axis=1)), None
        if len(seen) > 2:
            padded = jnp.full((len(position), *seen.shape[1:]), jnp.nan).at[: len(seen)].set(seen)
            shown = jnp.stack([padded[1:-1], padded[2:]], axis=1)
        go = jnp.arange(2, len(position)) < (len(position) if wanted is None else wanted)
        progress, (points, lost) = jax.lax.scan(sample, start, ((grippers, shown), go))
        result = jnp.where(progress.lost, RodResult.UNSOLVED, jnp.where(progress.coarse, RodResult.COARSE, 0))
        solved = jnp.where(found, 2 + jnp.sum(~lost), 0)
        return Rollout(jnp.concatenate([first_points, points]), result, solved, progress.attempts)

    def _begin(
        self, discrete: DiscreteRod, held, side, seen, interval
    ) -> tuple[Float[Array, "2 N 3"], Motion, Bool[Array, ""]]:
        """The free markers at the first two samples, the motion from there on, and whether that was found."""
        n, h = discrete.n, discrete.h
        nodes_s = (jnp.arange(n) - 0.5) * h
        # beyond the markers on the way to the nodes that are held
        ends = nodes_s[jnp.array([1, -2])]
        known_s = jnp.clip(jnp.insert(discrete.physics.arclength, jnp.array([0, len(seen[0])]), ends), *ends)
        known = jnp.concatenate([held[0][1:2], seen[0], held[0][2:3]])
        guess = jnp.stack([jnp.interp(nodes_s, known_s, known[:, k]) for k in range(3)], axis=1)[2:-2]
        start, found = discrete.through(seen[0], held[0], guess)
        offsets, forces = jnp.zeros_like(seen[0]), 0.0
        if self.twisting:
            frames = discrete.first_frames(start, side[0])
            offsets, forces = discrete.marker_offsets(*frames), discrete.forces(*frames)
            start, again = discrete.through(seen[0] - offsets, held[0], start[2:-2], forces)
            found &= again
        second, also = discrete.through(seen[1] - offsets, held[1], start[2:-2], forces)
        velocity = (second - start) / interval
        none = jnp.zeros((n - 1, 3))
        directors, tangents = discrete.first_frames(second, side[1]) if self.twisting else (none, none)
        dt, slack = interval / self.substeps, jnp.zeros(n - 3)
        motion = Motion(
            second,
            second - dt * velocity,
            velocity,
            velocity,
            slack,
            slack,
            directors,
            tangents,
            jnp.asarray(dt, second.dtype),
        )
        return (
            jnp.stack([discrete.weights @ start + offsets, discrete.weights @ second + offsets]),
            motion,
            found & also,
        )

    def _march(self, discrete: DiscreteRod, interval, progress: _Progress, between, index) -> _Progress:
        """Makes the time step of this index between two samples, in parts of 1, 1/2, ... 1/32 of it.

        A part that is not solved, or has too large a local error, is tried again with shorter ones; after one that was
        easy the next is twice as long. `between` has the grippers about these samples, and the markers at both or None.
        """
        dt, (window, shown) = interval / self.substeps, between

        def attempt(at: _Progress) -> _Progress:
            share = (index + (at.done + at.size) / _WHOLE) / self.substeps
            grippers, rates = _between(window, share)
            ends, side = grippers[:4], grippers[4:]
            roll_rate = _roll_rate(ends, side, rates[4:] / interval)
            markers = None if shown is None else shown[0] + share * (shown[1] - shown[0])
            new, solved, error = time_step(
                discrete, at.motion, dt * at.size / _WHOLE, ends, side, roll_rate, markers, twisting=self.twisting
            )
            ratio = jax.lax.stop_gradient(error / discrete.h) / self.local_error
            fine, shortest = solved & (ratio <= 1.0), at.size == 1
            accepted = (fine | (shortest & solved)) & ~at.lost
            done = jnp.where(accepted, at.done + at.size, at.done)
            # the local error falls with the third power of the step
            halvings = jnp.where(solved, jnp.ceil(jnp.log2(jnp.maximum(ratio, 1.0) + 1e-9) / 3).clip(1, _HALVINGS), 2)
            longer = fine & (8.0 * ratio < 1.0) & (done % (2 * at.size) == 0) & (at.size < _WHOLE)
            size = jnp.where(
                accepted,
                jnp.where(longer, 2 * at.size, at.size),
                jnp.maximum(at.size >> halvings.astype(at.size.dtype), 1),
            )
            lost = at.lost | (shortest & ~solved)
            return _Progress(
                jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, at.motion),
                jnp.where(lost, _WHOLE, done),
                size,
                lost,
                at.coarse | (accepted & ~fine),
                at.attempts + ~at.lost,
            )

        def needed(at):
            return at.done < _WHOLE

        def one(at, _):
            # a batch goes on while one of it has to
            go = needed(at)
            new = jax.lax.cond(unvmap_any(go), attempt, lambda at: at, at)
            return jax.tree.map(lambda a, b: jnp.where(go, a, b), new, at), None

        @jax.checkpoint
        def more(at):
            at, _ = jax.lax.scan(one, at, None, length=_ATTEMPTS)
            return at._replace(lost=at.lost | needed(at))

        at = attempt(progress._replace(done=jnp.zeros_like(progress.done)))
        return jax.lax.cond(unvmap_any(needed(at)), more, lambda at: at, at)


def _roll_rate(ends: Float[Array, "4 3"], side: Float[Array, "2 3"], rate: Float[Array, "2 3"]) -> Float[Array, "2"]:
    """By which the held edges turn about themselves [rad/s], from their directors and how fast those change [1/s]."""
    along = unit(ends[1::2] - ends[::2])
    return jnp.sum(jnp.cross(side, rate) * along, axis=1) / jnp.sum(side**2, axis=1)


def _windows(leaf: Float[Array, "T *shape"]) -> Float[Array, "T2 4 *shape"]:
    """Four neighbouring samples about each interval from the second sample on."""
    padded = jnp.concatenate([leaf, leaf[-1:]])
    return jnp.stack([padded[:-3], padded[1:-2], padded[2:-1], padded[3:]], axis=1)


def _between(leaf: Float[Array, "4 *shape"], w: Float[Array, ""]) -> Float[Array, "2 *shape"]:
    """Cubic through four samples at `w` between the middle two, and its rate: a broken line of poses would shake it."""

    def weights(w):
        return jnp.stack(
            [-w * (1 - w) * (2 - w) / 6, (1 - w * w) * (2 - w) / 2, w * (1 + w) * (2 - w) / 2, -w * (1 - w * w) / 6]
        )

    return jnp.tensordot(jnp.stack(jax.jvp(weights, (w,), (jnp.ones_like(w),))), leaf, axes=1)
