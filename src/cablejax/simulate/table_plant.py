"""What all plants share: a cable between two grippers, commanded and observed as a robot's would be.

A plant brings its own physics (`reset`, `nodes` and what moves them); checks, clock, sampling and camera noise are
the same for all of them and live here.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Protocol

import numpy as np
from jaxtyping import Float

from cablejax.cable import Cable, Discretisation
from cablejax.simulate.keypoints import hermite_weights

TAUT = 0.999
"""Largest distance between the grippers, in lengths of the cable, before a plant refuses to pull."""


class PlantError(RuntimeError):
    """The simulation of the plant became unstable."""


@dataclasses.dataclass(frozen=True)
class Observation:
    """What a camera over the table and the arms' encoders report at one instant.

    Attributes:
        keypoints: [m], NaN = not observed, float64, shape [N, 2].
        gripper_pose: (x, y, theta) of both grippers [m, rad], shape [Q, 3]; theta counts turns.
        time: since the last reset [s].
        true_keypoints: where they really are [m], shape [N, 2], which only a simulation knows; else None.
    """

    keypoints: Float[np.ndarray, "N 2"]
    gripper_pose: Float[np.ndarray, "Q 3"]
    time: float
    true_keypoints: Float[np.ndarray, "N 2"] | None = None


class ObservedConfig(Protocol):
    """What the configuration of a plant says of its cable and of how that is seen; see `PlantConfig`."""

    @property
    def cable(self) -> Cable: ...

    @property
    def discretisation(self) -> Discretisation: ...

    @property
    def keypoint_noise(self) -> float: ...

    @property
    def keypoint_dropout(self) -> float: ...

    @property
    def seed(self) -> int: ...


class TablePlant(abc.ABC):
    """A cable on a table between two grippers: `reset` once, then `step` it with commands.

    Unlike everything else in the package a plant has a state of its own, as reality does.
    """

    def __init__(self, config: ObservedConfig):
        self.config = config
        self._timestep = config.discretisation.timestep
        self._weights = hermite_weights(config.discretisation)
        self._pose = np.full((2, 3), np.nan)
        self._random = np.random.default_rng(config.seed)
        self._steps_done: int | None = None

    @abc.abstractmethod
    def reset(
        self, gripper_pose: Float[np.ndarray, "Q 3"], *, guess: Float[np.ndarray, "S 2"] | None = None
    ) -> Observation:
        """Lay a new cable on the table, at rest and with no friction locked in, and restart the clock and the noise.

        Args:
            gripper_pose: (x, y, theta) of both grippers [m, rad], shape [2, 3].
            guess: points of a similar shape [m], where several shapes fit these grippers; see `solve_elastica`.

        Raises:
            ValueError: a pose is not finite, of another shape, or the grippers are too far apart; the cable at rest
                between them could not be found.
        """

    @abc.abstractmethod
    def nodes(self) -> tuple[Float[np.ndarray, "n D"], Float[np.ndarray, "n D"]]:
        """Middle of every link, for the two held links the grasped end [m], and the links' unit directions."""

    @abc.abstractmethod
    def _advance(self, twist: np.ndarray, steps: int) -> None:
        """`steps` time steps under one twist; ends with `_moved`."""

    def step(self, twist: Float[np.ndarray, "Q 3"], interval: float = 1.0) -> Observation:
        """Hold a command for one interval and observe the cable at its end.

        Args:
            twist: (vx, vy, omega) of both grippers in the world's frame [m/s, rad/s], shape [2, 3].
            interval: [s], a whole number of time steps.

        Raises:
            ValueError: the command is not finite, of another shape, or would pull the cable taut; the plant has not
                moved then.
            PlantError: the simulation became unstable.
        """
        return self.record(twist, interval, samples=1)[-1]

    def record(self, twist: Float[np.ndarray, "Q 3"], interval: float = 1.0, *, samples: int) -> list[Observation]:
        """As `step`, with `samples` observations evenly spread over the interval, the last one at its end."""
        if self._steps_done is None:
            raise ValueError("The plant has no cable yet: call reset(gripper_pose) first.")
        twist = checked("twist", twist)
        steps = self._steps(interval)
        if samples < 1 or steps % samples:
            raise ValueError(
                f"{samples} samples in {interval} s do not fall on time steps of {self._timestep} s: "
                f"choose a divisor of {steps}."
            )
        self._check_distance(self._pose + interval * twist)
        observations = []
        for _ in range(samples):
            self._advance(twist, steps // samples)
            observations.append(self.observe())
        return observations

    @property
    def time(self) -> float:
        """Simulated seconds since the last reset."""
        return (self._steps_done or 0) * self._timestep

    def observe(self) -> Observation:
        """Keypoints and gripper poses now, with the configured noise and gaps (drawn anew by every call)."""
        config, random = self.config, self._random
        nodes, tangents = self.nodes()
        truth = (self._weights[0] @ nodes + self._weights[1] @ tangents)[:, :2]
        keypoints = truth.copy()
        if config.keypoint_noise:
            keypoints += config.keypoint_noise * random.standard_normal(keypoints.shape)
        if config.keypoint_dropout:
            keypoints[1:-1][random.random(len(keypoints) - 2) < config.keypoint_dropout] = np.nan
        return Observation(keypoints=keypoints, gripper_pose=self._pose.copy(), time=self.time, true_keypoints=truth)

    def _checked_start(self, gripper_pose: np.ndarray) -> np.ndarray:
        """The pose to lay a cable out at, as `reset` takes it."""
        pose = checked("gripper_pose", gripper_pose)
        self._check_distance(pose)
        return pose

    def _restart(self, pose: np.ndarray) -> None:
        """Clock, noise and grippers of a new cable."""
        self._pose, self._steps_done = pose, 0
        self._random = np.random.default_rng(self.config.seed)

    def _moved(self, twist: np.ndarray, steps: int, *, stable: bool) -> None:
        """Takes note of a motion that the physics has made."""
        dt = self._timestep
        self._pose = self._pose + (steps * dt) * twist
        self._steps_done = (self._steps_done or 0) + steps
        if not stable:
            time, self._steps_done = self.time, None  # nothing but a reset makes sense now
            raise PlantError(
                f"The plant's simulation became unstable at {time:.3f} s: use a shorter timestep than {dt} s or "
                "gentler commands."
            )

    def _steps(self, interval: float) -> int:
        steps = round(interval / self._timestep)
        if steps < 1 or abs(steps * self._timestep - interval) > 1e-9:
            raise ValueError(f"{interval} s is not a whole number of time steps of {self._timestep} s.")
        return steps

    def _check_distance(self, pose: np.ndarray) -> None:
        # A twist moves one gripper along a straight line relative to the other, so its end has the largest distance.
        distance, length = np.hypot(*(pose[1, :2] - pose[0, :2])), self.config.cable.length
        if distance > TAUT * length:
            raise ValueError(
                f"The grippers would be {distance:.4g} m apart and pull the cable of {length:.4g} m taut: keep them "
                f"within {TAUT * length:.4g} m."
            )


def checked(name: str, value: np.ndarray) -> np.ndarray:
    """A planar row for each gripper, float64, shape [2, 3].

    Raises:
        ValueError: another shape, or not finite.
    """
    array = np.array(value, dtype=float)
    if array.shape != (2, 3):
        raise ValueError(f"{name} has shape {array.shape}, expected (2, 3): one planar row for each of two grippers.")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} is not finite: {array.tolist()}. Check what produced it; the plant has not moved.")
    return array


def check_camera(config) -> None:
    """Raises ValueError unless `keypoint_noise` and `keypoint_dropout` of a configuration make sense."""
    name, noise, dropout = type(config).__name__, config.keypoint_noise, config.keypoint_dropout
    if not (np.isfinite(noise) and noise >= 0):
        raise ValueError(f"{name}.keypoint_noise is {noise}, expected a finite number >= 0 [m].")
    if not 0 <= dropout < 1:
        raise ValueError(f"{name}.keypoint_dropout is {dropout}, expected a number in [0, 1).")
