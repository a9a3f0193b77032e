"""What a diagnosis is worth: name the cause, put it into the simulator, train on new data, shape the cable again.

A plant whose cable is a tenth as stiff as believed, on a table with contact. From six logged runs by direct transfer
the diagnosis names a cause; the released network is then fine-tuned on 2,000 transitions simulated with it, never on
the plant's own, and the same shaping tasks are run again: direct transfer, online residual, diagnosed, diagnosed with
residual, and an oracle that is given the true effect, with and without residual.

    python experiments/23_worth.py --report docs/results/worth.md     # resumable, about half an hour on two cores
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import pathlib

os.environ.setdefault("NPROC", "4")

import numpy as np

from cablejax.cable import Cable
from cablejax.control.loop import run_closed_loop
from cablejax.control.shaping import Model, load_model, make_controller
from cablejax.dataset.generate import make_engine, simulate
from cablejax.dataset.schema import DatasetConfig
from cablejax.diagnose import diagnose, write_verdict
from cablejax.effects.given import GivenEffect, effects_of_verdict
from cablejax.gaplog import gap_log_from_episodes, read_gap_log, write_gap_log
from cablejax.residual import LearnerConfig
from cablejax.simulate.motions import MotionConfig
from cablejax.types import Trajectory
from closed_loop.cases import mujoco_plant, stiffness_cases
from closed_loop.fine_tuning import FineTuneConfig, fine_tune
from closed_loop.methods import MethodSpec
from closed_loop.suite import Case, read_suite, run_suite
from pages import page_of_results, publish

RATIO = 0.1
LOG_SEEDS, TASK_SEEDS = (100, 101), (0, 1, 2)
NOISE = 1e-3
ARMS = {
    "direct transfer": MethodSpec("direct", "gns-reference"),
    "online residual": MethodSpec("residual", "gns-reference", learner=LearnerConfig()),
    "diagnosed": MethodSpec("diagnosed", "gns-reference", fine_tuned=True),
    "diagnosed + residual": MethodSpec("diagnosed residual", "gns-reference", learner=LearnerConfig(), fine_tuned=True),
    "oracle": MethodSpec("oracle", "gns-reference", fine_tuned=True),
    "oracle + residual": MethodSpec("oracle residual", "gns-reference", learner=LearnerConfig(), fine_tuned=True),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/worth"))
    parser.add_argument("--report", type=pathlib.Path, help="page to write")
    options = parser.parse_args()
    verdict, effects = named(options.out)
    truth = (GivenEffect("bending_stiffness", (("ratio", RATIO),)),)
    for spec in ARMS.values():
        kind = spec.name.split()[0]
        trained = functools.partial(
            trained_with, {"diagnosed": effects, "oracle": truth}.get(kind, ()), options.out / kind
        )
        run_suite(stiffness_cases("USZ", (RATIO,), TASK_SEEDS), [spec], options.out / "trials", fine_tuned=trained)
    publish(page(options.out, verdict), options.report)


def named(out: pathlib.Path) -> tuple[dict, tuple[GivenEffect, ...]]:
    """The verdict on six logged runs, and its effects."""
    path = out / "verdict.json"
    if not path.exists():
        log = out / "log.npz"
        if not log.exists():
            write_gap_log(log, recorded())
        write_verdict(path, diagnose(read_gap_log(log), progress=print))
    verdict = json.loads(path.read_text(encoding="utf-8"))
    return verdict, effects_of_verdict(path)


def trained_with(effects: tuple[GivenEffect, ...], home: pathlib.Path, case: Case) -> Model:
    """The released network after training on the simulator with these effects."""
    del case
    config = FineTuneConfig()
    return fine_tune(transitions(effects, config), config, home)


def recorded():
    """Direct transfer on the plant, seen with noise, as a gap log at 10 Hz."""
    model, episodes = load_model("gns-reference"), []
    for case in stiffness_cases("USZ", (RATIO,), LOG_SEEDS):
        task, plant = case.task(), mujoco_plant(RATIO)
        controller = make_controller(model, task.target, method="direct", solver="levenberg-marquardt")
        run = run_closed_loop(plant, controller, task.target, 30, start=task.start_pose, record_hz=10.0)
        rng = np.random.default_rng((case.seed, len(episodes)))
        noisy = run.episode.keypoints + rng.normal(0.0, NOISE, run.episode.keypoints.shape)
        episodes.append(dataclasses.replace(run.episode, keypoints=noisy))
    return gap_log_from_episodes(episodes, Cable(), source="direct transfer on a plant with contact")


def transitions(effects: tuple[GivenEffect, ...], config: FineTuneConfig) -> Trajectory:
    """Random motions of the simulated cable with these effects, as many as `FineTuneConfig` says."""
    data = DatasetConfig(
        n_trajectories=config.trajectories,
        n_steps=config.commands,
        seed=config.seed,
        motion=MotionConfig(start="straight"),
        engine="chain",
        shard_size=config.trajectories,
        effects=effects,
    )
    (block,) = simulate(data, make_engine(data), [0])
    return Trajectory(block.keypoints, block.gripper_pose, block.gripper_twist)  # pyright: ignore[reportArgumentType]


def page(out: pathlib.Path, verdict: dict) -> str:
    trials = read_suite(out / "trials")[0]
    effects = "; ".join(
        f"{e['name']} " + ", ".join(f"{k} {p['value']:.3g}" for k, p in e["parameters"].items())
        for e in verdict["effects"]
    )
    lines = [
        f"The plant's cable has {RATIO:g} times the believed stiffness. Verdict on six logged runs by direct transfer "
        f"(seeds {LOG_SEEDS}, 1 mm noise): **{verdict['verdict']}**, {effects or 'nothing'}; indistinguishable: "
        f"{verdict['equivalent']}. The network was fine-tuned on 2,000 transitions of the simulator with that effect "
        "(oracle: with the true one). Terminal error [cm], mean and standard deviation over seeds "
        f"{TASK_SEEDS}, which the diagnosis has not seen.",
        "",
        "| arm | U | S | Z |",
        "| --- | --- | --- | --- |",
    ]
    for label, spec in ARMS.items():
        cells = []
        for shape in "USZ":
            errors = [t.terminal_error_cm for t in trials if t.method == spec.name and t.scenario == shape]
            cells.append(f"{np.mean(errors):.2f} ± {np.std(errors):.2f} ({len(errors)})" if errors else "")
        lines.append(f"| {label} | {' | '.join(cells)} |")
    command = "python experiments/23_worth.py --report docs/results/worth.md"
    return page_of_results("What a diagnosis is worth", f"`{command}`", lines)


if __name__ == "__main__":
    main()
