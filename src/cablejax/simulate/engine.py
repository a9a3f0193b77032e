"""The common interface of the simulators, and code that all of them share."""

from __future__ import annotations

import abc
import dataclasses
import functools
import math
import warnings
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from cablejax.cable import Discretisation
from cablejax.effects.base import Hook
from cablejax.effects.physics import Physics, may_touch, without_obstacle
from cablejax.simulate.compile import compiler_options
from cablejax.simulate.equilibrium import equilibrium_state
from cablejax.types import CableState, Trajectory

_FINE_SAMPLE = 0.1
"""Interval of the samples between which arms and camera with a lag move linearly [s]."""
_TAUT = 1e-4
"""Grippers are that near to the cable's length, relative to it, where it is taut."""
_LAGS = ("actuation_time", "actuation_delay", "camera_lag")
_SETTLING = 3.0
"""For how long a new cable lies between resting grippers before it counts as settled [s]."""


class Engine(abc.ABC):
    """A simulator of a cable whose two ends are held rigidly by moving grippers.

    Engines are frozen dataclasses: the configuration is the object. All of them take and return the same pytrees, with
    the same meaning of `qpos` and `qvel`.

    Attributes:
        config: the cable, its resolution and time step.
        name: of the engine in configurations and messages.
        hooks: through which effects act on this engine, on a table; other fields of `Physics` must be at their null
            values, and in space all but stiffness, rest curvature, damping and density.
        data_timestep: time step [s] at which it makes data; all are about as accurate at theirs.
    """

    config: Discretisation
    name: ClassVar[str]
    hooks: ClassVar[frozenset[Hook]]
    data_timestep: ClassVar[float] = 0.02

    def initial_state(
        self, gripper_pose: Float[ArrayLike, "*B Q P"], *, guess: Float[ArrayLike, "*B N D"] | None = None
    ) -> CableState:
        """The cable at rest in static equilibrium, without friction locked in; in space, before gravity acts.

        It is sought by a solver outside of JAX: poses are numbers, not traced within `jit` or `grad`. Differentiate a
        rollout by the state that this returns.

        Args:
            gripper_pose: (x, y, theta) in the plane, shape [Q, 3]; (x, y, z, qw, qx, qy, qz) in space, shape [Q, 7].
            guess: keypoints near the wanted equilibrium, for poses with several.
        """
        return equilibrium_state(self.config, gripper_pose, guess=guess)

    @abc.abstractmethod
    def rollout(
        self, physics: Physics, state: CableState, twist: Float[ArrayLike, "*B T Q V"], interval: float = 1.0
    ) -> tuple[CableState, Trajectory]:
        """Moves the grippers by T twists, each held for `interval` seconds.

        A taut cable has none: pulled, it does not move; pushed, it buckles; and small errors of its length jerk it.

        All arguments carry the same leading batch axis, or none of them does. Arms that lag and a camera that lags
        begin at rest, whatever was before `state`.

        Where a caller's `jit` or `grad` traces the physics, a lag may not be zero, and commands are simulated in parts
        of a tenth of a second: keypoints then differ by some micrometres from those outside of it.

        Args:
            physics: physical parameters.
            state: where the cable starts.
            twist: (vx, vy, omega) of each gripper in the world's frame [m/s, rad/s], shape [T, Q, 3]; in space
                (linear, angular), shape [T, Q, 6].
            interval: duration of each command [s], a multiple of the time step.

        Returns:
            The final state and the trajectory of T + 1 samples.
        """

    def settled(self, physics: Physics, state: CableState, interval: float = 1.0) -> CableState:
        """A cable on a table, laid out as in `state`, once it lies as its effects and the friction leave it.

        `initial_state` is that of the nominal cable: without this, the first command would carry the jump to the shape
        in which a cable of another rest curvature, or in clamps that are askew, lies.

        Args:
            physics: as of `rollout`. Nothing slips and no arm moves before the first command.
            state: where the cable is laid.
            interval: any duration of commands [s], a multiple of the time step: it lies for whole ones, 3 s or more.
        """
        count = math.ceil(_SETTLING / interval)
        # NumPy: known to be zero, also where a caller traces the physics
        idle = {name: np.zeros(np.shape(getattr(physics, name)), np.float32) for name in ("slip", *_LAGS)}
        still = np.zeros((*state.gripper_pose.shape[:-2], count, 2, 3 if self.config.dimension == 2 else 6))
        rested = self.rollout(dataclasses.replace(physics, **idle), state, still, interval)[0]
        memory = rested.memory
        if memory is not None:
            zero = jnp.zeros_like(memory.time)
            memory = dataclasses.replace(memory, time=zero, stretch_rate=zero)
        return dataclasses.replace(rested, qvel=jnp.zeros_like(rested.qvel), memory=memory)

    def substeps(self, interval: float) -> int:
        """See `Discretisation.steps_in`."""
        return self.config.steps_in(interval)

    def check_twist(self, twist) -> None:
        """Raises `ValueError` unless twist has shape [..., T, 2, 3] in the plane or [..., T, 2, 6] in space."""
        width = 3 if self.config.dimension == 2 else 6
        if twist.ndim < 3 or twist.shape[-2:] != (2, width):
            raise ValueError(
                f"The twist has shape {tuple(twist.shape)}, expected (..., T, 2, {width}): two grippers, "
                f"{width} velocities each."
            )


def finely_sampled(
    run: Callable[..., tuple[CableState, Trajectory]],
    engine: Engine,
    physics: Physics,
    state: CableState,
    twist: Any,
    interval: float,
) -> tuple[CableState, Trajectory]:
    """Calls `run(physics, state, twist, interval)`, with commands split into parts where arms or camera lag.

    Between samples a lagging arm's path and the keypoints are taken as linear, so a lag needs samples nearer to each
    other than commands of a second. The trajectory has its samples at the commands, the gripper's poses as they were,
    and its twists as they were commanded.
    """
    parts = _parts(engine, physics, interval)
    _warn_if_taut(engine, physics, state, twist, interval)
    if parts == 1:
        return run(physics, state, twist, float(interval))
    xp = twist.__array_namespace__()
    final, fine = run(physics, state, xp.repeat(twist, parts, axis=-3), float(interval) / parts)
    keypoints, pose = fine.keypoints[..., ::parts, :, :], fine.gripper_pose[..., ::parts, :, :]
    return final, dataclasses.replace(fine, keypoints=keypoints, gripper_pose=pose, gripper_twist=jnp.asarray(twist))


def _warn_if_taut(engine: Engine, physics: Physics, state: CableState, twist: Any, interval: float) -> None:
    """Warns where the grippers are commanded further apart than the cable is long, unless it can stretch or slip."""
    # under `jax.grad` and the like the values are known all the same
    inputs = jax.lax.stop_gradient(
        (state.gripper_pose, twist, physics.actuation_gain, physics.axial_compliance, physics.slip)
    )
    if any(isinstance(x, jax.core.Tracer) for x in inputs) or any(np.any(np.asarray(x) != 0) for x in inputs[3:]):
        return
    pose, moved = (np.asarray(x)[..., :3] for x in inputs[:2])
    if not moved.size:
        return
    apart = np.cumsum(moved[..., 1, :] - moved[..., 0, :], axis=-2)
    gain = np.asarray(inputs[2])[..., None, None]
    chord = (pose[..., 1, :] - pose[..., 0, :])[..., None, :] + interval * gain * apart
    reach = np.linalg.norm(chord[..., : engine.config.dimension], axis=-1).max()
    if reach > engine.config.cable.length * (1 - _TAUT):
        warnings.warn(
            f"The grippers are driven {reach:.4f} m apart but the cable is {engine.config.cable.length:g} m long: "
            "it is taut, or its ends leave the grippers, so its motion and derivatives are meaningless. Bring the "
            "grippers closer.",
            stacklevel=4,
        )


def refuse_lags(physics: Physics) -> None:
    """Raises `ValueError` if arms or camera lag: in a closed loop every rollout would forget what went before."""
    lags = {name: getattr(physics, name) for name in _LAGS}
    late = [f"{name} {np.max(np.asarray(lag)):g} s" for name, lag in lags.items() if np.any(np.asarray(lag) > 0)]
    if late:
        raise ValueError(
            f"The physics has {', '.join(late)}. An engine's rollouts begin with arms and camera at rest, so it cannot "
            "simulate a lag command by command: leave the effect out, or use a plant that has it."
        )


def _parts(engine: Engine, physics: Physics, interval: float) -> int:
    """Into how many parts a command is split: whole numbers of time steps, each about `_FINE_SAMPLE` long."""
    count = engine.substeps(interval)
    lags = [getattr(physics, name) for name in _LAGS]
    if not any(isinstance(lag, jax.core.Tracer) or np.any(np.asarray(lag) > 0) for lag in lags):
        return 1
    wanted = min(max(round(interval / _FINE_SAMPLE), 1), count)
    return next(parts for parts in range(wanted, count + 1) if count % parts == 0)


def compiled_rollout(engine: Any, physics: Physics, batch_axes: int, interval: float) -> Any:
    """`engine.unroll` vmapped and jitted, for physics like this one: contacts cost nothing where no obstacle is."""
    return _compiled(engine, batch_axes, interval, may_touch(physics))[1]


def rolled_out(engine: Any, physics: Physics, state: Any, twist: Any, interval: float) -> Any:
    """A rollout by `compiled_rollout`.

    Within a caller's `jax.jit` or `jax.grad` it is part of that program, whose compiler options then hold.
    """
    function, compiled = _compiled(engine, twist.ndim - 3, interval, may_touch(physics))
    try:
        return compiled(physics, state, twist)
    except ValueError as error:
        if "can only be passed to top-level" not in str(error):
            raise
        return function(physics, state, twist)


@functools.lru_cache(maxsize=32)
def _compiled(engine: Any, batch_axes: int, interval: float, touching: bool):
    def function(physics, state, twist):
        return engine.unroll(physics if touching else without_obstacle(physics), state, twist, interval)

    for _ in range(batch_axes):
        function = jax.vmap(function)
    return function, jax.jit(function, compiler_options=compiler_options())
