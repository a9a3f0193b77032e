"""Base of all plants: a cable between two grippers, commanded and observed as a robot's would be.

A plant brings its own physics (`reset`, `nodes` and what moves them); checks, clock, sampling, the arms' and the
camera's effects and camera noise are the same for all of them and live here.
"""

from __future__ import annotations

import abc
import dataclasses

import numpy as np
from jaxtyping import Float

from cablejax.effects.camera import in_camera_frame
from cablejax.effects.physics import Physics
from cablejax.poses import planar_rows
from cablejax.simulate.arms import Arms
from cablejax.simulate.keypoints import hermite_weights, marked_keypoints
from cablejax.simulate.plant_config import ObservedConfig

TAUT = 0.999
"""Largest distance between the grippers, in lengths of the cable, before a plant refuses to pull."""


class PlantError(ValueError):
    """The simulation of the plant became unstable: a motion or effects that it cannot simulate."""


@dataclasses.dataclass(frozen=True)
class Observation:
    """Observation by a camera over the table and the arms' encoders at one instant.

    Attributes:
        keypoints: [m], NaN = not observed, float64, shape [N, 2].
        gripper_pose: executed (x, y, theta) of both grippers [m, rad], shape [Q, 3]; theta counts turns.
        time: since the last reset [s].
        true_keypoints: where they really are [m], shape [N, 2], which only a simulation knows; else None. These are
            the marks on the cable, whatever a camera reports and wherever its markers are stuck.
    """

    keypoints: Float[np.ndarray, "N 2"]
    gripper_pose: Float[np.ndarray, "Q 3"]
    time: float
    true_keypoints: Float[np.ndarray, "N 2"] | None = None


class TablePlant(abc.ABC):
    """A cable on a table between two grippers: `reset` once, then `step` it with commands.

    Unlike everything else in the package a plant has a state of its own, as reality does.
    """

    def __init__(self, config: ObservedConfig):
        self.config = config
        self._take_on(config.physics)
        self._timestep = config.discretisation.timestep
        self._weights = hermite_weights(config.discretisation)
        self._pose = np.full((2, 3), np.nan)
        self._arms = Arms(self._physics, self._pose)
        self._seen: list[tuple[float, Float[np.ndarray, "N 2"]]] = []  # what a late camera has yet to report
        self._random = np.random.default_rng(config.seed)
        self._steps_done: int | None = None

    def _take_on(self, physics: Physics) -> None:
        """The physics from now on."""
        still = np.zeros(self.config.cable.n_keypoints)
        self._physics = physics
        self._unbiased = dataclasses.replace(physics, bias_along=still, bias_across=still)

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
        twist = planar_rows(twist, "twist")
        steps = self.config.discretisation.steps_in(interval)
        if samples < 1 or steps % samples:
            raise ValueError(
                f"{samples} samples in {interval} s do not fall on time steps of {self._timestep} s: "
                f"choose a divisor of {steps}."
            )
        self._check_distance(self._arms.target(twist, interval), self._free_length(self.time + interval))
        late = bool(self._physics.camera_lag > 0)
        observations = []
        for _ in range(samples):
            for executed, count in self._arms.follow(twist, steps // samples, self._timestep, pieces=late):
                self._advance(executed, count)
                if late:
                    self._look()
            observations.append(self.observe())
        return observations

    @property
    def time(self) -> float:
        """Simulated seconds since the last reset."""
        return (self._steps_done or 0) * self._timestep

    def observe(self) -> Observation:
        """Keypoints and gripper poses now, with the configured noise and gaps; every call draws them again."""
        config, random = self.config, self._random
        truth = self._true_keypoints()
        keypoints = in_camera_frame(self._physics, self._look())
        if config.keypoint_noise:
            keypoints += config.keypoint_noise * random.standard_normal(keypoints.shape)
        if config.keypoint_dropout:
            keypoints[1:-1][random.random(len(keypoints) - 2) < config.keypoint_dropout] = np.nan
        return Observation(keypoints=keypoints, gripper_pose=self._pose.copy(), time=self.time, true_keypoints=truth)

    def _slipped(self) -> Float[np.ndarray, "2"] | None:
        """Cable that has come in through either gripper [m]; None where the free length stays as it is."""
        return None

    def _stretch(self) -> float:
        """Relative change of the free length."""
        return 0.0

    def _free_length(self, time: float) -> float:
        """Length of cable between the grippers at a time, not stretched [m]."""
        del time
        return self.config.cable.length

    def _marked(self, physics: Physics) -> Float[np.ndarray, "N 2"]:
        (nodes, tangents), scale = self.nodes(), 1.0 + self._stretch()
        return marked_keypoints(
            self.config.discretisation, physics, nodes[:, :2], tangents[:, :2], scale=scale, slipped=self._slipped()
        )

    def _true_keypoints(self) -> Float[np.ndarray, "N 2"]:
        if self._slipped() is None:
            nodes, tangents = self.nodes()
            return (self._weights[0] @ nodes + self._weights[1] @ tangents)[:, :2]
        return self._marked(self._unbiased)

    def _look(self) -> Float[np.ndarray, "N 2"]:
        """The camera's present report in the world's frame: keypoints at their markers, with its lag."""
        physics, now = self._physics, self.time
        biased = np.any(physics.bias_along) or np.any(physics.bias_across)
        marks = self._marked(physics) if biased else self._true_keypoints()
        then = now - float(physics.camera_lag)
        if then == now:
            return marks
        if not self._seen or self._seen[-1][0] < now:
            self._seen.append((now, marks))
        while len(self._seen) > 2 and self._seen[1][0] <= then:
            del self._seen[0]
        (begin, first), (end, second) = self._seen[0], self._seen[min(1, len(self._seen) - 1)]
        share = np.clip((then - begin) / (end - begin), 0.0, 1.0) if end > begin else 0.0
        return (1.0 - share) * first + share * second

    def _checked_start(self, gripper_pose: np.ndarray) -> np.ndarray:
        """The pose to lay a cable out at, as `reset` takes it."""
        pose = planar_rows(gripper_pose, "gripper_pose")
        self._check_distance(pose, self._free_length(0.0))
        return pose

    def _restart(self, pose: np.ndarray) -> None:
        """Clock, noise and grippers of a new cable."""
        self._pose, self._steps_done = pose, 0
        self._arms, self._seen = Arms(self._physics, pose), []
        self._random = np.random.default_rng(self.config.seed)

    def _moved(self, twist: np.ndarray, steps: int, *, stable: bool) -> None:
        """Takes note of a motion that the physics has made."""
        dt = self._timestep
        self._pose = self._pose + (steps * dt) * twist
        self._steps_done = (self._steps_done or 0) + steps
        if not stable:
            time, self._steps_done = self.time, None  # nothing but a reset makes sense now
            raise PlantError(
                f"The plant's simulation became unstable at {time:.3f} s: try fewer links, a shorter timestep than "
                f"{dt} s, or slower commands."
            )

    def _check_distance(self, pose: np.ndarray, length: float) -> None:
        # A twist moves one gripper along a straight line relative to the other, so its end has the largest distance.
        distance = np.hypot(*(pose[1, :2] - pose[0, :2]))
        if distance > TAUT * length:
            raise ValueError(
                f"The grippers would be {distance:.4g} m apart and pull the cable of {length:.4g} m taut: keep them "
                f"within {TAUT * length:.4g} m."
            )
