"""One log, simulated nominally: the input of a planar diagnosis."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float, Int

from cablejax.arrays import positions_at
from cablejax.cable import Discretisation
from cablejax.cable_file import cable_of_log, config_of_log
from cablejax.diagnose.actuation import Actuation, actuation
from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.evidence import Evidence, repeated_motions
from cablejax.diagnose.log_faults import steadied
from cablejax.diagnose.noise import SMALLEST, NoiseFloor, noise_floor
from cablejax.diagnose.planar import PlanarCable, physics_of
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.protocol import Explanation, explanation
from cablejax.diagnose.recording import DiagnosisError, Recording, prepare
from cablejax.diagnose.regimes import largest_curvature
from cablejax.diagnose.run import weighed
from cablejax.effects import LIBRARY, CableEffect
from cablejax.effects.physics import Physics, nominal_physics
from cablejax.simulate.chain.replay import FINE_STEP, LARGEST_STEP, SETTLING
from cablejax.types import GapLog

FIT_LINKS = 33
"""Links of the cable in fits, which only need what an effect changes."""
FINE_LINKS = 65
"""Links of the nominal cable that the log is compared with."""

_FRAME = 2.0
"""What the origin of a recording is rounded to [lengths of the cable]: no finer than the priors of places are."""
STATED = 0.01
"""Relative error that a cable's stated stiffness and friction may have without being a gap."""
CLAMP_PROBE = 0.003
"""Small error of a clamp's angle [rad]: it moves a usual cable by about what a simulator without effect is off by."""


def calibrated(length: float) -> Calibration:
    """The constants for a cable of this length [m]: they were set on cables of about 1 m, and errors grow with length.

    No error below the least noise is believed.
    """
    return Calibration(baseline=max(Calibration.baseline * length, SMALLEST))


@dataclasses.dataclass(frozen=True)
class Case:
    """A log, replayed by the nominal simulator.

    Attributes:
        log: as it is read, with the cable and table believed in.
        recording: the log after checks and repairs.
        config: the nominal cable at the resolution of the fits.
        effects: that may be at work, as they were given: the simulator's have the cable's size and are where it is.
        arms: how the grippers followed their commands.
        noise: floor of the recording.
        scatter: what was taken from the gripper poses so that they are smooth [m, m, rad], shape [2, 3].
        nominal: keypoints of a fine nominal cable under the measured poses [m], shape [E, T, N, 2].
        simulator: the cable under the measured poses, corrected for the error of discretisation.
        commanded_nominal: as `nominal`, under the poses that exact arms would have had.
        predicted: as `simulator`, under the poses that the arms' effects predict.
    """

    log: GapLog
    recording: Recording
    config: Discretisation
    effects: Sequence[CableEffect]
    arms: Actuation
    noise: NoiseFloor
    scatter: Float[np.ndarray, "2 3"]
    nominal: Float[np.ndarray, "E T N 2"]
    simulator: PlanarCable
    commanded_nominal: Float[np.ndarray, "E T N 2"]
    predicted: PlanarCable

    @classmethod
    def of(cls, log: GapLog, effects: Sequence[CableEffect] = LIBRARY, *, settling: float = SETTLING) -> Case:
        """Checks a log and replays it.

        Args:
            log: of a cable on a table between two grippers.
            effects: that may be at work.
            settling: see `Playback`.

        Raises:
            DiagnosisError: the log cannot be diagnosed; the message says why and what to do.
        """
        recording = prepare(log)
        noise = _noise_of(recording)
        arms = actuation(
            recording.gripper_pose,
            recording.gripper_command if recording.has_commands else None,
            recording.interval,
            recording.length,
            repeated_motions(recording.recorded_pose, recording.interval, log.meta["cable"]["length_m"]),
            recording.commanded,
        )
        pose, scatter = _steadied(recording.gripper_pose, recording, arms)
        recording = dataclasses.replace(recording, gripper_pose=pose)
        config = config_of_log(log, n_links=FIT_LINKS)
        marks = cable_of_log(log).keypoint_arclength
        ends = recording.gripper_pose[:, 0, :, :2]
        first = [
            _at_uniform_marks(shape, marks, held) for shape, held in zip(first_shapes(recording), ends, strict=True)
        ]

        def replay(n_links, step, pose):
            of_links = dataclasses.replace(config, n_links=n_links)
            believed = nominal_physics(of_links, gravity=log.meta["gravity_m_per_s2"], arclength=marks)
            try:
                made = Playback.of_motion(of_links, pose, first, recording.interval, step, believed=believed)
            except ValueError as error:
                raise DiagnosisError(
                    f"The nominal cable does not settle at the first gripper poses of an episode: {error}"
                ) from error
            # the fine cable is replayed once or twice, by a program of its own
            rows = made.rows if n_links == FIT_LINKS else min(made.rows, len(pose))
            return dataclasses.replace(made, length=recording.length, rows=rows, settling=settling)

        def run(playback):
            return playback.keypoints([playback.believed])[0].astype(np.float64)

        playback = replay(FIT_LINKS, LARGEST_STEP, recording.gripper_pose)
        nominal = run(replay(FINE_LINKS, FINE_STEP, recording.gripper_pose))
        if not np.isfinite(nominal).all():
            raise DiagnosisError(
                "The nominal simulation of this log diverges: are the poses continuous, and in metres?"
            )
        seen = np.isfinite(recording.keypoints).any(axis=(1, 2, 3))
        # roughly [m]: the world's origin wherever the grippers are within a length of the cable of it
        frame = _FRAME * config.cable.length
        place = frame * np.round(np.nanmean(recording.gripper_pose[..., :2], axis=(0, 1, 2)) / frame)
        simulator = PlanarCable(
            effects=[effect.sized(config.cable.length).around(place) for effect in effects],
            playback=playback,
            correction=nominal - run(playback),
            duration=float((recording.interval * recording.length)[seen].min()),
            max_curvature=largest_curvature(nominal, marks).max(axis=1),
        )
        moved = arms.deviates
        predicted = replay(FIT_LINKS, LARGEST_STEP, arms.predicted) if moved else playback
        return cls(
            log=log,
            recording=recording,
            config=config,
            effects=effects,
            arms=arms,
            noise=noise,
            scatter=scatter,
            nominal=nominal,
            simulator=simulator,
            commanded_nominal=run(replay(FINE_LINKS, FINE_STEP, arms.commanded)) if moved else nominal,
            predicted=dataclasses.replace(simulator, playback=predicted),
        )

    def evidence(self, calibration: Calibration, growth: Float[np.ndarray, "E"] | None = None) -> Evidence:
        """The log as evidence, weighed by the noise and the simulator's baseline error.

        Args:
            calibration: of the judgement.
            growth: of small errors in each episode, see `growth`; None = on the nominal cable. The simulator may be off
                by as many times more there, and by what stated numbers matter more than usual.
        """
        growth = self.growth(explanation()) if growth is None else growth
        more = np.maximum(self._stated - self._usual(self._stated), 0.0)
        return weighed(
            self.simulator,
            self.recording.keypoints,
            self.nominal,
            self.noise.std[:, None],
            self.motion,
            calibration,
            own_error=np.sqrt((calibration.baseline * growth) ** 2 + more),
        )

    def stated_error(self) -> float:
        """Error of the nominal simulator, per coordinate [m], if stiffness and friction are stated wrong by `STATED`.

        Both errors add up as squares; the median over episodes. Hardly anything for a cable of the usual stiffness, and
        millimetres for a soft rope, which buckles and is held by friction as it lies.
        """
        return float(np.sqrt(self._usual(self._stated)))

    @functools.cached_property
    def _stated(self) -> Float[np.ndarray, "E"]:
        """Squares of `stated_error`, of each episode."""
        believed = self.simulator.playback.believed
        return self._moved_by(
            dataclasses.replace(believed, **{name: getattr(believed, name) * (1 + sign * STATED)})
            for name in ("stiffness", "friction")
            for sign in (-1, 1)
        )

    def growth(self, cause: Explanation) -> Float[np.ndarray, "E"]:
        """How many times more than usual small errors move a cable in each episode, at least 1.

        They do where the cable comes close to snapping over. The small error is one of the clamps' angles.

        Args:
            cause: of the gap: the cable with these effects.
        """
        cable = physics_of(cause, self.simulator.playback.believed, self.config)
        askew = CLAMP_PROBE * np.array([[-1, 0], [1, 0], [0, -1], [0, 1]], np.float32)
        moved = np.sqrt(
            self._moved_by(
                dataclasses.replace(cable, rotation_offset=cable.rotation_offset + angles) for angles in askew
            )
        )
        return np.maximum(moved / max(self._usual(moved), 1e-9), 1.0)

    def _moved_by(self, cables: Iterable[Physics]) -> Float[np.ndarray, "E"]:
        """Mean squares of each episode [m^2] by which changes of a cable move it, together.

        Args:
            cables: pairs of one changed down and one changed up.
        """
        points = self.simulator.playback.keypoints(list(cables))
        pairs = points.astype(np.float64).reshape(-1, 2, *points.shape[1:])
        return self._squares(((pairs[:, 1] - pairs[:, 0]) ** 2).sum(axis=0) / 4)

    def pose_error(self) -> float:
        """Error of the nominal simulator, per coordinate [m], by what is left of the scatter of the gripper poses.

        Of a replay under the smooth poses with the same scatter added and smoothed again; the median over episodes.
        """
        if not self.scatter.any():
            return 0.0
        playback, pose = self.simulator.playback, self.recording.gripper_pose
        drawn = np.random.default_rng(0).standard_normal(pose.shape)
        again, _ = _steadied(pose + self.scatter * drawn, self.recording, self.arms)
        (after,) = dataclasses.replace(playback, gripper_pose=again.astype(np.float32)).keypoints([playback.believed])
        squares = self._squares((after - (self.nominal - self.simulator.correction)) ** 2)
        return float(np.sqrt(self._usual(squares)))

    def _squares(self, squares: Float[np.ndarray, "E T N 2"]) -> Float[np.ndarray, "E"]:
        """Mean square of each episode, where something was seen and nothing broke down."""
        known, axes = np.isfinite(self.recording.keypoints) & np.isfinite(squares), (1, 2, 3)
        return np.where(known, squares, 0.0).sum(axis=axes) / np.maximum(known.sum(axis=axes), 1)

    def _usual(self, values: Float[np.ndarray, "E"]) -> float:
        """Median over the episodes in which something was seen: any other has 0."""
        return float(np.median(values[np.isfinite(self.recording.keypoints).any(axis=(1, 2, 3))]))

    @property
    def motion(self) -> Int[np.ndarray, "E"]:
        """Episodes with the same number repeat one another."""
        return repeated_motions(self.recording.recorded_pose, self.recording.interval, self.config.cable.length)

    def to_log(self, keypoints: Float[np.ndarray, "E T N 2"]) -> Float[np.ndarray, "E T1 N 2"]:
        """Pads an array to the log's length, with NaN beyond each episode's end."""
        return np.where(self.recording.valid[..., None, None], keypoints, np.nan)[:, : self.recording.length.max()]


def _noise_of(recording: Recording) -> NoiseFloor:
    try:
        return noise_floor(recording.keypoints, recording.hold)
    except ValueError as error:
        raise DiagnosisError(str(error)) from error


def _steadied(pose: Float[np.ndarray, "E T 2 3"], recording: Recording, arms: Actuation):
    """As `steadied`, about what the arms make of their commands, where there are any."""
    known = recording.has_commands & recording.commanded
    return steadied(pose, np.where(known[:, None, None, None], arms.predicted, 0.0), recording.length)


def first_shapes(recording: Recording) -> list[np.ndarray | None]:
    """Keypoints at the start of every episode, averaged over its first samples at rest; None where too few are seen."""
    shapes: list[np.ndarray | None] = []
    for points, pose in zip(recording.keypoints, recording.gripper_pose, strict=True):
        moved = np.abs(pose - pose[0]).max(axis=(1, 2)) > 1e-3
        still = points[: max(int(np.argmax(moved)) if moved.any() else len(points), 1)][:10]
        count = np.isfinite(still).sum(axis=0)
        mean = np.where(count > 0, np.nansum(still, axis=0) / np.maximum(count, 1), np.nan)
        shapes.append(mean if np.isfinite(mean).all(axis=1).sum() >= 3 else None)
    return shapes


def _at_uniform_marks(
    keypoints: Float[np.ndarray, "N 2"] | None, marks: Float[np.ndarray, "N"], held: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, "N 2"] | None:
    """Approximate positions of keypoints uniform in arc length, by linear interpolation between the observed ones.

    Ends that are not seen are where they are held.
    """
    if keypoints is None:
        return None
    keypoints = keypoints.copy()
    keypoints[[0, -1]] = np.where(np.isfinite(keypoints[[0, -1]]), keypoints[[0, -1]], held)
    uniform, seen = np.linspace(0.0, marks[-1], len(marks)), np.isfinite(keypoints).all(axis=1)
    return positions_at(uniform, marks[seen], keypoints[seen])
