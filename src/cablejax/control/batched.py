"""The whole closed loop as one compiled call: many cables, each with its own target, shaped side by side.

Plant (an engine in JAX), model, residual and controller are pure functions, so a table of trials is a
`lax.scan` over control steps of all of them. It runs the same controllers as `control.loop.run_closed_loop`, but a
batch of cables in one call instead of one cable in Python. The plant is the planar simulator here; the contact plant in
C MuJoCo, which the model has never seen, stays the reference.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from cablejax.control.controller import Controller, check_interval, resting
from cablejax.control.run import shape_error_cm
from cablejax.effects.physics import Physics, may_touch, without_obstacle
from cablejax.limits import require
from cablejax.mpc.validation import check_target
from cablejax.simulate.chain.engine import ChainEngine
from cablejax.simulate.compile import AXIS, compiler_options, on_devices
from cablejax.simulate.engine import refuse_lags
from cablejax.simulate.mjx_engine import MjxEngine
from cablejax.types import CableState, Measurement

REPORTED = ("residual_share", "radius")
"""Fields of a controller's report that a run keeps."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BatchRun:
    """B trials of T commands; sample 0 is before the first command. A cable whose simulation diverged is NaN from then.

    Attributes:
        keypoints: of the cables [m], shape [B, T + 1, N, 2].
        gripper_pose: (x, y, theta) [m, rad], shape [B, T + 1, Q, 3].
        twist: commands [m/s, rad/s], shape [B, T, Q, 3].
        error_cm: root mean square distance of the keypoints to the target [cm], shape [B, T + 1].
        residual_share: the controller's report, NaN where it makes none, shape [B, T].
        radius: the controller's bound on one step's motion [m], NaN where it reports none, shape [B, T].
    """

    keypoints: Float[Array, "B T1 N 2"]
    gripper_pose: Float[Array, "B T1 Q 3"]
    twist: Float[Array, "B T Q 3"]
    error_cm: Float[Array, "B T1"]
    residual_share: Float[Array, "B T"]
    radius: Float[Array, "B T"]

    @property
    def terminal_error_cm(self) -> Float[np.ndarray, " B"]:
        """Errors at the end [cm]."""
        return np.asarray(self.error_cm[:, -1])


def for_each_cable(
    step: Callable[..., Any],
    devices: Sequence[jax.Device] | None = None,  # pyright: ignore[reportInvalidTypeForm]
) -> Callable[..., Any]:
    """Maps a function of one cable, such as `MPC.step`, over many cables; to be compiled by `jax.jit`.

    On an accelerator it is `jax.vmap`. A planner's loops then take as many iterations as the slowest cable needs, which
    costs a processor more than the width gives it: there, each device takes one cable after the other.

    Args:
        step: pure function of arrays, or pytrees of them, of one cable.
        devices: to spread the cables over; a call with a number of cables that they cannot share equally raises
            `ValueError`. By default the one on which the arguments are. A processor's cores are devices where
            `jax.config.jax_num_cpu_devices` says so.

    Returns:
        The same function where every argument and result has a leading axis of cables.
    """
    first = jax.devices()[0] if devices is None else devices[0]
    one_by_one = first.platform == "cpu"
    many = (lambda *arguments: jax.lax.map(lambda own: step(*own), arguments)) if one_by_one else jax.vmap(step)
    return many if devices is None else _shared_out(many, tuple(devices), 0)


def _shared_out(function: Callable[..., Any], devices: tuple[jax.Device, ...], whole: int) -> Callable[..., Any]:  # pyright: ignore[reportInvalidTypeForm]
    """A function of a batch on several devices, each with its own share; all have the first `whole` arguments."""

    def shared_out(*arguments):
        if (size := len(jax.tree.leaves(arguments[whole:])[0])) % (n := len(devices)):
            raise ValueError(f"{n} devices cannot share {size} cables equally, expected a multiple of {n} cables.")
        specs = tuple(PartitionSpec() if i < whole else PartitionSpec(AXIS) for i in range(len(arguments)))
        mesh = Mesh(np.array(devices), (AXIS,))
        spread = jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=PartitionSpec(AXIS), check_vma=False)
        return spread(*arguments)

    return shared_out


def shape_batch(
    engine: MjxEngine | ChainEngine,
    params: Physics,
    state: CableState,
    controller: Controller,
    targets: Float[Array | np.ndarray, "B N 2"],
    steps: int,
    *,
    interval: float = 1.0,
    devices: Sequence[jax.Device] | None = None,  # pyright: ignore[reportInvalidTypeForm]
) -> BatchRun:
    """Shapes B cables side by side, in one compiled call; another batch size or configuration compiles again.

    Args:
        engine: the plant, planar.
        params: of each cable, every leaf with a leading axis B.
        state: where each cable starts, likewise: `engine.initial_state` of stacked gripper poses.
        controller: a pytree with a leaf `target`, which is replaced by each trial's own; its other leaves are shared.
        targets: desired keypoints [m], shape [B, N, 2].
        steps: commands of each trial, T.
        interval: time that each command is held [s]; the grippers also rest for one before the first command.
        devices: to spread the batch over; by default the one on which the arguments are.

    Raises:
        ValueError: `steps` is no number of commands, the batch axes differ, the cable is not planar, arms or camera
            lag, the controller was made for another interval, or a target has another number of keypoints or is not
            finite.
    """
    require(steps, "commands", "steps")
    size, chain = len(targets), engine.config
    if chain.dimension != 2 or np.shape(targets) != (size, chain.cable.n_keypoints, 2):
        raise ValueError(
            f"Targets of shape {np.shape(targets)} for a cable with {chain.cable.n_keypoints} keypoints in "
            f"{chain.dimension} dimensions, expected (B, {chain.cable.n_keypoints}, 2) on a planar cable."
        )
    check_target(np.asarray(targets))
    engine.substeps(interval)
    check_interval(controller, interval)
    refuse_lags(params)
    controllers = _with_target(controller, jnp.asarray(targets, float))
    batched = _with_target(jax.tree.map(lambda _: False, controller), True)
    own, shared = eqx.partition(controllers, batched)
    batch = (params, state, own)
    lengths = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(batch)}
    if lengths != {(size,)}:
        raise ValueError(f"The leading axes are {sorted(lengths)}, expected {size}, the number of targets, everywhere.")
    if devices is not None:
        batch = on_devices(batch, devices, -(-size // len(devices)))
        shared = jax.device_put(shared, NamedSharding(Mesh(np.array(devices), (AXIS,)), PartitionSpec()))
    spread_over = None if devices is None else tuple(devices)
    run = _compiled_batch(engine, steps, interval, may_touch(params), spread_over)(shared, *batch)
    return run if devices is None else jax.tree.map(lambda leaf: leaf[:size], run)


def _with_target(controller: Any, target: Any) -> Any:
    """The same pytree with another leaf for its target."""
    return eqx.tree_at(lambda controller: controller.target, controller, target)


@functools.lru_cache(maxsize=16)
def _compiled_batch(engine: MjxEngine | ChainEngine, steps: int, interval: float, touching: bool, devices: Any):
    def trials(shared, params, state, own):
        params = params if touching else without_obstacle(params)
        return _trials(engine, steps, interval, own, shared, params, state)

    spread = trials if devices is None else _shared_out(trials, devices, 1)
    return jax.jit(spread, compiler_options=compiler_options())


def _trials(
    engine: MjxEngine | ChainEngine,
    steps: int,
    interval: float,
    own: Any,
    shared: Any,
    params: Physics,
    cables: CableState,
) -> BatchRun:
    """All trials of a device; a controller is put together of what is its `own` and what is `shared`."""

    def moved(params, cable, twist):
        cable, shown = engine.unroll(params, cable, twist, interval)
        return cable, shown.keypoints[-1]

    def start(own, cable, keypoints):
        controller = eqx.combine(own, shared)
        return controller.init(resting(controller, keypoints, cable.gripper_pose))

    pose = cables.gripper_pose
    cables, first = jax.vmap(moved)(params, cables, jnp.zeros((len(pose), 1, *pose.shape[1:]), cables.qpos.dtype))
    states = jax.vmap(start)(own, cables, first)

    def commanded(own, state, measurement):
        state, twist, info = eqx.combine(own, shared).step(state, measurement)
        return state, twist, [jnp.asarray(getattr(info, name, jnp.nan), twist.dtype) for name in REPORTED]

    command = for_each_cable(commanded)

    def step(carry, _):
        cables, states, keypoints = carry
        states, twist, report = command(own, states, Measurement(keypoints, cables.gripper_pose))
        cables, keypoints = jax.vmap(moved)(params, cables, twist[:, None])
        return (cables, states, keypoints), (keypoints, cables.gripper_pose, twist, *report)

    _, samples = jax.lax.scan(step, (cables, states, first), length=steps)
    later, pose, twist, share, radius = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), samples)
    keypoints = jnp.concatenate([first[:, None], later], axis=1)
    targets = jax.vmap(lambda own: eqx.combine(own, shared).target)(own)
    return BatchRun(
        keypoints=keypoints,
        gripper_pose=jnp.concatenate([cables.gripper_pose[:, None], pose], axis=1),
        twist=twist,
        error_cm=shape_error_cm(keypoints, targets[:, None]),
        residual_share=share,
        radius=radius,
    )
