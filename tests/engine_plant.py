"""A simulator behind the plant's two calls, for a closed loop on the very model that is batched."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cablejax.effects.physics import Physics, nominal_physics
from cablejax.simulate.engine import Engine, refuse_lags
from cablejax.simulate.table_plant import Observation
from cablejax.types import CableState, Trajectory


class EnginePlant:
    """One planar cable in an `Engine`, observed without noise or gaps. See `Plant` for both calls.

    Args:
        engine: planar.
        physics: of this cable; by default the nominal ones.

    Raises:
        ValueError: the engine simulates a cable in space, or arms or camera lag.
    """

    def __init__(self, engine: Engine, physics: Physics | None = None):
        self.engine = engine
        self.physics = nominal_physics(engine.config) if physics is None else physics
        refuse_lags(self.physics)
        self._state: CableState | None = None
        self._time = 0.0

    def reset(
        self, gripper_pose: Float[np.ndarray, "Q 3"], *, guess: Float[np.ndarray, "S 2"] | None = None
    ) -> Observation:
        """A new cable at rest between the grippers."""
        self._state, self._time = self.engine.initial_state(gripper_pose, guess=guess), 0.0
        # A rollout begins by showing where it starts; an engine that compiles has this one at hand for `record`.
        _, shown = self.engine.rollout(self.physics, self._state, np.zeros((1, 2, 3)))
        return self._sample(shown, 0)

    def record(self, twist: Float[np.ndarray, "Q 3"], interval: float = 1.0, *, samples: int) -> list[Observation]:
        """Holds a command for one interval; `samples` observations, evenly spaced, the last at its end."""
        assert self._state is not None, "call reset first"
        observations = []
        for _ in range(samples):
            self._state, shown = self.engine.rollout(self.physics, self._state, twist[None], interval / samples)
            self._time += interval / samples
            observations.append(self._sample(shown, -1))
        return observations

    def _sample(self, shown: Trajectory, index: int) -> Observation:
        keypoints, pose = (np.asarray(leaf[index], float) for leaf in (shown.keypoints, shown.gripper_pose))
        return Observation(keypoints=keypoints, gripper_pose=pose, time=self._time)
