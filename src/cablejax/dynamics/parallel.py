"""Data-parallel training: all devices hold the same state, and each computes the gradient of its share of a batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from flax import nnx
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from cablejax.dataset.windows import Window
from cablejax.dynamics.train_config import TrainConfig

AXIS = "window"
"""Of devices, over which a batch of windows is spread."""

_Tree = TypeVar("_Tree")


def training_mesh(
    config: TrainConfig,
    devices: Sequence[jax.Device] | None = None,  # pyright: ignore[reportInvalidTypeForm]
) -> Mesh | None:
    """The devices that share the batches of a training, as a mesh of one axis; None for the default device alone.

    Args:
        config: whose batches are shared.
        devices: of this process; all that JAX sees by default.

    Raises:
        ValueError: the batch of a phase cannot be shared equally, or `jax.distributed` has several processes.
    """
    if (count := jax.process_count()) > 1:
        raise ValueError(
            f"This is one of {count} processes of jax.distributed, but a training is one process, which uses its own "
            "devices. Start it alone, without jax.distributed."
        )
    devices = jax.local_devices() if devices is None else list(devices)
    for number, phase in enumerate(config.phases, start=1):
        if phase.batch % len(devices):
            raise ValueError(
                f"Phase {number} of the training has batches of {phase.batch} windows, which {len(devices)} devices "
                f"cannot share equally. Give a batch that is a multiple of {len(devices)} (--batch), or let JAX see "
                "another number of devices (CUDA_VISIBLE_DEVICES on GPUs, JAX_NUM_CPU_DEVICES on processors)."
            )
    return None if devices == jax.local_devices()[:1] else Mesh(np.array(devices), (AXIS,))


def on_all_devices(tree: _Tree, mesh: Mesh | None) -> _Tree:
    """The same arrays whole on every device of the mesh; unchanged without one."""
    return tree if mesh is None else jax.device_put(tree, NamedSharding(mesh, PartitionSpec()))


def on_one_device(tree: _Tree, mesh: Mesh | None) -> _Tree:
    """Undoes `on_all_devices`: arrays on the first device alone, bit for bit; unchanged without a mesh."""
    return tree if mesh is None else jax.device_put(tree, mesh.devices.flat[0])


def loss_and_gradient(
    loss: Callable[[nnx.State, Window], Array], weights: nnx.State, windows: Window, mesh: Mesh | None
) -> tuple[Array, Any]:
    """The loss of a batch and its gradient in the weights, the same on every device; to be called inside `jax.jit`.

    Equal to the result of one device up to rounding: devices add their shares in another order.

    Args:
        loss: mean over the windows that it is given.
        weights: whole on every device.
        windows: the batch, every leaf with a leading axis that is a multiple of the number of devices.
        mesh: from `training_mesh`; None computes it on one device.
    """
    if mesh is None:
        return jax.value_and_grad(loss)(weights, windows)

    def share(weights: nnx.State, windows: Window):
        return jax.lax.pmean(jax.value_and_grad(loss)(weights, windows), AXIS)

    whole, split = PartitionSpec(), PartitionSpec(AXIS)
    return jax.shard_map(share, mesh=mesh, in_specs=(whole, split), out_specs=whole, check_vma=False)(weights, windows)
