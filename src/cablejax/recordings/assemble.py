"""Assembles a gap log from checked takes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from cablejax.cable import Cable
from cablejax.cable_length import coordinate_noise, require_fitting_length
from cablejax.gaplog import Episode, gap_log_from_episodes
from cablejax.gaplog_join import COMMANDS_DERIVED
from cablejax.log_setup import setup_fault
from cablejax.poses import twists
from cablejax.recordings.take import Take, typical_spacing
from cablejax.types import GapLog

_MOST_SAMPLES = 1000
_PER_SEGMENT = 12


@dataclasses.dataclass(frozen=True)
class Nominal:
    """The stated or guessed values of a cable, for the nominal simulator.

    Attributes:
        diameter: [m].
        linear_density: [kg/m].
        bending_stiffness: EI [N m^2].
        damping_time: [s].
        friction_coefficient: of the table; None = the cable hangs free.
        arclength: of each keypoint [m], starting at 0, shape [N]; None = measured along the keypoints.
        guessed: which of the values are guesses, by their names in the log's `cable`; kept in its `meta`.
    """

    diameter: float
    linear_density: float
    bending_stiffness: float
    damping_time: float = 0.0
    friction_coefficient: float | None = None
    arclength: tuple[float, ...] | None = None
    guessed: tuple[str, ...] = ()

    @property
    def stiffness_over_density(self) -> float:
        """EI / rho [m^4/s^2], all that the motion of a hanging cable depends on."""
        return self.bending_stiffness / self.linear_density


def gap_log_from_takes(
    takes: Sequence[Take], nominal: Nominal, *, source: str, repairs: Sequence[str] = (), measured: bool = False
) -> GapLog:
    """One gap log with an episode per take, with the labels of the takes as further fields of `meta`.

    `gripper_command` is the twist that carries each measured pose to the next, since the recording holds no commands;
    `meta` says so by `commands_from_poses`, and by `arclength_measured` whether the arc lengths were measured too.
    `hold` is left out: nobody said when the grippers rested.

    Args:
        takes: as `prepare` yields them.
        nominal: what is believed of the cable.
        source: where the recording is from, and which values are guesses.
        repairs: sentences on the changes, for the log's source.
        measured: whether the poses are not those of two markers, and so show how the grippers roll: `roll_observed`.

    Raises:
        ValueError: takes or values that make no gap log, a cable shorter than its keypoints are apart, or grippers that
            do not hold it.
    """
    points = takes[0].keypoints.shape[1]
    if takes[0].keypoints.shape[2] == 2 and nominal.friction_coefficient is None:
        raise ValueError(
            "The keypoints are in the plane, of a cable that lies on a table, but the table's friction coefficient is "
            "missing: add it ([table] friction_coefficient), or give the third coordinate if the cable hangs."
        )
    arclength = measured_arclength(takes) if nominal.arclength is None else np.asarray(nominal.arclength, float)
    if arclength.shape != (points,) or arclength[0] != 0 or (np.diff(arclength) <= 0).any():
        raise ValueError(
            f"The arc lengths of the keypoints are {arclength.tolist()}, expected {points} increasing numbers from 0."
        )
    require_fitting_length([take.keypoints for take in takes], arclength, "keypoint_arclength_m")
    cable = Cable(
        length=float(arclength[-1]),
        diameter=nominal.diameter,
        n_keypoints=points,
        bending_stiffness=nominal.bending_stiffness,
        damping_time=nominal.damping_time,
        linear_density=nominal.linear_density,
        friction_coefficient=nominal.friction_coefficient or 0.0,
        marks=tuple(arclength.tolist()),
    )
    episodes = []
    for take in takes:
        assert take.gripper_pose is not None
        time = take.time - take.time[0]
        episodes.append(
            Episode(
                motion=str(take.labels.get("motion", "recorded")),
                time=time,
                keypoints=take.keypoints,
                gripper_pose=take.gripper_pose,
                gripper_command=twists(time, take.gripper_pose),
                hold=np.zeros(len(time), bool),
            )
        )
    names = [name for name in takes[0].labels if name != "motion"]
    log = gap_log_from_episodes(
        episodes,
        cable,
        source=" ".join([source, *repairs]),
        extra={
            "take": [take.name for take in takes],
            COMMANDS_DERIVED: True,
            "arclength_measured": nominal.arclength is None,
            "roll_observed": measured,
            **({"guessed": list(nominal.guessed)} if nominal.guessed else {}),
            **{name: [take.labels[name] for take in takes] for name in names},
        },
    )
    if fault := setup_fault(log):
        raise ValueError(fault)
    return dataclasses.replace(log, hold=None)


def measured_arclength(takes: Sequence[Take]) -> Float[np.ndarray, " N"]:
    """Arc length of each keypoint [m], along a smooth curve through the keypoints: the median over samples.

    A cubic spline in the usual distance along the keypoints. It undoes what a straight line from one keypoint to the
    next cuts short, about `(kappa h)^2 / 24` of a spacing h at curvature kappa: a hundredth of the length where markers
    are 0.1 m apart on a bend of 0.2 m radius. What noise adds to the curve's length is subtracted.
    """
    usual = typical_spacing(tuple(takes))
    knots = np.concatenate([[0.0], np.cumsum(usual)])
    points = np.concatenate([take.keypoints for take in takes])
    points = points[np.isfinite(points).all(axis=(1, 2))]
    if len(points) == 0 or len(knots) < 4:
        return knots
    points = points[:: max(1, len(points) // _MOST_SAMPLES)]
    pieces = [np.linspace(a, b, _PER_SEGMENT, endpoint=False) for a, b in itertools.pairwise(knots)]
    fine = np.concatenate([*pieces, knots[-1:]])
    # steps along the curve, linear in the keypoints
    weights = np.diff(CubicSpline(knots, np.eye(len(knots)))(fine), axis=0)
    steps = np.linalg.norm(np.einsum("fn,tnd->tfd", weights, points), axis=-1)
    # noise across a step lengthens it
    variance = coordinate_noise([take.keypoints for take in takes]) ** 2 * (weights**2).sum(axis=1)
    steps -= 0.5 * (points.shape[-1] - 1) * variance / np.diff(fine)
    arcs = steps.reshape(len(points), len(usual), _PER_SEGMENT).sum(axis=-1)
    return np.concatenate([[0.0], np.cumsum(np.median(arcs, axis=0))])
