"""The arms of a plant: how they execute commands that arrive one after the other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from cablejax.effects.arms import lag_weights
from cablejax.effects.physics import Physics

_PIECE = 0.005
"""Length of the straight pieces that the executed motion is made of [s]."""


class Arms:
    """Both grippers from one pose on: `effects.arms.executed`, a command at a time and without its future.

    Attributes:
        exact: the arms do as they are commanded.
        commanded: where exact arms with this gain would be at the end of all commands, shape [2, 3].
    """

    def __init__(self, physics: Physics, pose: Float[np.ndarray, "2 3"]):
        self._gain = float(physics.actuation_gain)
        self._delay, self._slow = float(physics.actuation_delay), float(physics.actuation_time)
        self.exact = self._gain == 1.0 and self._delay <= 0.0 and self._slow <= 0.0
        self.commanded = pose.copy()
        self._times, self._poses = [0.0], [pose.copy()]
        self._executed = pose.copy()

    def target(self, twist: Float[np.ndarray, "2 3"], duration: float) -> Float[np.ndarray, "2 3"]:
        """Poses to which this command would bring the arms eventually."""
        return self.commanded + duration * self._gain * twist

    def follow(
        self, twist: Float[np.ndarray, "2 3"], steps: int, timestep: float, *, pieces: bool = False
    ) -> Iterator[tuple[Float[np.ndarray, "2 3"], int]]:
        """Executed twists and the numbers of time steps for which they last, for a command of `steps` time steps.

        Exact arms take a command in one piece, unless short `pieces` are asked for.
        """
        begin = self._times[-1]
        # nothing is asked of what is longer ago than the delay
        old = max(int(np.searchsorted(self._times, begin - self._delay)) - 1, 0)
        del self._times[:old], self._poses[:old]
        self.commanded = self.target(twist, steps * timestep)
        if not self.exact:
            self._times.append(begin + steps * timestep)
            self._poses.append(self.commanded)
        done, piece = 0, steps if self.exact and not pieces else max(1, round(_PIECE / timestep))
        while done < steps:
            count = min(piece, steps - done)
            done += count
            if self.exact:
                yield twist, count
                continue
            duration = count * timestep
            before, after = (self._delayed(begin + k * timestep) for k in (done - count, done))
            keep, first, second = lag_weights(np.float64(self._slow / duration))
            reached = keep * self._executed + first * before + second * after
            yield (reached - self._executed) / duration, count
            self._executed = reached

    def _delayed(self, time: float) -> Float[np.ndarray, "2 3"]:
        """The command that the arms know of at this time, the first pose before they know of any."""
        index = int(np.searchsorted(self._times, time - self._delay))
        if index == 0:
            return self._poses[0]
        last = min(index, len(self._times) - 1)
        begin, end = self._times[last - 1], self._times[last]
        share = min((time - self._delay - begin) / (end - begin), 1.0)
        return self._poses[last - 1] + share * (self._poses[last] - self._poses[last - 1])
