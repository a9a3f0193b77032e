"""One closed-loop run as the report shows it: plain NumPy arrays, sampled at the control instants."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from cablejax.control.loop import ClosedLoopRun

Method = Literal["residual", "direct"]
"""`residual`: the learned model corrected online; `direct`: the learned model as it was trained."""


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """A cable brought to one target shape by one controller.

    Arrays of commands (`residual_share`, `radius`, `mpc_ms`) have the length of `times`; where no command was computed,
    as at the last sample, they are NaN.

    Attributes:
        shape: name of the target, for example "U".
        method: whether the online residual was used.
        target: the keypoints asked for [m], shape [N, 2].
        times: seconds from the start, shape [T].
        keypoints: the observed cable [m], shape [T, N, 2].
        gripper_pose: (x, y, theta) of both grippers; theta is the cable's tangent, shape [T, 2, 3].
        error_cm: root mean square keypoint distance to the target [cm], shape [T].
        residual_share: size of the residual's prediction over that of the whole model's, between 0 and 1, shape [T].
        radius: bound on the motion of one gripper in one step [m], shape [T].
        mpc_ms: wall time of one control call [ms], shape [T].
    """

    shape: str
    method: Method
    target: Float[np.ndarray, "N 2"]
    times: Float[np.ndarray, " T"]
    keypoints: Float[np.ndarray, "T N 2"]
    gripper_pose: Float[np.ndarray, "T 2 3"]
    error_cm: Float[np.ndarray, " T"]
    residual_share: Float[np.ndarray, " T"]
    radius: Float[np.ndarray, " T"]
    mpc_ms: Float[np.ndarray, " T"]

    def __post_init__(self):
        if self.method not in ("residual", "direct"):
            raise ValueError(f"RunRecord.method is {self.method!r}, expected 'residual' or 'direct'.")
        samples, points = np.shape(self.keypoints)[:2] if np.ndim(self.keypoints) == 3 else (0, 0)
        expected = {
            "target": (points, 2),
            "times": (samples,),
            "keypoints": (samples, points, 2),
            "gripper_pose": (samples, 2, 3),
            "error_cm": (samples,),
            "residual_share": (samples,),
            "radius": (samples,),
            "mpc_ms": (samples,),
        }
        for name, shape in expected.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(
                    f"RunRecord.{name} of {self.shape}/{self.method} has shape {np.shape(getattr(self, name))}, "
                    f"expected {shape} to fit keypoints of shape {np.shape(self.keypoints)}."
                )

    @property
    def final_error_cm(self) -> float:
        """The last error [cm]."""
        return float(self.error_cm[-1])


def record_of(run: ClosedLoopRun, method: Method) -> RunRecord:
    """A closed-loop run as the report takes it."""
    return RunRecord(
        shape=run.target.name,
        method=method,
        target=run.target.keypoints,
        times=run.times,
        keypoints=run.keypoints,
        gripper_pose=run.gripper_pose,
        error_cm=run.error_cm,
        residual_share=run.residual_share,
        radius=run.radius,
        mpc_ms=run.mpc_ms,
    )


def pair_by_shape(records: list[RunRecord]) -> dict[str, dict[Method, RunRecord]]:
    """The runs grouped as `{shape: {method: run}}`, in the order of their first appearance.

    Raises:
        ValueError: if there is no run, or two of the same shape and method.
    """
    if not records:
        raise ValueError("A report needs at least one run, got none.")
    pairs: dict[str, dict[Method, RunRecord]] = {}
    for record in records:
        methods = pairs.setdefault(record.shape, {})
        if record.method in methods:
            raise ValueError(f"Two runs of shape {record.shape!r} with method {record.method!r}; expected one of each.")
        methods[record.method] = record
    return pairs
