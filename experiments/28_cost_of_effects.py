"""Measures what each effect costs a closed loop whose model does not know it: a bound on the gain of a diagnosis.

    python experiments/28_cost_of_effects.py --out runs/cost    # seed by seed; resumable
    python experiments/28_cost_of_effects.py --out runs/cost --report docs/results/cost_of_effects.md

The plant is MuJoCo in space with contact, with one effect of the library at a time. A person shows a letter on it: the
grippers go to the letter's poses, and the keypoints that the camera then reports are the target. The model knows
nothing of the effect; it is run without and with the online learner.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import pathlib
from collections.abc import Sequence

os.environ.setdefault("NPROC", "4")

import numpy as np

from cablejax.control.targets import Shape, straight_start
from cablejax.diagnose.motion_bounds import Bounds
from cablejax.diagnose.safe_motions import there_and_back
from cablejax.effects.given import parse_effect
from cablejax.residual import STATIC
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.simulate.play import played
from closed_loop.cases import PLANT_CHAIN
from closed_loop.methods import MethodSpec
from closed_loop.protocols import Task, letter_task
from closed_loop.suite import TRIALS, Case, read_suite, run_suite
from closed_loop.trials import Trial
from executors import add_option, executor_of
from pages import markdown_table, page_of_results, publish
from rows import made_on
from staged import EFFECTS

NONE = "none"
SHAPES: tuple[Shape, ...] = ("S", "Z")
SEEDS = (0, 1, 2)
STEPS, NEAR = 60, 0.5
"""Commands of a run, one a second; of the target [cm]."""
INTERVAL = 0.1
"""Between samples of the motion that shows a letter [s]."""
METHODS = (
    MethodSpec("no learner", "gns-conditioned"),
    MethodSpec("learner", "gns-conditioned", learner=STATIC),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/cost"))
    parser.add_argument("--report", type=pathlib.Path, help="write the page of the finished rows, and run nothing")
    add_option(parser)
    options = parser.parse_args()
    if options.report is not None:
        publish(page(read_suite(options.out)[0], made_on(options.out / TRIALS)), options.report)
        return
    with executor_of(options.executor) as executor:
        run_suite(cases(), METHODS, options.out, fine_tuned=_never, executor=executor)


def _never(case: Case):
    raise AssertionError(f"no method of this experiment is trained on {case.cable}")


def plant_with(text: str) -> Plant:
    """The plant with an effect, or without."""
    effects = () if text == NONE else (parse_effect(text),)
    return Plant(PlantConfig(discretisation=PLANT_CHAIN, effects=effects))


def cases() -> list[Case]:
    """Every effect, and none; letters from straight starts."""
    return [
        Case(
            table=text,
            scenario=shape,
            stiffness=1.0,
            seed=seed,
            task=functools.partial(shown_task, text, shape, seed),
            plant=functools.partial(plant_with, text),
            cable=text,
            steps=STEPS,
        )
        for seed in SEEDS
        for text in (NONE, *EFFECTS)
        for shape in SHAPES
    ]


def shown_task(text: str, shape: Shape, seed: int) -> Task:
    """A letter that a person has shown on the plant, from a straight start that depends on the seed."""
    task = letter_task(shape, seed, PLANT_CHAIN)
    return dataclasses.replace(task, target=dataclasses.replace(task.target, keypoints=shown(text, shape)))


@functools.lru_cache
def shown(text: str, shape: Shape) -> np.ndarray:
    """What the camera sees at the end of a rest in the letter's gripper poses [m]."""
    goal = letter_task(shape, 0, PLANT_CHAIN).target.gripper_pose
    poses = there_and_back(straight_start(), goal, bounds=Bounds())
    arrived = np.flatnonzero(np.abs(poses - goal).max(axis=(1, 2)) < 1e-6)
    poses = poses[: arrived[-1] + 1]
    twist = np.append(np.diff(poses, axis=0) / INTERVAL, np.zeros((1, 2, 3)), axis=0)
    return played(plant_with(text), poses[0], twist, INTERVAL, motion=shape).keypoints[-1]


def page(trials: Sequence[Trial], made: str) -> str:
    """The table, dearest effect first."""
    seeds = len({trial.seed for trial in trials})
    kept = {text: [trial for trial in trials if trial.table == text] for text in (NONE, *EFFECTS)}
    means = {text: [late(kept[text], method.name) for method in METHODS] for text in kept}
    ordered = sorted(EFFECTS, key=lambda text: -means[text][0])
    rows = [
        (
            f"`{text}`" if text != NONE else "no effect",
            *(f"{late(kept[text], m.name, shape):.2f}" for m in METHODS for shape in SHAPES),
            *(f"{seconds(kept[text], m.name):.0f}" for m in METHODS),
        )
        for text in (NONE, *ordered)
    ]
    head = (
        "effect",
        *(f"{shape}, {method.name} [cm]" for method in METHODS for shape in SHAPES),
        *(f"within {NEAR} cm, {method.name} [s]" for method in METHODS),
    )
    lines = [
        "The plant has an effect that the model does not know. The target is the camera's view of the plant led to a "
        f"letter. Means of {seeds} seeds: error of the last 10 s, and the time to within {NEAR} cm, "
        f"{STEPS} s for a run that never gets there. The extra cost of an effect bounds the gain from naming it.",
        "",
        *markdown_table([head, *rows]),
    ]
    command = "python experiments/28_cost_of_effects.py --report docs/results/cost_of_effects.md"
    return page_of_results("What an unknown effect costs", f"`{command}`", lines, made_on=made)


def late(trials: Sequence[Trial], method: str, shape: str | None = None) -> float:
    """Mean error of the last 10 s [cm]."""
    return float(
        np.mean([t.late_errors_cm.mean() for t in trials if t.method == method and shape in (None, t.scenario)])
    )


def seconds(trials: Sequence[Trial], method: str) -> float:
    """Mean time to `NEAR` [s]."""
    errors = [np.array(t.errors_cm) < NEAR for t in trials if t.method == method]
    return float(np.mean([float(np.argmax(near)) if near.any() else float(STEPS) for near in errors]))


if __name__ == "__main__":
    main()
