"""Spreads one batched engine over several devices, with the same result up to rounding."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from cablejax.cable import Discretisation
from cablejax.simulate.compile import on_devices
from cablejax.simulate.engine import Engine
from cablejax.types import CableState


@dataclasses.dataclass(frozen=True)
class DeviceParallel(Engine):
    """Runs an engine with its batch sharded over devices, always the same number of cables on each.

    The last bits of a compiled batch may depend on its size. So every device gets `per_device` cables, padded by copies
    where the batch is smaller. XLA may still compile another program for another number of devices.

    Attributes:
        engine: compiles itself and follows the sharding of its arguments.
        per_device: cables on each device.
        devices: of this process.
    """

    engine: Engine
    per_device: int
    devices: tuple[jax.Device, ...]  # pyright: ignore[reportInvalidTypeForm]

    @property
    def config(self) -> Discretisation:
        """The simulated cable."""
        return self.engine.config

    @property
    def width(self) -> int:
        """Cables on all devices together."""
        return self.per_device * len(self.devices)

    def initial_state(self, gripper_pose, *, guess=None) -> CableState:
        """The engine's initial state."""
        return self.engine.initial_state(gripper_pose, guess=guess)

    def rollout(self, params, state, twist, interval=1.0):
        """The engine's rollout, for a batch of up to `per_device` times the number of devices; returns NumPy arrays.

        Raises:
            ValueError: the batch is larger than that.
        """
        size, width = np.shape(twist)[0], self.width
        if not 0 < size <= width:
            raise ValueError(f"The batch has {size} cables, expected 1 to {width}: {self.per_device} on each device.")
        result = self.engine.rollout(*on_devices((params, state, twist), self.devices, self.per_device), interval)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[:size], result)
