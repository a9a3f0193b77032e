"""The one interface of the simulators."""

from __future__ import annotations

import abc

from jaxtyping import ArrayLike, Float

from cablejax.cable import Discretisation
from cablejax.effects.physics import Physics
from cablejax.types import CableState, Trajectory


class Engine(abc.ABC):
    """A simulator of a cable whose two ends are held rigidly by moving grippers.

    Engines are frozen dataclasses: the configuration is the object. All of them take and return the same pytrees, with
    the same meaning of `qpos` and `qvel`.
    """

    config: Discretisation

    @abc.abstractmethod
    def initial_state(
        self, gripper_pose: Float[ArrayLike, "*B Q P"], *, guess: Float[ArrayLike, "*B N D"] | None = None
    ) -> CableState:
        """The cable at rest in static equilibrium, without friction locked in.

        Args:
            gripper_pose: (x, y, theta) in the plane, shape [Q, 3]; (x, y, z, qw, qx, qy, qz) in space, shape [Q, 7].
            guess: keypoints near the wanted equilibrium, for poses with several.
        """

    @abc.abstractmethod
    def rollout(
        self, physics: Physics, state: CableState, twist: Float[ArrayLike, "*B T Q V"], interval: float = 1.0
    ) -> tuple[CableState, Trajectory]:
        """Moves the grippers by T twists, each held for `interval` seconds.

        All arguments carry the same leading batch axis, or none of them does.

        Args:
            physics: physical parameters.
            state: where the cable starts.
            twist: (vx, vy, omega) of each gripper in the world's frame [m/s, rad/s], shape [T, Q, 3]; in space
                (linear, angular), shape [T, Q, 6].
            interval: duration of each command [s], a multiple of the time step.

        Returns:
            The final state and the trajectory of T + 1 samples.
        """

    def substeps(self, interval: float) -> int:
        """Number of time steps in one interval. Raises `ValueError` if that is not a whole number."""
        count = round(interval / self.config.timestep)
        if count < 1 or abs(count * self.config.timestep - interval) > 1e-6 * interval:
            raise ValueError(
                f"The interval is {interval} s, expected a multiple of the time step, {self.config.timestep} s: "
                "change one of them."
            )
        return count

    def check_twist(self, twist) -> None:
        """Raises `ValueError` unless twist has shape [..., T, 2, 3] in the plane or [..., T, 2, 6] in space."""
        width = 3 if self.config.dimension == 2 else 6
        if twist.ndim < 3 or twist.shape[-2:] != (2, width):
            raise ValueError(
                f"The twist has shape {tuple(twist.shape)}, expected (..., T, 2, {width}): two grippers, "
                f"{width} velocities each."
            )
