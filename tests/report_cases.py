"""Made-up runs for the report's tests: an arch that bends into its target and stops short of it."""

import numpy as np

from cablejax.control.run import ClosedLoopRun
from cablejax.control.shaping import Method
from cablejax.control.targets import Target
from cablejax.gaplog import Episode


def arc(angle: float, n: int = 13) -> np.ndarray:
    """Keypoints of a circular arc of length 1 m that turns from -angle to angle [rad], shape [n, 2]."""
    theta = np.linspace(-angle, angle, 2001)
    steps = np.stack([np.cos(theta), np.sin(theta)], axis=1) / 2000
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(0.5 * (steps[1:] + steps[:-1]), axis=0)])
    return points[np.round(np.linspace(0, 2000, n)).astype(int)]


def run(
    shape: str = "U", method: Method = "residual", *, angle: float = 1.2, short: float = 0.01, n: int = 9
) -> ClosedLoopRun:
    """A run that ends with the fraction `short` of the bend missing."""
    bends = angle * (1.0 - short) * np.linspace(0.02, 1.0, n)
    keypoints = np.stack([arc(bend) for bend in bends])
    pose = np.stack([[[*x[0], -bend], [*x[-1], bend]] for x, bend in zip(keypoints, bends, strict=True)])
    target = arc(angle)
    last = np.arange(n) == n - 1
    error = 100 * np.sqrt(((keypoints - target) ** 2).sum(-1).mean(-1))
    times, twist = np.arange(n, dtype=float), np.diff(pose, axis=0, append=np.nan)
    return ClosedLoopRun(
        target=Target(shape, target, np.array([[*target[0], -angle], [*target[-1], angle]])),
        times=times,
        keypoints=keypoints,
        gripper_pose=pose,
        twist=twist,
        error_cm=error,
        residual_share=np.where(last, np.nan, 0.3 if method == "residual" else 0.0),
        action=np.full_like(error, np.nan),
        radius=np.full(n, 0.05),
        mpc_ms=np.where(last, np.nan, 100.0),
        unobserved=0,
        stopped=None,
        episode=Episode("approach", times, keypoints, pose, np.nan_to_num(twist), hold=times < 1),
    )


def demo_runs() -> dict[tuple[str, Method], ClosedLoopRun]:
    """Two shapes, each with and without residual."""
    return {
        ("U", "residual"): run("U", "residual"),
        ("U", "direct"): run("U", "direct", short=0.1),
        ("S", "residual"): run("S", "residual", angle=0.8),
        ("S", "direct"): run("S", "direct", angle=0.8, short=0.1),
    }
