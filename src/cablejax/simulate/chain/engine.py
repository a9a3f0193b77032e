"""The closed-form chain as an engine: every effect of the library, differentiable, and the fastest in batches."""

from __future__ import annotations

import dataclasses
import functools
from typing import ClassVar, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cablejax.cable import Discretisation
from cablejax.effects.arms import executed_twist
from cablejax.effects.base import Hook
from cablejax.effects.camera import seen_by_camera
from cablejax.effects.physics import Physics, may_touch
from cablejax.simulate.chain.replay import centreline_keypoints, follow
from cablejax.simulate.chain.state import ChainState, chain_nodes, expecting_no_change
from cablejax.simulate.compile import full_precision
from cablejax.simulate.engine import Engine, finely_sampled, rolled_out
from cablejax.simulate.pose import integrate_pose
from cablejax.types import CableMemory, CableState, Trajectory


@dataclasses.dataclass(frozen=True)
class ChainEngine(Engine):
    """A planar cable by the closed-form step of `chain.step`: vmapped, jitted, differentiable in both modes.

    `rollout` and `unroll` are those of `MjxEngine`. States of other engines are accepted as they are; the states that
    this engine returns carry the cable's memory.

    Attributes:
        config: the cable, its resolution and time step.

    Raises:
        ValueError: the cable is not planar.
    """

    config: Discretisation = Discretisation()

    name: ClassVar[str] = "chain"
    data_timestep: ClassVar[float] = 0.05
    hooks: ClassVar[frozenset[Hook]] = frozenset(get_args(Hook))

    def __post_init__(self):
        if self.config.dimension != 2:
            raise ValueError(
                "ChainEngine simulates cables in the plane, but the discretisation has dimension "
                f"{self.config.dimension}. Use MjxEngine or ThreadedEngine for a cable in space."
            )

    def initial_state(self, gripper_pose, *, guess=None) -> CableState:
        """See `Engine`; without plastic bends or internal friction."""
        return self._remembering(super().initial_state(gripper_pose, guess=guess))

    def rollout(self, physics, state, twist, interval=1.0):
        """See `Engine`. Compiles on the first call for a shape and interval."""
        twist, state = jnp.asarray(twist), self._remembering(state)
        self.check_twist(twist)
        return finely_sampled(functools.partial(rolled_out, self), self, physics, state, twist, interval)

    @full_precision
    def unroll(
        self, physics: Physics, state: CableState, twist: Float[Array, "T Q 3"], interval: float = 1.0
    ) -> tuple[CableState, Trajectory]:
        """`rollout` of one cable, uncompiled. Differentiable in `physics`, `state` and `twist`."""
        count, config, contact = self.substeps(interval), self.config, may_touch(physics)
        state = self._remembering(state)
        assert state.memory is not None

        def interval_step(carry, twist):
            chain, pose, time = carry
            target = integrate_pose(pose, twist, interval)
            # a command begins with a jump: the steps before it lead one to expect nothing
            chain = expecting_no_change(chain)
            chain = follow(
                config, physics, chain, pose, target, interval / count, time, n_substeps=count, with_contact=contact
            )
            time = time + interval
            points = centreline_keypoints(config, physics, chain, target[0, :2], time)
            return (chain, target, time), (points, target)

        start, time = _chain_state(state), state.memory.time
        first = centreline_keypoints(config, physics, start, state.gripper_pose[0, :2], time)
        driven = executed_twist(physics, state.gripper_pose, twist, interval)
        # Remember the start of each interval only: reverse mode recomputes the inside.
        final, (points, poses) = jax.lax.scan(jax.checkpoint(interval_step), (start, state.gripper_pose, time), driven)
        trajectory = Trajectory(
            keypoints=seen_by_camera(physics, jnp.concatenate([first[None], points]), interval),
            gripper_pose=jnp.concatenate([state.gripper_pose[None], poses]),
            gripper_twist=twist,
        )
        return _cable_state(*final), trajectory

    @functools.partial(jax.jit, static_argnames="self")
    @full_precision
    def keypoints(self, physics: Physics, state: CableState) -> Float[Array, "*B N 2"]:
        """Keypoints of cables in these states [m], each with its bias. Differentiable in both."""

        def one(physics, state):
            time = state.memory.time
            return centreline_keypoints(self.config, physics, _chain_state(state), state.gripper_pose[0, :2], time)

        state = self._remembering(state)
        return (jax.vmap(one) if state.qpos.ndim > 1 else one)(physics, state)

    @functools.partial(jax.jit, static_argnames="self")
    def opening(self, state: CableState) -> Float[Array, "*B"]:
        """Distance of the cable's end from gripper 1 [m]: more than rounding only where it does not reach that far."""
        memory = self._remembering(state).memory
        assert memory is not None

        def one(qpos, pose, stretch):
            return jnp.linalg.norm(qpos[:2] + chain_nodes(self.config, qpos[2:], stretch)[0][-1] - pose[1, :2])

        return jnp.vectorize(one, signature="(q),(g,p),()->()")(state.qpos, state.gripper_pose, memory.stretch)

    def _remembering(self, state: CableState) -> CableState:
        """The state with a memory: a cable without one has never been bent beyond its limits."""
        if state.memory is not None:
            return state
        batch, dtype = state.qpos.shape[:-1], state.qpos.dtype
        nothing, joints = jnp.zeros(batch, dtype), jnp.zeros((*batch, self.config.n_joints), dtype)
        return dataclasses.replace(state, memory=CableMemory(nothing, nothing, joints, joints, nothing))


def _chain_state(state: CableState) -> ChainState:
    assert state.memory is not None
    velocity = jnp.append(state.qvel[2:], state.memory.stretch_rate)
    return ChainState(
        angles=state.qpos[2:],
        stretch=state.memory.stretch,
        velocity=velocity,
        expected=velocity,
        set_curvature=state.memory.set_curvature,
        friction_state=state.memory.friction_state,
        root_velocity=state.qvel[:2],
        expected_root=state.qvel[:2],
    )


def _cable_state(chain: ChainState, pose: Float[Array, "Q 3"], time: Float[Array, ""]) -> CableState:
    return CableState(
        qpos=jnp.concatenate([pose[0, :2], chain.angles]),
        qvel=jnp.concatenate([chain.root_velocity, chain.velocity[:-1]]),
        gripper_pose=pose,
        memory=CableMemory(chain.stretch, chain.velocity[-1], chain.set_curvature, chain.friction_state, time),
    )
