"""Coordinate frames: the vertical, the handedness, and the consistency of positions and orientations.

The numbers show little of a frame. A hanging cable shows the vertical, so a wrong one is detected. A left-handed frame
is not detectable: mirrored positions, orientations and motions obey the same laws. It has to be stated, and is then
mirrored into a right-handed one. A mixture, positions in one frame and orientations in another, is detected: on a rigid
gripper the direction between two markers does not turn against the gripper, and in a mixture it does.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from cablejax.arrays import quaternion_product
from cablejax.log_setup import LARGEST_TILT, QUATERNIONS, sags_from
from cablejax.poses import rotated, unwrapped
from cablejax.recordings.take import Take

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
"""An axis with its sign."""
AXES: tuple[Axis, ...] = ("x", "y", "z", "-x", "-y", "-z")
"""All six."""

ALONG = np.radians(45)
"""Largest angle between a gripper's x axis and the markers on it."""

FLAT, SLOPE = 0.02, 0.03
"""Height above or below the others that 99 % of the keypoints of a cable on a table keep within [m], and as a share of
how far they extend horizontally: a frame is seldom levelled better."""

RIGID = np.radians(8)
"""Largest root-mean-square angle by which a pair of markers may turn against the gripper that it is on."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """The frame of a recording in space.

    Attributes:
        up: the coordinate axis that points up.
        handedness: "left" for a left-handed frame, as game engines have it.
    """

    up: Axis = "z"
    handedness: Literal["right", "left"] = "right"

    def __post_init__(self):
        if self.up not in AXES:
            raise ValueError(f"The frame's up is {self.up!r}, expected one of {', '.join(AXES)}.")
        if self.handedness not in ("right", "left"):
            raise ValueError(f"The frame's handedness is {self.handedness!r}, expected 'right' or 'left'.")

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Matrix from this frame's coordinates to those of a right-handed frame with z up.

        The coordinates are permuted in cycles until the vertical is last; half a turn about x if it points down; and y
        is mirrored if the frame is left-handed.
        """
        first = {"x": 1, "y": 2, "z": 0}[self.up[-1]]
        matrix = np.eye(3)[[first, (first + 1) % 3, (first + 2) % 3]]
        if self.up.startswith("-"):
            matrix = np.diag([1.0, -1.0, -1.0]) @ matrix
        return np.diag([1.0, -1.0, 1.0]) @ matrix if self.handedness == "left" else matrix


def into_frame(take: Take, frame: Frame) -> Take:
    """The take in a right-handed frame with z up; of a planar take, a left-handed one is mirrored.

    Raises:
        ValueError: an axis other than z is said to be up in the plane of a table.
    """
    pose = take.gripper_pose
    if take.keypoints.shape[2] == 2:
        if frame.up != "z":
            raise ValueError(f"The frame has {frame.up} up, but the keypoints have x and y only: leave `up` out.")
        mirror = np.array([1.0, -1.0, -1.0]) if frame.handedness == "left" else np.ones(3)
        pose = None if pose is None else pose * mirror
        return dataclasses.replace(take, keypoints=take.keypoints * mirror[:2], gripper_pose=pose)
    matrix = frame.matrix
    if pose is not None:
        mirror = np.diag([1.0, np.linalg.det(matrix), 1.0])
        turn = Rotation.from_matrix(mirror @ matrix).as_quat(scalar_first=True)
        # the frame is turned, and the gripper with it: its x axis stays the one along the cable
        turned = quaternion_product(turn, pose[..., 3:])
        # a reflection M turns a rotation about the axis a by an angle into that about -M a by the same angle
        vector = np.linalg.det(mirror) * turned[..., 1:] @ mirror
        pose = np.concatenate([pose[..., :3] @ matrix.T, turned[..., :1], vector], axis=-1)
    return dataclasses.replace(take, keypoints=take.keypoints @ matrix.T, gripper_pose=pose)


def onto_table(takes: tuple[Take, ...]) -> tuple[tuple[Take, ...], list[str]]:
    """Takes in space of a cable that lies on a table, in its plane: without heights, grippers by their angle about z.

    Args:
        takes: in a right-handed frame with z up.

    Returns:
        The takes in the plane, and a sentence on what was left out.

    Raises:
        ValueError: the cable does not lie in a horizontal plane.
    """
    points = np.concatenate([take.keypoints.reshape(-1, 3) for take in takes])
    off = np.abs(points - np.nanmedian(points, axis=0))
    extent = np.nanquantile(off, 0.99, axis=0)
    highest = max(FLAT, SLOPE * float(extent[:2].max()))
    if not extent[2] <= highest:
        raise ValueError(
            f"The layout has a [table], and keypoints lie {1e3 * extent[2]:.3g} mm above or below the others, expected "
            f"at most {1e3 * highest:.3g} mm (99 % of them; along the two horizontal axes they extend "
            f"{1e3 * extent[0]:.3g} and {1e3 * extent[1]:.3g} mm). Check which axis points up, and that it is the "
            "table's normal. For a cable that hangs, leave [table] out of the layout."
        )

    def flat(take: Take) -> Take:
        pose = take.gripper_pose
        if pose is not None:
            along = rotated(pose[..., 3:], np.array([1.0, 0.0, 0.0]))
            angle = unwrapped(np.arctan2(along[..., 1], along[..., 0]))
            pose = np.concatenate([pose[..., :2], angle[..., None]], axis=-1)
        return dataclasses.replace(take, keypoints=take.keypoints[..., :2], gripper_pose=pose)

    height = f"{1e3 * extent[2]:.2g} mm"
    return tuple(map(flat, takes)), [
        f"The cable lies on a table: heights (99 % of them within {height}) were left out."
    ]


def require_hanging(takes: tuple[Take, ...], frame: Frame) -> None:
    """Rejects a frame in which the cable does not hang down.

    Args:
        takes: already in a right-handed frame with z up, of a cable that hangs free.
        frame: as stated, for the message.

    Raises:
        ValueError: names the axis along which the cable hangs.
    """
    above = sags_from(np.concatenate([take.keypoints for take in takes]))
    if above is None or np.arccos(np.clip(above[2], -1, 1)) <= LARGEST_TILT:
        return
    up = frame.matrix.T @ above
    axis = int(np.argmax(abs(up)))
    found = ("" if up[axis] > 0 else "-") + "xyz"[axis]
    raise ValueError(
        f"The frame is stated to have {frame.up} up, but the cable sags in the direction opposite to {found}: state "
        f"that {found} is up, or check the order of the coordinates."
    )


def require_rigid(takes: tuple[Take, ...], pairs: tuple[tuple[int, int], ...]) -> None:
    """Rejects orientations that do not fit the markers on the same gripper.

    Args:
        takes: with measured poses in space.
        pairs: the two keypoints on each gripper.

    Raises:
        ValueError: says by how much they differ, and which convention would fit.
    """
    for gripper, (first, second) in enumerate(pairs):
        seen = _seen(takes, gripper, first, second)
        if seen is None:
            continue
        quaternion, direction = seen
        spread = _in_gripper(quaternion, direction)[1]
        if spread <= RIGID:
            continue
        fitting = [
            name for name, change in _CONVENTIONS.items() if _in_gripper(*change(quaternion, direction))[1] <= RIGID
        ]
        raise ValueError(
            f"The markers {first} and {second} on gripper {gripper} turn against its orientation by "
            f"{np.degrees(spread):.0f} degrees (root mean square), expected at most {np.degrees(RIGID):.0f}: positions "
            "and orientations are not of one frame. "
            + (
                f"They fit if {' or if '.join(fitting)}."
                if fitting
                else "Check which gripper and markers these are. Where only the end keypoint is on the gripper, state "
                'keypoints_on_grippers = "ends".'
            )
        )


def require_along_x(takes: tuple[Take, ...], pairs: tuple[tuple[int, int], ...]) -> None:
    """Rejects grippers whose x axis, which gives the cable's tangent, is not along the two markers on them.

    Args:
        takes: with measured poses in space that fit the markers, see `require_rigid`.
        pairs: the two keypoints on each gripper.

    Raises:
        ValueError: names the axis of the gripper that is nearest to the markers.
    """
    for gripper, (first, second) in enumerate(pairs):
        seen = _seen(takes, gripper, first, second)
        mean = np.array([1.0, 0.0, 0.0]) if seen is None else _in_gripper(*seen)[0]
        if np.arccos(np.clip(mean[0], -1, 1)) <= ALONG:
            continue
        axis = int(np.argmax(np.abs(mean)))
        raise ValueError(
            f"The markers {first} and {second} on gripper {gripper} lie along ({mean[0]:.2f}, {mean[1]:.2f}, "
            f"{mean[2]:.2f}) in its frame, nearest to its {'-' if mean[axis] < 0 else ''}{'xyz'[axis]} axis; expected "
            "x, along the cable from gripper 0 towards gripper 1. Turn the gripper's frame, or give both "
            "in one frame."
        )


def _seen(takes: tuple[Take, ...], gripper: int, first: int, second: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Orientations of a gripper, and the directions of its markers, where both were observed; None without poses."""
    posed = [take for take in takes if take.gripper_pose is not None]
    if not posed:
        return None
    direction = np.concatenate([take.keypoints[:, second] - take.keypoints[:, first] for take in posed])
    quaternion = np.concatenate([pose[:, gripper, 3:] for take in posed if (pose := take.gripper_pose) is not None])
    seen = np.isfinite(direction).all(axis=1) & np.isfinite(quaternion).all(axis=1)
    direction = direction[seen]
    return quaternion[seen], direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def _in_gripper(
    quaternion: Float[np.ndarray, "S 4"], direction: Float[np.ndarray, "S 3"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Mean of a direction in the gripper's own frame, and the root-mean-square angle about it [rad]."""
    own = rotated(_inverse(quaternion), direction)
    mean = own.mean(axis=0)
    mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
    return mean, float(np.sqrt((np.arccos(np.clip(own @ mean, -1, 1)) ** 2).mean()))


def _inverse(quaternion: Float[np.ndarray, "S 4"]) -> Float[np.ndarray, "S 4"]:
    return quaternion * np.array([1.0, -1.0, -1.0, -1.0])


def _mirrored(axis: int):
    sign = np.ones(3)
    sign[axis] = -1
    return lambda quaternion, direction: (quaternion, direction * sign)


def _exchanged(a: int, b: int):
    order = [0, 1, 2]
    order[a], order[b] = b, a
    return lambda quaternion, direction: (quaternion, direction[:, order])


def _reread(read):
    return lambda quaternion, direction: (read(quaternion), direction)


_CONVENTIONS = {
    **{name: _reread(read) for name, read in QUATERNIONS.items()},
    **{
        f"the positions are mirrored along {name}, as from a left-handed frame": _mirrored(k)
        for k, name in enumerate("xyz")
    },
    **{
        f"{'xyz'[a]} and {'xyz'[b]} of the positions are exchanged, as from a left-handed frame": _exchanged(a, b)
        for a, b in itertools.combinations(range(3), 2)
    },
}
