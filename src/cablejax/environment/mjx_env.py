"""The environment with the interface of MuJoCo Playground's `MjxEnv`: pure functions that a learner compiles.

Playground's wrappers and Brax's learners take it as it is. Neither of them is needed, or imported, here.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from cablejax.control.run import shape_error_cm
from cablejax.control.targets import straight_start
from cablejax.dataset.drawing import cable_params, draw_parameters
from cablejax.dataset.schema import Randomisation
from cablejax.effects.camera import without_bias
from cablejax.effects.physics import Physics, may_touch, without_obstacle
from cablejax.environment.config import ShapeCableConfig, require_config
from cablejax.simulate.chain.engine import ChainEngine
from cablejax.simulate.mjx import mjx
from cablejax.simulate.mjx_engine import MjxEngine
from cablejax.types import CableState


@struct.dataclass
class State:
    """State of one environment; batches are made by `jax.vmap`.

    Attributes:
        data: the cable, with `qpos` and `qvel` of `MjxShapeCable.mj_model`.
        obs: keypoints, gripper poses and target [m, rad], one after the other, shape [4 N + 6].
        reward: minus the error, shape [].
        done: 1 where the target is reached or the simulation has diverged, else 0, shape [].
        metrics: "error", the root mean square distance of the true keypoints to the target [lengths of the cable].
        info: "physics" and "target" [m] of the episode, "rng" of the noise, and "executed_action", shape [6]: the last
            action after its limits, 0 where it was not executed and after a reset. What wrappers add is kept.
    """

    data: CableState
    obs: Float[Array, " O"]
    reward: Float[Array, ""]
    done: Float[Array, ""]
    metrics: dict[str, Array]
    info: dict[str, Any]


class MjxShapeCable:
    """`cablejax/ShapeCable-v0` as an `MjxEnv`: the same cable, limits, observations and rewards, as functions of JAX.

    Time limits are the learner's: its wrapper truncates an episode, for which `config.steps` is the usual length.

    Args:
        config: as of `ShapeCableEnv`. Parameters and targets are drawn by `reset`.
    """

    def __init__(self, config: ShapeCableConfig = ShapeCableConfig()):
        require_config(config)
        self.config = config
        self._engine, self._recipe = ChainEngine(config.discretisation), config.recipe(config.effects)
        nominal = draw_parameters(
            dataclasses.replace(self._recipe, randomisation=Randomisation()), np.random.default_rng(0)
        )
        ranges = config.randomisation
        spread = np.log([limits or (1.0, 1.0) for limits in (ranges.stiffness, ranges.friction, ranges.damping)])
        self._nominal, self._spread = nominal, spread.astype(np.float32).T
        self._targets = np.stack([config.target(target).keypoints for target in config.targets]).astype(np.float32)
        self._laid = self._engine.initial_state(straight_start(config.cable))
        self._obstacle = may_touch(cable_params(self._recipe, nominal))

    def reset(self, rng: Array) -> State:
        """A straight cable with parameters and a target drawn by a key of `jax.random`. Compiles with `jax.jit`."""
        rng, parameters, choice = jax.random.split(rng, 3)
        low, high = self._spread
        factors = jnp.exp(jax.random.uniform(parameters, (3,), minval=low, maxval=high))
        physics = jax.tree.map(jnp.asarray, cable_params(self._recipe, self._nominal * factors))
        target = jnp.asarray(self._targets)[jax.random.randint(choice, (), 0, len(self._targets))]
        start, zero = self._laid, jnp.zeros(())
        if self._recipe.effects:
            rested = self._engine.settled(self._known(physics), start, self.config.interval)
            # one that diverges there ends its episode with its first action
            sound = jnp.isfinite(rested.qpos).all()
            start = jax.tree.map(lambda new, old: jnp.where(sound, new, old), rested, start)
        true = self._engine.keypoints(without_bias(physics), start)
        seen, _ = self._moved(physics, start, jnp.zeros((2, 3)))[1]
        rng, obs, error = self._observed(rng, true, seen, start, target)
        info = {"rng": rng, "physics": physics, "target": target, "executed_action": jnp.zeros(6, jnp.float32)}
        return State(start, obs, zero, zero, {"error": error}, info)

    def step(self, state: State, action: Float[Array, " 6"]) -> State:
        """One action, both grippers' twists as one vector in units of `speed` and `turn_rate`, cut off at 1.

        See `Cables.step`. A cable that diverges stays where it was, and its episode is done.
        """
        config, info, before = self.config, state.info, state.data
        twist = config.twist(jnp.asarray(action, jnp.float32).reshape(2, 3), before.gripper_pose)
        after, (_, seen) = self._moved(info["physics"], before, twist)
        true, diverged, torn = config.outcome(self._engine, info["physics"], before, after)
        sound = ~diverged & ~torn
        data = jax.tree.map(lambda new, old: jnp.where(sound, new, old), after, before)
        executed = jnp.where(sound, (twist / config.scale).ravel(), 0.0)
        rng, obs, error = self._observed(info["rng"], true, seen, data, info["target"])
        obs, error = jnp.where(sound, obs, state.obs), jnp.where(sound, error, state.metrics["error"])
        done = ((error <= config.tolerance) | diverged).astype(jnp.float32)
        return dataclasses.replace(
            state,
            data=data,
            obs=obs,
            reward=-error,
            done=done,
            metrics={**state.metrics, "error": error},
            info={**info, "rng": rng, "executed_action": executed.astype(jnp.float32)},
        )

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        return 4 * self.config.cable.n_keypoints + 6

    @property
    def action_size(self) -> int:
        """Numbers in an action: (vx, vy, omega) of both grippers."""
        return 6

    @property
    def dt(self) -> float:
        """Time for which an action is held [s]."""
        return self.config.interval

    @property
    def sim_dt(self) -> float:
        """The simulator's time step [s]."""
        return self.config.discretisation.timestep

    @property
    def n_substeps(self) -> int:
        """Time steps in one action."""
        return self._engine.substeps(self.dt)

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """MuJoCo's model of the bare chain, to pose and render: the step itself is that of `ChainEngine`."""
        return MjxEngine(self.config.discretisation).mj_model

    @functools.cached_property
    def mjx_model(self) -> mjx.Model:
        """`mj_model` for MJX."""
        return mjx.put_model(self.mj_model)

    @property
    def xml_path(self) -> str:
        """Empty: the model is made from `config`, not from a file."""
        return ""

    @property
    def unwrapped(self) -> MjxShapeCable:
        """This environment."""
        return self

    def _known(self, physics: Physics) -> Physics:
        return physics if self._obstacle else without_obstacle(physics)

    def _moved(self, physics: Physics, data: CableState, twist: Float[Array, "2 3"]):
        """The cable after a twist, and its keypoints as they are seen before and after, shape [2, N, 2]."""
        data, shown = self._engine.unroll(self._known(physics), data, twist[None], self.config.interval)
        return data, shown.keypoints

    def _observed(self, rng: Array, true: Array, keypoints: Array, data: CableState, target: Array):
        """The next key, an observation of the seen keypoints [N, 2], and the error of the true ones to the target."""
        error = shape_error_cm(true, target) / (100.0 * self.config.cable.length)
        if noise := self.config.keypoint_noise:
            rng, own = jax.random.split(rng)
            keypoints = keypoints + noise * jax.random.normal(own, keypoints.shape)
        return rng, jnp.concatenate([keypoints.ravel(), data.gripper_pose.ravel(), target.ravel()]), error
