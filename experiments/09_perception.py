"""Measures how well a cable is found in point clouds: structure preserved registration and coherent point drift.

Cables move at random between two grippers, as in the training data, and are seen at 10 Hz. For every condition:

  * error    mean distance of the 13 keypoints to the true ones, mean over frames, and the worst frame's [mm]
  * held     frames in which the tracker reported that it did not see the cable
  * lost     cables with a mean error above 10 mm in a frame that was reported as tracked, or not found in the last
             half second
  * first    first frames found without a prior

and for the loop as a whole: terminal errors of U, S and Z with clouds and with true keypoints, from the same starts
(`--full` only).

    python experiments/09_perception.py --out docs/results/perception.md --figure docs/images/perception.png [--full]

Finished parts are kept in --work, so that the same command resumes after an interruption.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
from matplotlib.figure import Figure

from cablejax.cable import Cable, Discretisation
from cablejax.control.targets import Shape
from cablejax.effects.physics import nominal_physics
from cablejax.perceive import Status, Tracker, TrackerConfig
from cablejax.perceive.camera import CameraConfig
from cablejax.perceive.plant import CloudPlant
from cablejax.report.style import LIGHT
from cablejax.simulate import ThreadedEngine
from cablejax.simulate.motions import random_motion
from closed_loop.cases import mujoco_plant, stiffness_cases
from closed_loop.methods import METHODS, NO_PRIOR_LEARNER, model_named
from closed_loop.suite import run_case
from clutter import Clutter, scatter
from pages import markdown_table, page_of_results, publish
from rows import Rows, made_on

HZ = 10
FINE = 20
"""Points of the true curve between two keypoints."""
CABLE = Discretisation(Cable(n_keypoints=12 * FINE + 1))
CONDITIONS = {
    "30 % hidden, 10 % outliers": Clutter(hidden=0.3, outliers=0.1),
    "2 mm noise": Clutter(),
    "5 mm noise": Clutter(noise=0.005),
    "50 % hidden, 20 % outliers": Clutter(hidden=0.5, outliers=0.2),
    "no points for 1 s in 5": Clutter(),
}
OUTAGE = "no points for 1 s in 5"
LOST_MM = 10.0
FIRST_SEED = 5000
"""Seeds of the cables; all settings were chosen on others."""
LOOP_SEEDS, LOOP_STIFFNESS, LOOP_STEPS = range(5), 2.0, 40
"""Starts of the closed loops, as in the tables, the plant's stiffness over the trained one, and commands."""

DRIFT = {"alpha": 2.0, "beta": 0.1, "sigma2": 1e-4, "w": 0.1, "max_iterations": 30, "tolerance": 1e-5}
"""Settings of coherent point drift (lengths in m): the best of a small grid on other cables. If started from the whole
cloud's spread instead of 1 cm, CPD needs five times the iterations and loses the cable more often."""


def moving_cable(seed: int, seconds: int) -> tuple[np.ndarray, np.ndarray]:
    """Fine curve [T, P, 2] and gripper poses [T, 2, 3] of a random motion."""
    pose, twist = random_motion(np.random.default_rng(seed), CABLE, seconds)
    engine = ThreadedEngine(CABLE, n_threads=1)
    commands = np.repeat(twist, HZ, axis=0)
    _, motion = engine.rollout(nominal_physics(CABLE), engine.initial_state(pose), commands, 1.0 / HZ)
    return np.asarray(motion.keypoints, float), np.asarray(motion.gripper_pose, float)


def clouds_of(curves: np.ndarray, name: str, seed: int) -> tuple[list[np.ndarray], np.ndarray]:
    """One cloud per frame, and the place of the hidden stretch, which wanders slowly along the cable, shape [T]."""
    random = np.random.default_rng([seed, list(CONDITIONS).index(name)])
    hidden = 0.5 + 0.5 * np.sin(random.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(len(curves)) / (20 * HZ))
    clouds = []
    for frame, (curve, where) in enumerate(zip(curves, hidden, strict=True)):
        cloud = scatter(curve, CONDITIONS[name], random, where=where)
        blind = name == OUTAGE and frame % (5 * HZ) >= 4 * HZ
        clouds.append(cloud[:0] if blind else cloud)
    return clouds, hidden


def errors_mm(keypoints: np.ndarray, curves: np.ndarray) -> np.ndarray:
    """Mean keypoint error of every frame [mm], shape [T]."""
    return 1e3 * np.linalg.norm(keypoints - curves[: len(keypoints), ::FINE], axis=-1).mean(axis=-1)


def follow(seed: int, seconds: int, name: str) -> dict[str, Any]:
    """One cable, one condition, our tracker."""
    curves, poses = moving_cable(seed, seconds)
    tracker, state = Tracker(), None
    keypoints, held = [], []
    for cloud, pose in zip(clouds_of(curves, name, seed)[0], poses, strict=True):
        state, seen = tracker.init(cloud, pose) if state is None else tracker.step(state, cloud, pose)
        keypoints.append(np.asarray(seen.keypoints))
        held.append(int(seen.status) != Status.TRACKED)
    error, held = errors_mm(np.stack(keypoints), curves), np.array(held)
    tracked = error[~held]
    return {
        "error_mm": float(tracked.mean()),
        "worst_mm": float(tracked.max()),
        "held": int(held.sum()),
        "held_worst_mm": float(np.nanmax(error[held], initial=0.0)),
        "frames": len(error),
        "first_found": bool(not held[0] and error[0] < LOST_MM),
        "lost": bool((tracked > LOST_MM).any() or (held[-5:].all() and name != OUTAGE)),
    }


def drift(seed: int, seconds: int, name: str) -> dict[str, Any]:
    """The same by coherent point drift, given the true first frame and the grippers; it skips empty clouds."""
    from pycpd import DeformableRegistration

    curves, poses = moving_cable(seed, seconds)
    between = FINE // 5
    estimate, keypoints = curves[0][::between], []
    began, count = time.process_time(), 0
    for cloud, pose in zip(clouds_of(curves, name, seed)[0], poses, strict=True):
        if len(cloud):
            estimate, count = np.array(DeformableRegistration(X=cloud, Y=estimate, **DRIFT).register()[0]), count + 1
            estimate[[0, -1]] = pose[:, :2]
        keypoints.append(estimate[:: FINE // between])
    error = errors_mm(np.stack(keypoints), curves)
    return {
        "error_mm": float(error.mean()),
        "worst_mm": float(error.max()),
        "frames": len(error),
        "lost": bool(error[-1] > LOST_MM),
        "frame_cpu_ms": 1e3 * (time.process_time() - began) / max(count, 1),
    }


def speed(frames: int = 100) -> dict[str, float]:
    """Milliseconds per frame of the tracker: wall time, and processor time over all cores."""
    curves, poses = moving_cable(FIRST_SEED - 1, frames // HZ)
    clouds, _ = clouds_of(curves, "2 mm noise", 0)
    tracker = Tracker()
    state, _ = tracker.init(clouds[0], poses[0])
    wall, first = [], []
    for cloud, pose in zip(clouds, poses, strict=True):
        began = time.perf_counter()
        state, seen = tracker.step(state, cloud, pose)
        seen.keypoints.block_until_ready()
        wall.append(1e3 * (time.perf_counter() - began))
    for cloud, pose in list(zip(clouds, poses, strict=True))[:5]:
        began = time.perf_counter()
        tracker.init(cloud, pose)[1].keypoints.block_until_ready()
        first.append(1e3 * (time.perf_counter() - began))
    return {
        "median_ms": float(np.median(wall[2:])),
        "p95_ms": float(np.percentile(wall[2:], 95)),
        "first_ms": float(np.median(first)),
    }


def loop(target_name: Shape, perception: str, seed: int) -> dict[str, Any]:
    """One target on the plant, by our method of the tables, with clouds or with true keypoints."""
    case = stiffness_cases((target_name,), (LOOP_STIFFNESS,), (seed,), steps=LOOP_STEPS)[0]
    spec, plant = METHODS[NO_PRIOR_LEARNER], mujoco_plant(LOOP_STIFFNESS)
    if perception == "cloud":
        plant = CloudPlant(plant.config, camera=CameraConfig(seed=seed))
    run = run_case(dataclasses.replace(case, plant=lambda: plant), spec, model_named(str(spec.weights)))
    return {"terminal_cm": run.terminal_error_cm, "held": getattr(plant, "lost", 0)}


class Kept:
    """Results of finished parts, a row each; what is missing is made."""

    def __init__(self, path: Path):
        self.rows = Rows(path, ("part",))

    def __call__(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        self.rows.run(self.rows.missing([(name,)]), lambda _: make(), progress=False)
        return next(row for row in self.rows.read() if row["part"] == name)


def accuracy_rows(ours: dict[str, list[dict]], drifts: dict[str, list[dict]]) -> list[list[str]]:
    """The table of errors."""
    rows = [
        [
            "condition",
            "error [mm]",
            "worst frame [mm]",
            "held frames",
            "lost cables",
            "first frames found",
            "CPD: error [mm]",
            "worst frame [mm]",
            "lost cables",
        ]
    ]
    for name, parts in ours.items():
        other = drifts[name]
        rows.append(
            [
                name,
                f"**{np.mean([p['error_mm'] for p in parts]):.2f}**",
                f"{max(p['worst_mm'] for p in parts):.1f}",
                f"{sum(p['held'] for p in parts)} of {sum(p['frames'] for p in parts)}",
                f"{sum(p['lost'] for p in parts)} of {len(parts)}",
                f"{sum(p['first_found'] for p in parts)} of {len(parts)}",
                f"{np.mean([p['error_mm'] for p in other]):.1f}",
                f"{max(p['worst_mm'] for p in other):.0f}",
                f"{sum(p['lost'] for p in other)} of {len(other)}",
            ]
        )
    return rows


def loop_rows(kept: Kept) -> list[list[str]]:
    """The table of terminal errors."""
    rows = [["target", "true keypoints [cm]", "clouds [cm]", "difference [cm]", "from", "to", "frames held"]]
    for name in get_args(Shape):
        true_keypoints, seen = (
            [kept(f"loop-{name}-{how}-{s}", lambda n=name, h=how, s=s: loop(n, h, s)) for s in LOOP_SEEDS]
            for how in ("true", "cloud")
        )
        true, cloud = (np.array([one["terminal_cm"] for one in runs]) for runs in (true_keypoints, seen))
        errors = true.mean(), cloud.mean()
        differences = (cloud - true).mean(), (cloud - true).min(), (cloud - true).max()
        held = sum(one["held"] for one in seen)
        rows.append([name, *(f"{x:.3f}" for x in errors), *(f"{x:+.3f}" for x in differences), str(held)])
    return rows


def draw(path: Path, ours: dict[str, list[dict]], drifts: dict[str, list[dict]]) -> None:
    """A cluttered cloud with what was found in it, and the errors of both methods."""
    from pycpd import DeformableRegistration

    name = "30 % hidden, 10 % outliers"
    # of the first three cables, the one that is bent most within twenty seconds, at that instant
    motions = [moving_cable(FIRST_SEED + seed, 20) for seed in range(3)]
    spread = np.stack([np.linalg.norm(poses[:, 1, :2] - poses[:, 0, :2], axis=1) for _, poses in motions])
    seed, shown = (int(i) for i in np.unravel_index(spread.argmin(), spread.shape))
    curves, poses = motions[seed]
    clouds, hidden = clouds_of(curves, name, FIRST_SEED + seed)
    tracker, state, found = Tracker(), None, curves[0][::FINE]
    estimate = curves[0][:: FINE // 5]
    for cloud, pose in zip(clouds[: shown + 1], poses, strict=False):
        state, seen = tracker.init(cloud, pose) if state is None else tracker.step(state, cloud, pose)
        found = np.asarray(seen.keypoints)
        estimate = np.array(DeformableRegistration(X=cloud, Y=estimate, **DRIFT).register()[0])
        estimate[[0, -1]] = pose[:, :2]
    truth, cloud, where = curves[shown], clouds[shown], hidden[shown]
    first = round(where * (1.0 - CONDITIONS[name].hidden) * (len(truth) - 1))
    last = first + round(CONDITIONS[name].hidden * (len(truth) - 1))

    figure = Figure(figsize=(11, 5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.2, 1])
    left.plot(*cloud.T, ".", color=LIGHT.target, ms=2.5, label="point cloud")
    left.plot(
        *truth[first : last + 1].T, color=LIGHT.faint, lw=14, solid_capstyle="butt", label="hidden from the camera"
    )
    left.plot(*truth[::FINE].T, "o", mec=LIGHT.ink, mfc="none", ms=12, label="true keypoints")
    left.plot(*estimate[::5].T, "x", color=LIGHT.direct, ms=8, mew=2, label="coherent point drift")
    left.plot(*found.T, "o", color=LIGHT.residual, ms=6, label="this package")
    left.set_aspect("equal")
    left.set_axis_off()
    left.legend(loc="upper center", bbox_to_anchor=(0.5, 0.02), ncols=2, frameon=False)
    left.set_title(f"A moving cable after {shown / HZ:.0f} s, seen as a cloud", color=LIGHT.ink)
    names = [n for n in CONDITIONS if n != OUTAGE]
    place = np.arange(len(names))
    for parts, colour, label in (
        (ours, LIGHT.residual, "this package"),
        (drifts, LIGHT.direct, "coherent point drift"),
    ):
        values = np.array([np.mean([p["error_mm"] for p in parts[n]]) for n in names])
        right.plot(values, place, "o", color=colour, ms=11)
        for x, y in zip(values, place, strict=True):
            right.annotate(
                f"{x:.{2 if x < 1 else 0}f} mm", (x, y), (0, 9), textcoords="offset points", ha="center", color=colour
            )
        right.annotate(
            label, (values[0], 0), (0, 24), textcoords="offset points", ha="center", color=colour, weight="bold"
        )
    right.set_yticks(place, names)
    right.set_ylim(len(names) - 0.5, -0.9)
    right.set_xscale("log")
    right.set_xlim(0.05, 300)
    right.grid(axis="y", color=LIGHT.faint)
    right.set_axisbelow(True)
    right.set_xlabel("mean error of a keypoint [mm], logarithmic")
    right.spines[["top", "right", "left"]].set_visible(False)
    right.tick_params(axis="y", length=0)
    right.set_title("Keypoint error over all frames", color=LIGHT.ink)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="write the tables there as Markdown")
    parser.add_argument("--figure", type=Path, help="write the figure there")
    parser.add_argument("--work", type=Path, default=Path("runs/perception"), help="folder for finished parts")
    parser.add_argument("--full", action="store_true", help="100 cables for 60 s each, and the closed loop")
    parser.add_argument("--seeds", type=int, help="number of cables")
    options = parser.parse_args()
    seeds, seconds = options.seeds or (100 if options.full else 3), 60 if options.full else 10
    drift_seeds, drift_seconds = (min(seeds, 10), 10) if options.full else (1, 6)
    kept = Kept(options.work / "parts.jsonl")
    fast = kept("speed", speed)
    looped = loop_rows(kept) if options.full else []
    ours = {
        name: [
            kept(f"ours-{seconds}s-{index}-{seed}", lambda n=name, s=seed: follow(FIRST_SEED + s, seconds, n))
            for seed in range(seeds)
        ]
        for index, name in enumerate(CONDITIONS)
    }
    drifts = {
        name: [
            kept(f"cpd-{drift_seconds}s-{index}-{seed}", lambda n=name, s=seed: drift(FIRST_SEED + s, drift_seconds, n))
            for seed in range(drift_seeds)
        ]
        for index, name in enumerate(CONDITIONS)
    }
    cpd_ms = float(np.median([p["frame_cpu_ms"] for parts in drifts.values() for p in parts]))
    settings = TrackerConfig()
    lines = [
        f"{seeds} cables move at random for {seconds} s each (seeds {FIRST_SEED} to {FIRST_SEED + seeds - 1}), seen at "
        f"{HZ} Hz as {Clutter().points} points with 2 mm of noise in every coordinate unless stated. The hidden "
        "stretch wanders along the cable. Errors are mean distances of the 13 keypoints to the true ones, over tracked "
        f"frames; a cable is lost if it is off by more than {LOST_MM:.0f} mm in a frame reported as tracked, or if it "
        "is not found in the last half second.",
        "",
        *markdown_table(accuracy_rows(ours, drifts)),
        "",
        f"CPD: coherent point drift of pycpd 2.0.0, 61 points along the cable, on {drift_seeds} of the cables for "
        f"{drift_seconds} s. It is initialised with the true first frame, and its ends are set to the grippers; a "
        "cable counts as lost if the last frame is off by more than 10 mm.",
        "",
        "![A cloud and what was found in it](../images/perception.png)",
        "",
        "## Speed",
        "",
        *markdown_table(
            [
                ["what", "ms", "frames per second"],
                ["one frame, median", f"{fast['median_ms']:.1f}", f"{1e3 / fast['median_ms']:.0f}"],
                ["one frame, 95th percentile", f"{fast['p95_ms']:.1f}", f"{1e3 / fast['p95_ms']:.0f}"],
                ["first frame, without a prior, median", f"{fast['first_ms']:.0f}", f"{1e3 / fast['first_ms']:.1f}"],
                ["coherent point drift, processor time", f"{cpd_ms:.0f}", f"{1e3 / cpd_ms:.1f}"],
            ]
        ),
        "",
        f"{settings.capacity} points, {settings.registration.n_keypoints} keypoints, {settings.iterations} "
        f"iterations on {settings.registration.n_links} links.",
    ]
    if options.full:
        lines += [
            "",
            "## In the loop",
            "",
            f"Terminal error of the true keypoints after at most {LOOP_STEPS} commands. The network has no statics; "
            f"its estimate and the learner are on. The plant is that of the tables, with {LOOP_STIFFNESS:g} times the "
            "stiffness. Figures are the mean over the "
            f"tables' starts of seeds {LOOP_SEEDS[0]} to {LOOP_SEEDS[-1]}, and the least and greatest difference. "
            "Clouds come from the depth camera with its default settings: 20 degrees of tilt, 2 mm of noise, 5 % "
            "dropout, 0.1 % random ranges, both grippers in view.",
            "",
            *markdown_table(looped),
        ]
    command = "python experiments/09_perception.py --out docs/results/perception.md --figure docs/images/perception.png"
    made_by = f"`{command}{' --full' if options.full else ''}`"
    made = made_on(kept.rows.path)
    publish(page_of_results("Perception: keypoints from point clouds", made_by, lines, made_on=made), options.out)
    if options.figure is not None:
        draw(options.figure, ours, drifts)


if __name__ == "__main__":
    main()
