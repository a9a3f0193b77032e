"""Takes: stretches of a recording as readers return them, before checks turn them into episodes of a gap log."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from cablejax.limits import require


@dataclasses.dataclass(frozen=True)
class Take:
    """One uninterrupted stretch of a recording. D is 2 (on a table) or 3.

    Attributes:
        name: what a person calls it, for example the number of its file.
        time: [s], increasing, shape [T].
        keypoints: [m], in the order of the cable, NaN = not observed, shape [T, N, D].
        gripper_pose: measured poses (x, y, theta) or (x, y, z, qw, qx, qy, qz), shape [T, 2, 3 or 7]; None = to be
            found from the two markers on each gripper.
        labels: what else is known of it and travels with the log, for example its split.
    """

    name: str
    time: Float[np.ndarray, " T"]
    keypoints: Float[np.ndarray, "T N D"]
    gripper_pose: Float[np.ndarray, "T 2 P"] | None = None
    labels: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        samples = len(self.time)
        if self.keypoints.ndim != 3 or self.keypoints.shape[0] != samples or self.keypoints.shape[2] not in (2, 3):
            raise ValueError(
                f"Take {self.name}: keypoints has shape {self.keypoints.shape}, expected ({samples}, N, 2 or 3)."
            )
        require_increasing(self.time, lambda row: f"Take {self.name}, sample {row}")
        for name, values in (("keypoints", self.keypoints), ("gripper_pose", self.gripper_pose)):
            sizes = np.zeros(1) if values is None else np.nanmax(np.abs(values), axis=(1, 2), initial=0.0)
            row = int(np.argmax(sizes))
            where = f"Take {self.name}, sample {row}: the largest entry of {name}"
            require(float(sizes[row]), "reading", where, "Not observed is NaN.")
        shape = (samples, 2, 3 if self.keypoints.shape[2] == 2 else 7)
        if self.gripper_pose is not None and self.gripper_pose.shape != shape:
            raise ValueError(
                f"Take {self.name}: gripper_pose has shape {self.gripper_pose.shape}, expected {shape}: two grippers "
                "with x, y, theta in the plane, or x, y, z, qw, qx, qy, qz in space."
            )

    def part(self, samples: slice | Bool[np.ndarray, " T"]) -> Take:
        """Some of the samples, as a take of the same name."""
        pose = None if self.gripper_pose is None else self.gripper_pose[samples]
        return dataclasses.replace(self, time=self.time[samples], keypoints=self.keypoints[samples], gripper_pose=pose)


def require_increasing(
    time: Float[np.ndarray, " T"],
    place: Callable[[int], str],
    advice: str = "Sort the samples and remove those that are there twice.",
) -> None:
    """Rejects times that are not finite or do not increase.

    Args:
        time: of each sample [s].
        place: says where a sample is, for the message.
        advice: what to do, a sentence.

    Raises:
        ValueError: names the first such sample.
    """
    wrong = ~np.isfinite(time)
    wrong[1:] |= ~(np.diff(time) > 0)
    if wrong.any():
        row = int(wrong.argmax())
        before = f" after {time[row - 1]:.15g} s" if row else ""
        raise ValueError(f"{place(row)}: the time is {time[row]:.15g} s{before}, expected increasing times. {advice}")


def spacing(keypoints: Float[np.ndarray, "*B N D"]) -> Float[np.ndarray, "*B M"]:
    """Distances of neighbouring keypoints [m], shape [..., N - 1]."""
    return np.linalg.norm(np.diff(keypoints, axis=-2), axis=-1)


def typical_spacing(takes: tuple[Take, ...]) -> Float[np.ndarray, " M"]:
    """Median distance of each pair of neighbouring keypoints over all samples [m], shape [N - 1].

    Raises:
        ValueError: a keypoint that is never observed together with its neighbour.
    """
    distances = np.concatenate([spacing(take.keypoints) for take in takes])
    seen = np.isfinite(distances).any(axis=0)
    if not seen.all():
        index = int(np.argmin(seen))
        known = [any(np.isfinite(take.keypoints[:, k]).any() for take in takes) for k in (index, index + 1)]
        missing = [f"keypoint {index + k} was never observed" for k in (0, 1) if not known[k]]
        raise ValueError(
            f"Keypoints {index} and {index + 1} are never observed together"
            f"{': ' + ', and '.join(missing) if missing else ''}. Leave out the keypoint that is missing. If it is at "
            "a gripper whose pose was measured, write the gripper's position into the keypoint's columns instead."
        )
    return np.nanmedian(distances, axis=0)


def median_step(points: Float[np.ndarray, "T N D"]) -> Float[np.ndarray, " S"]:
    """Distance that the middle one of the observed keypoints moves from each sample to the next [m], shape [T - 1].

    NaN where none is observed in both.
    """
    step = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    seen = np.isfinite(step).any(axis=1)
    middle = np.full(len(step), np.nan)
    middle[seen] = np.nanmedian(step[seen], axis=1)
    return middle
