"""Replays of measured gripper poses by the planar chain."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from cablejax.cable import Discretisation
from cablejax.effects.physics import NEVER, Physics
from cablejax.simulate.chain.state import ChainState, chain_nodes
from cablejax.simulate.chain.step import advance, slipped
from cablejax.simulate.compile import full_precision
from cablejax.simulate.keypoints import marked_keypoints

LARGEST_STEP = 0.05
"""Longest time step of a fit [s]. What it is off for the nominal cable is known from one replay with `FINE_STEP`."""
FINE_STEP = 0.01
"""Longest time step of the nominal cable that a log is compared with [s]."""
SETTLING = 4.0
"""For how long a cable that settles soon does so before a replay [s]."""
_SETTLE_STEPS = 20
_SHORTEST_STEP = 1e-4
"""With it a cable stays where it is [s]."""
_SLOW = 1.0
"""Damping time beyond which a cable has hardly settled when it is first seen [s]."""


@dataclasses.dataclass(frozen=True)
class Chain:
    """Replays gripper poses. Pure, to be vmapped and jitted by the caller.

    Attributes:
        config: geometry and resolution; its time step and nominal values are not used.
        with_contact: whether the obstacle can be touched. Looking for contacts is a quarter of a step's work.
    """

    config: Discretisation
    with_contact: bool = True

    @full_precision
    def rollout(
        self,
        physics: Physics,
        angles: Float[Array, "n"],
        gripper_pose: Float[Array, "T Q 3"],
        interval: Float[Array, ""],
        *,
        n_substeps: int,
        n_samples: Int[Array, ""] | int | None = None,
        settling: Float[Array, ""] | float = SETTLING,
    ) -> Float[Array, "T N 2"]:
        """Keypoints on the centreline, as the physics has them: before any camera.

        The cable first settles, without friction, from `angles` at the first pose; one that takes long to do so, by
        its `damping_time`, begins as `angles` are. Differentiable in everything but `n_substeps` and `n_samples`.

        Args:
            physics: of this cable.
            angles: theta of the first link and joint angles as first seen, or near the settled start [rad].
            gripper_pose: (x, y, theta) at every sample, theta continuous.
            interval: between two samples [s].
            n_substeps: time steps between two samples.
            n_samples: of the poses; the keypoints of the last one are repeated over the others, which takes no time as
                long as all cables of a batch share this number. None = all.
            settling: for how long the cable settles [s]; 0 = it begins as `angles` are, and the table holds it there as
                far as its friction goes.
        """
        config, first, zero = self.config, gripper_pose[0], jnp.zeros((), angles.dtype)
        start = self._settled(physics, angles, first, settling)

        def move(carry, target):
            state, pose, time, _ = carry
            state = follow(
                config,
                physics,
                state,
                pose,
                target,
                interval / n_substeps,
                time,
                n_substeps=n_substeps,
                with_contact=self.with_contact,
            )
            time = time + interval
            return state, target, time, centreline_keypoints(config, physics, state, target[0, :2], time)

        def sample(carry, item):
            index, target = item
            if n_samples is None:
                carry = move(carry, target)
            else:
                carry = jax.lax.cond(index < n_samples, move, lambda carry, _: carry, carry, target)
            return carry, carry[-1]

        points = centreline_keypoints(config, physics, start, first[0, :2], zero)
        items = jnp.arange(1, len(gripper_pose)), gripper_pose[1:]
        _, moved = jax.lax.scan(sample, (start, first, zero, points), items)
        return jnp.concatenate([points[None], moved])

    def _settled(
        self,
        physics: Physics,
        angles: Float[Array, "n"],
        pose: Float[Array, "Q 3"],
        settling: Float[Array, ""] | float,
    ) -> ChainState:
        """The cable at rest at the first pose, as far as its damping lets it come to rest, with nothing locked in."""
        zeros, still = jnp.zeros(self.config.n_joints, angles.dtype), jnp.zeros(self.config.n_links + 1, angles.dtype)
        start = ChainState(
            angles=angles,
            stretch=jnp.zeros((), angles.dtype),
            velocity=still,
            expected=still,
            set_curvature=zeros,
            friction_state=zeros,
            root_velocity=jnp.zeros(2, angles.dtype),
            expected_root=jnp.zeros(2, angles.dtype),
        )
        calm = dataclasses.replace(
            physics,
            friction=jnp.zeros_like(physics.friction),
            patch_friction=jnp.zeros_like(physics.patch_friction),
            hysteresis_moment=jnp.zeros_like(physics.hysteresis_moment),
            yield_curvature=jnp.full_like(physics.yield_curvature, NEVER),
            drag=jnp.zeros_like(physics.drag),
        )

        step = settling / _SETTLE_STEPS / (1.0 + (physics.damping_time / _SLOW) ** 2)
        dt = jnp.maximum(step, _SHORTEST_STEP)

        def settle(state, _):
            state = advance(self.config, calm, state, pose, pose, dt, -1e3, with_contact=self.with_contact)
            return dataclasses.replace(state, expected=still), None

        start, _ = jax.lax.scan(settle, start, None, length=_SETTLE_STEPS)
        return dataclasses.replace(start, velocity=still, friction_state=zeros)


def follow(
    config: Discretisation,
    physics: Physics,
    state: ChainState,
    start: Float[Array, "Q 3"],
    end: Float[Array, "Q 3"],
    dt: Float[Array, ""] | float,
    time: Float[Array, ""],
    *,
    n_substeps: int,
    with_contact: bool,
) -> ChainState:
    """Moves the grippers on a straight line from one pose to another, in `n_substeps` steps of `dt` seconds."""

    def substep(state, i):
        before = start + (end - start) * (i / n_substeps)
        after = start + (end - start) * ((i + 1) / n_substeps)
        state = advance(config, physics, state, before, after, dt, time + (i + 1) * dt, with_contact=with_contact)
        return state, None

    return jax.lax.scan(substep, state, jnp.arange(n_substeps))[0]


def centreline_keypoints(
    config: Discretisation, physics: Physics, state: ChainState, root: Float[Array, "2"], time: Float[Array, ""]
) -> Float[Array, "N 2"]:
    """Keypoints [m] of the chain that leaves gripper 0 at `root`, before any camera."""
    nodes, unit = chain_nodes(config, state.angles, state.stretch)
    return marked_keypoints(
        config, physics, root + nodes, unit, scale=1.0 + state.stretch, slipped=slipped(physics, time)
    )
