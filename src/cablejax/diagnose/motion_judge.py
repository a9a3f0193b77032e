"""Judges motions before they are recorded: expected information, and the bounds on grippers and simulated cable."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.information import entropy, mutual_information, parameter_information
from cablejax.diagnose.motion_bounds import SNAP_THROUGH, Bounds, cable_beyond, grippers_beyond
from cablejax.diagnose.planar import physics_of
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.protocol import Explanation, explanation
from cablejax.diagnose.safe_motions import INTERVAL
from cablejax.diagnose.search import Search

CLAMP_ERROR = 0.02
"""Standard deviation of a clamp's angle to its gripper [rad]: on each recording it is another one, and near a
snap-through it decides where the cable goes. Differences that it can make up for do not count."""
STEADY_CLAMP, STEADY_PARAMETER = 0.06, 0.03
"""Largest difference that a clamp turned by `CLAMP_ERROR`, or a parameter's step of forward differences, may make to a
point of the cable, in its lengths. More of it is a snap-through that comes sooner or later, or not at all."""
MARGIN = 0.01
"""Kept by simulated cables from the workspace's edge and from discs [m]: the real one lies elsewhere."""

Objective = Literal["explanations", "parameters"]
"""What a motion is to give information about: which explanation holds, or the parameters of the most probable one."""


@dataclasses.dataclass(frozen=True)
class Judged:
    """One motion, judged.

    Attributes:
        poses: of the grippers every `INTERVAL`, shape [T, 2, 3].
        information: lower bound of what a recording of it is expected to tell [nats]; NaN where it breaks a bound.
        beyond: by how much it breaks each bound; empty if it keeps all.
        keypoints: as the camera would see them under each explanation [m], shape [K, T, N, 2]; None where the grippers
            break a bound, and nothing was simulated.
    """

    poses: Float[np.ndarray, "T 2 3"]
    information: float
    beyond: dict[str, float]
    keypoints: Float[np.ndarray, "K T N 2"] | None = None


@dataclasses.dataclass(frozen=True)
class Judge:
    """The remaining explanations after the recordings so far, and the bounds on a motion.

    Attributes:
        playback: of the recordings; of it the cable and the physics that it is believed to have.
        explanations: that may hold, most probable first.
        chances: their probabilities, shape [K].
        roots: of each explanation, a matrix R whose R R' is the posterior covariance of its coordinates, shape [P, P].
        noise: standard deviation of each keypoint's coordinates [m], shape [N].
        calibration: of how many samples count as one, see `belief`.
        bounds: to keep.
        objective: what information is asked for; of a single explanation it is that about its parameters.
    """

    playback: Playback
    explanations: tuple[Explanation, ...]
    chances: Float[np.ndarray, "K"]
    roots: tuple[Float[np.ndarray, "P P"], ...]
    noise: Float[np.ndarray, "N"]
    calibration: Calibration = Calibration()
    bounds: Bounds = Bounds()
    objective: Objective = "explanations"

    @classmethod
    def of(cls, playback: Playback, found: Search, bounds: Bounds, objective: Objective) -> Judge:
        """The judge after a diagnosis of the playback's motions, with the explanations that `found` leaves open."""
        kept, chances = found.in_doubt()
        roots = tuple(np.linalg.cholesky(np.linalg.inv(fit.precision(found.evidence))) for fit in kept)
        noise = np.broadcast_to(found.evidence.noise, (playback.config.cable.n_keypoints, 1))[:, 0]
        explanations = tuple(fit.explanation for fit in kept)
        return cls(playback, explanations, chances, roots, noise, found.calibration, bounds, objective)

    @property
    def about_parameters(self) -> bool:
        """Whether information is that about the parameters of one explanation."""
        return self.objective == "parameters" or len(self.explanations) < 2

    @property
    def doubt(self) -> float:
        """Entropy of the probabilities [nats]."""
        return entropy(self.chances)

    @property
    def simulations(self) -> int:
        """Simulations for each motion: those of `_asked`, and of either clamp."""
        return len(self._asked()) + 2

    def judged(self, motions: Sequence[Float[np.ndarray, "T 2 3"]]) -> list[Judged]:
        """Judges motions of one length; those whose grippers keep all bounds are simulated together."""
        config = self.playback.config
        result = [Judged(poses, np.nan, grippers_beyond(self.bounds, config, poses, INTERVAL)) for poses in motions]
        alive, playbacks = [], []
        for i, one in enumerate(result):
            if one.beyond:
                continue
            try:
                playbacks.append(Playback.of_motion(config, one.poses[None], None, np.full(1, INTERVAL)))
                alive.append(i)
            except ValueError:
                # no settled start, for example of a first pose that only a cable wound otherwise can have
                result[i] = dataclasses.replace(one, beyond={"reach": 1.0})
        if alive:
            for i, points in zip(alive, self._simulated(playbacks), strict=True):
                result[i] = self._weighed(result[i].poses, points)
        return result

    def _simulated(self, playbacks: Sequence[Playback]) -> Float[np.ndarray, "C X T N 2"]:
        """Keypoints [m] of every motion in the order of `_asked`, then of the first explanation with a clamp turned."""
        together = Playback(
            config=self.playback.config,
            gripper_pose=np.concatenate([one.gripper_pose for one in playbacks]),
            angles=np.concatenate([one.angles for one in playbacks]),
            interval=np.concatenate([one.interval for one in playbacks]),
            believed=self.playback.believed,
        )
        config, believed = self.playback.config, self.playback.believed
        physics = [physics_of(one, believed, config) for one in self._asked()]
        first = physics[1]
        physics += [
            dataclasses.replace(first, rotation_offset=first.rotation_offset + turn)
            for turn in CLAMP_ERROR * np.eye(2, dtype=np.float32)
        ]
        return np.moveaxis(together.keypoints(physics), 0, 1)

    def _asked(self) -> list[Explanation]:
        """The nominal cable; then every explanation, each of its parameters moved, and what its cable really does."""
        asked = [explanation()]
        for one in self.explanations:
            asked += [one, *(one.moved(one.z + step) for step in np.diag(one.differences))]
            if (real := _as_it_is(one)) is not one:
                asked.append(real)
        return asked

    def _weighed(self, poses: Float[np.ndarray, "T 2 3"], points: Float[np.ndarray, "X T N 2"]) -> Judged:
        means, moved, real, begin = [], [], [], 1
        for one in self.explanations:
            end = begin + 1 + len(one.z)
            means.append(points[begin])
            moved.append(points[begin + 1 : end])
            own = _as_it_is(one) is not one
            real.append(points[end] if own else points[begin])
            begin = end + own
        seen, config = np.stack(means).astype(float), self.playback.config
        along = self.playback.arclength
        beyond = cable_beyond(self.bounds, config, poses, np.stack(real), arclength=along, margin=MARGIN)
        length = config.cable.length
        unsteady = np.abs(points[-2:] - points[1]).max() / (STEADY_CLAMP * length)
        for there, mean in zip(moved, seen, strict=True):
            unsteady = max(unsteady, np.abs(there - mean).max(initial=0.0) / (STEADY_PARAMETER * length))
        if unsteady > 1:
            beyond[SNAP_THROUGH] = max(beyond.get(SNAP_THROUGH, 0.0), min(float(unsteady) - 1, 10.0))
        # a simulation that breaks down next door is as little to be relied upon
        if beyond or not np.isfinite(points).all():
            return Judged(poses, np.nan, beyond or {SNAP_THROUGH: 10.0}, seen)
        gaps = ((seen - points[0]) ** 2).mean(axis=(1, 2, 3))
        noise = float(np.sqrt(np.mean(self.noise**2)))
        temper = float(self.calibration.temper(np.sqrt(self.chances @ gaps)[None], noise, seen[0].size)[0])
        scale = 1.0 / (self.noise[:, None] * np.sqrt(temper))
        clamps = ((points[-2:] - points[1]) * scale).reshape(2, -1).astype(float)
        spreads = []
        for one, root, mean, there in zip(self.explanations, self.roots, seen, moved, strict=True):
            slopes = (there - mean) * scale / one.differences.reshape(-1, 1, 1, 1)
            spreads.append(root.T @ slopes.reshape(len(there), mean.size))
        if self.about_parameters:
            information = parameter_information(spreads[0], clamps)
        else:
            whitened = ((seen - seen[:1]) * scale).reshape(len(seen), -1)
            every = [np.concatenate([spread, clamps]) for spread in spreads]
            information = mutual_information(whitened, every, self.chances)
        return Judged(poses, information, {}, seen)


def _as_it_is(one: Explanation) -> Explanation:
    """The explanation without effects of the camera, which sees the cable where it is not; itself if it has none."""
    names = [term.effect.name for term in one.terms if getattr(term.effect, "side", "dynamics") == "observation"]
    return one.without(*names) if names else one
