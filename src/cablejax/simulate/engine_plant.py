"""A simulator behind the plant's two calls, for a closed loop on the very model that is trained on or batched."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cablejax.effects.physics import Physics, nominal_physics
from cablejax.simulate.engine import Engine, refuse_lags
from cablejax.simulate.table_plant import Observation, PlantError, checked
from cablejax.types import CableState, Trajectory


class EnginePlant:
    """One planar cable in an `Engine`: `reset` once, then `record` what commands do to it. See `Plant` for both.

    Unlike `Plant` it shows what it simulates without noise or gaps, and it does not refuse a taut pull.

    Args:
        engine: planar.
        physics: of this cable; by default the nominal ones.

    Raises:
        ValueError: the engine simulates a cable in space, or arms or camera lag.
    """

    def __init__(self, engine: Engine, physics: Physics | None = None):
        if engine.config.dimension != 2:
            raise ValueError(f"The engine's dimension is {engine.config.dimension}, expected 2, a cable on a table.")
        self.engine = engine
        self.physics = nominal_physics(engine.config) if physics is None else physics
        refuse_lags(self.physics)
        self._state: CableState | None = None
        self._time = 0.0

    def reset(
        self, gripper_pose: Float[np.ndarray, "Q 3"], *, guess: Float[np.ndarray, "S 2"] | None = None
    ) -> Observation:
        """A new cable at rest between the grippers, without friction locked in.

        Args:
            gripper_pose: (x, y, theta) of both grippers [m, rad], shape [2, 3].
            guess: points of a similar shape [m], where several shapes fit these grippers.

        Raises:
            ValueError: the grippers are out of the cable's reach.
        """
        self._state, self._time = self.engine.initial_state(gripper_pose, guess=guess), 0.0
        # A rollout begins by showing where it starts; an engine that compiles has this one at hand for `record`.
        _, shown = self.engine.rollout(self.physics, self._state, np.zeros((1, 2, 3)))
        return self._sample(shown, 0)

    def record(self, twist: Float[np.ndarray, "Q 3"], interval: float = 1.0, *, samples: int) -> list[Observation]:
        """Hold a command for one interval and observe the cable `samples` times, evenly spaced, last at its end.

        Raises:
            ValueError: there is no cable yet, the command is not finite, or the samples do not fall on time steps.
            PlantError: the simulation diverged.
        """
        if self._state is None:
            raise ValueError("The plant has no cable yet: call reset(gripper_pose) first.")
        twist = checked("twist", twist)
        if samples < 1:
            raise ValueError(f"samples is {samples}, expected at least 1.")
        observations = []
        for _ in range(samples):
            self._state, shown = self.engine.rollout(self.physics, self._state, twist[None], interval / samples)
            self._time += interval / samples
            observations.append(self._sample(shown, -1))
        if not np.isfinite(observations[-1].keypoints).all():
            self._state = None  # nothing but a reset makes sense now
            raise PlantError(f"The simulation diverged within {self._time:.3f} s: use a shorter timestep.")
        return observations

    def _sample(self, shown: Trajectory, index: int) -> Observation:
        keypoints, pose = (np.asarray(leaf[index], float) for leaf in (shown.keypoints, shown.gripper_pose))
        return Observation(keypoints=keypoints, gripper_pose=pose, time=self._time)
