"""Measures how much a model gains from being informed of an effect, open loop and without retraining.

    python experiments/27_informed_models.py --out docs/results/informed_models.md    # three minutes

Simulates motions of a cable with each effect. A model predicts them as it was trained, and again informed of the
effect (`cablejax.control.shaping.knowing`, `cablejax shape --with`).
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import pathlib

os.environ.setdefault("NPROC", "4")

import jax
import jax.numpy as jnp
import numpy as np

from cablejax.control.shaping import Model, knowing, load_model
from cablejax.dataset.generate import make_engine, simulate
from cablejax.dataset.schema import DatasetConfig
from cablejax.dataset.windows import trajectory_of
from cablejax.dynamics.evaluate import evaluation_windows, no_motion, predict
from cablejax.effects.given import GivenEffect, parse_effect
from cablejax.simulate.motions import MotionConfig
from cablejax.types import Trajectory
from pages import markdown_table, page_of_results, publish

EFFECTS = (
    "stiffness_profile:centre_m=0.3,width_m=0.25,ratio=0.2",
    "intrinsic_curvature:centre_m=0.6,width_m=0.3,curvature_per_m=2",
    "gripper_rotation_offset:gripper=1,angle_rad=0.15",
    "gripper_compliance:gripper=1,stiffness_n_m_per_rad=0.15",
    "bending_stiffness:ratio=0.2",
    "table_friction:coefficient=0.3",
    "linear_density:ratio=3",
)
STEPS, MOTIONS, COMMANDS, SEED = 20, 16, 60, 27


def recorded(effects: tuple[GivenEffect, ...]) -> Trajectory:
    """Random motions of the simulated cable with these effects."""
    config = DatasetConfig(
        n_trajectories=MOTIONS,
        n_steps=COMMANDS,
        seed=SEED,
        shard_size=MOTIONS,
        motion=MotionConfig(start="straight"),
        effects=effects,
    )
    (block,) = simulate(config, make_engine(config), [0])
    return trajectory_of(config, block, range(MOTIONS))


def median_error(model: Model | None, data: Trajectory) -> float:
    """Median over windows of the error after `STEPS` steps [cm]; of a cable that does not move for None."""
    config = (model or load_model("gns-reference")).config
    windows = evaluation_windows(data, dataclasses.replace(config, conditioned=False), steps=STEPS, stride=10)

    @jax.jit
    def error(window):
        history = window.history
        if model is None:
            shape = predict(no_motion, history, window.twist, config.interval)[-1]
        else:
            if config.conditioned:
                known = jnp.asarray(model.believed, history.keypoints.dtype)
                history = type(history)(history.keypoints, history.gripper_pose, known)
            dynamics, weights = model.dynamics, model.weights
            shape = predict(lambda h, u: dynamics(weights, h, u), history, window.twist, config.interval)[-1]
        return jnp.sqrt(jnp.mean(jnp.sum((shape - window.future[-1]) ** 2, axis=-1)))

    return 100 * float(np.median(jax.lax.map(error, windows, batch_size=64)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, help="page to write")
    options = parser.parse_args()
    plain, conditioned = load_model("gns-reference"), load_model("gns-conditioned")
    rows: list[tuple[str, ...]] = [
        ("effect", "does not move", "gns-reference", "informed", "gns-conditioned", "informed")
    ]
    for text in (None, *EFFECTS):
        effects = () if text is None else (parse_effect(text),)
        data, cells = recorded(effects), [f"`{text}`" if text else "none"]
        cells.append(f"{median_error(None, data):.1f}")
        for model in (plain, conditioned):
            cells.append(f"{median_error(model, data):.3f}")
            try:
                cells.append(f"{median_error(knowing(model, effects), data):.3f}" if effects else "")
            except ValueError:
                cells.append("cannot be")
        rows.append(tuple(cells))
        print(" | ".join(cells), flush=True)
    lines = [
        f"Median error after {STEPS} steps [cm], over windows of {MOTIONS} motions of {COMMANDS} s in the simulator "
        "with the effect. *Informed* is the same network: its static prior uses the resting shape with the effect, and "
        "a conditioned network gets stiffness and friction as inputs. The conditioned network's online estimate is not "
        "used here.",
        "",
        *markdown_table(rows),
    ]
    publish(
        page_of_results(
            "Informed models", "`python experiments/27_informed_models.py --out docs/results/informed_models.md`", lines
        ),
        options.out,
    )


if __name__ == "__main__":
    main()
