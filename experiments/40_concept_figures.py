"""Figures of the documentation that no table draws, and the log of its example of a diagnosis.

python experiments/40_concept_figures.py                      # a minute; simulate, correct, plants.png in docs/images
python experiments/40_concept_figures.py --demo runs/demo     # control.png too, from the run of `cablejax demo`
python experiments/40_concept_figures.py --log example.npz    # a soft section staged in the contact plant, to diagnose
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import os
import pathlib

os.environ.setdefault("NPROC", "4")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cablejax.cable import Discretisation
from cablejax.control.targets import make_target
from cablejax.effects.given import parse_effect
from cablejax.effects.physics import nominal_physics
from cablejax.gaplog import gap_log_from_episodes, read_gap_log, write_gap_log
from cablejax.report.style import LIGHT, cable_curve
from cablejax.simulate import ChainEngine
from cablejax.simulate.elastica import elastica
from cablejax.types import GapLog
from closed_loop.rod_plant import RodPlantConfig

IMAGES = pathlib.Path("docs/images")
EFFECT = "stiffness_profile:centre_m=0.3,width_m=0.25,ratio=0.3"
FRICTIONS = {0.1: "#56b4e9", 0.3: "#0072b2", 1.0: "#e69f00", 3.0: "#d55e00"}
METHODS = {
    "direct": ("gns-reference as trained", "#d55e00"),
    "learner": ("gns-reference with the learner", "#0072b2"),
    "no prior learner": ("gns-no-prior with estimate and learner", "#009e73"),
}


def draw_cable(ax: Axes, keypoints: np.ndarray, **style) -> None:
    """A cable as a smooth curve."""
    ax.plot(*cable_curve(keypoints).T, **style)


def frictions() -> Figure:
    """Shapes after the same motion on tables of different friction."""
    config = Discretisation()
    start = np.array([[-0.35, 0.0, 1.0], [0.35, 0.0, -1.0]])
    twist = np.tile(np.array([0.08, 0.0, 0.0], np.float32), (6, 2, 1))
    end = start + np.array([0.48, 0.0, 0.0])
    engine = ChainEngine(config)
    state = engine.initial_state(start)
    resting = elastica(end, config.cable.length, config.cable.keypoint_arclength)
    figure, ax = plt.subplots(figsize=(7.2, 3.4), layout="constrained")
    for coefficient, colour in FRICTIONS.items():
        physics = dataclasses.replace(nominal_physics(config), friction=np.float32(coefficient))
        _, trajectory = engine.rollout(physics, state, twist, 1.0)
        keypoints = np.asarray(trajectory.keypoints, float)
        off = 1e3 * np.sqrt(np.mean(np.sum((keypoints[-1] - resting) ** 2, axis=-1)))
        draw_cable(ax, keypoints[-1], color=colour, lw=2.5, label=f"friction {coefficient:g}: {off:.0f} mm from rest")
    draw_cable(ax, keypoints[0], color=LIGHT.faint, lw=2.5, label="before the motion")
    draw_cable(ax, resting, color=LIGHT.ink, lw=1.2, ls="--", label="at rest without friction")
    for pose in end:
        ax.plot(*pose[:2], marker="s", color=LIGHT.gripper, ms=9)
    return _on_table(figure, ax, "both grippers move to the right, 48 cm in 6 s")


def corrections(trials: pathlib.Path = pathlib.Path("docs/results/trials/stiffness.jsonl")) -> Figure:
    """Errors of the stored closed loops over time: median, and 10 to 90 % of the runs."""
    rows = [json.loads(line) for line in trials.read_text().splitlines()]
    figure, axes = plt.subplots(1, 3, figsize=(8.4, 3.2), sharey=True, layout="constrained")
    for ax, shape in zip(axes, ("U", "S", "Z"), strict=True):
        for method, (label, colour) in METHODS.items():
            wanted = ("III", method, shape)
            runs = [row["errors_cm"] for row in rows if (row["table"], row["method"], row["scenario"]) == wanted]
            length = max(len(run) for run in runs)
            # a run that came to rest stays where it is
            errors = np.array([run + [run[-1]] * (length - len(run)) for run in runs])
            low, median, high = np.percentile(errors, (10, 50, 90), axis=0)
            ax.fill_between(range(length), low, high, color=colour, alpha=0.12, lw=0)
            ax.plot(median, color=colour, lw=2, label=label)
        ax.set(title=f"{shape}, {len(runs)} runs each", yscale="log", xlabel="time [s]", ylim=(0.02, 60))
        ax.grid(color=LIGHT.faint, lw=0.6)
    axes[0].set_ylabel("error [cm]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def friction_laws() -> Figure:
    """Friction over weight and kinetic coefficient by speed, of the rod's table and of the training simulator."""
    rod, slow = RodPlantConfig(), Discretisation().friction_speed
    speed = np.geomspace(1e-5, 0.1, 400)
    stribeck = 1.0 + (rod.static_ratio - 1.0) * np.exp(-((speed / rod.stribeck_speed) ** 2))
    laws = {
        f"rod: Stribeck, static {rod.static_ratio:g} times kinetic": (stribeck, "#d55e00"),
        f"training simulator: Coulomb, viscous below {1e3 * slow:g} mm/s": (speed / np.hypot(speed, slow), "#0072b2"),
    }
    figure, ax = plt.subplots(figsize=(7.2, 3.0), layout="constrained")
    for label, (friction, colour) in laws.items():
        ax.plot(1e3 * speed, friction, color=colour, lw=2.2, label=label)
    ax.set(xscale="log", xlabel="speed [mm/s]", ylabel="friction / (w mu_k)", ylim=(0.0, 1.4))
    ax.grid(color=LIGHT.faint, lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize="small")
    return figure


def run_of_demo(folder: pathlib.Path) -> Figure:
    """Cable and grippers at every fourth command of the demo's way to an S."""
    log = read_gap_log(folder / "log.npz")
    episode = log.meta["motion"].index("approach_s_residual")
    keypoints, pose = np.asarray(log.keypoints[episode]), np.asarray(log.gripper_pose[episode])
    chosen = np.arange(10, 220, 40)
    colours = plt.get_cmap("Blues")(np.linspace(0.25, 1.0, len(chosen)))
    figure, ax = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    for gripper in range(2):
        ax.plot(*pose[chosen[0] : chosen[-1], gripper, :2].T, color=LIGHT.gripper, lw=0.8, ls=":")
    for sample, colour in zip(chosen, colours, strict=True):
        draw_cable(ax, keypoints[sample], color=colour, lw=2.5, label=f"{(sample - 10) / 10:.0f} s")
        ax.plot(*pose[sample, :, :2].T, "s", color=colour, ms=7)
    draw_cable(ax, make_target("S").keypoints, color=LIGHT.target, lw=1.5, ls="--", label="target")
    return _on_table(figure, ax, "from a straight cable to an S")


def staged_log() -> GapLog:
    """Six motions of a cable with a soft section in the contact plant, with 1 mm of noise."""
    staged = importlib.import_module("24_named_is_added")
    noise = np.random.default_rng(0)
    episodes = [staged.recorded(commands, (parse_effect(EFFECT),), noise) for commands in staged.motions()[0]]
    return gap_log_from_episodes(episodes, staged.ENGINE.cable, source=f"contact plant, {EFFECT}, 1 mm of noise")


def _on_table(figure: Figure, ax: Axes, title: str) -> Figure:
    ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    ax.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize="small")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demo", type=pathlib.Path, help="folder of `cablejax demo`")
    parser.add_argument(
        "--log", type=pathlib.Path, help="write the log of the example of a diagnosis, and draw nothing"
    )
    options = parser.parse_args()
    if options.log:
        write_gap_log(options.log, staged_log(), overwrite=True)
        return
    figures = {"simulate": frictions, "correct": corrections, "plants": friction_laws}
    if options.demo:
        figures["control"] = lambda: run_of_demo(options.demo)
    for name, draw in figures.items():
        draw().savefig(IMAGES / f"{name}.png", dpi=150)


if __name__ == "__main__":
    main()
