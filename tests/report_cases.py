"""Made-up runs for the report's tests: an arch that bends into its target and stops short of it."""

import numpy as np

from cablejax.report.record import RunRecord


def arc(angle: float, n: int = 13) -> np.ndarray:
    """Keypoints of a circular arc of length 1 m that turns from -angle to angle [rad], shape [n, 2]."""
    theta = np.linspace(-angle, angle, 2001)
    steps = np.stack([np.cos(theta), np.sin(theta)], axis=1) / 2000
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(0.5 * (steps[1:] + steps[:-1]), axis=0)])
    return points[np.round(np.linspace(0, 2000, n)).astype(int)]


def run(
    shape: str = "U", method: str = "residual", *, angle: float = 1.2, short: float = 0.01, n: int = 9
) -> RunRecord:
    """A run that ends with the fraction `short` of the bend missing."""
    bends = angle * (1.0 - short) * np.linspace(0.02, 1.0, n)
    keypoints = np.stack([arc(bend) for bend in bends])
    pose = np.stack([[[*x[0], -bend], [*x[-1], bend]] for x, bend in zip(keypoints, bends, strict=True)])
    target = arc(angle)
    last = np.arange(n) == n - 1
    return RunRecord(
        shape=shape,
        method=method,
        target=target,
        times=np.arange(n, dtype=float),
        keypoints=keypoints,
        gripper_pose=pose,
        error_cm=100 * np.sqrt(((keypoints - target) ** 2).sum(-1).mean(-1)),
        residual_share=np.where(last, np.nan, 0.3 if method == "residual" else 0.0),
        radius=np.full(n, 0.05),
        mpc_ms=np.where(last, np.nan, 100.0),
    )


def demo_runs() -> list[RunRecord]:
    """Two shapes, each with and without residual."""
    return [
        run("U", "residual"),
        run("U", "direct", short=0.1),
        run("S", "residual", angle=0.8),
        run("S", "direct", angle=0.8, short=0.1),
    ]
