"""Measures what a diagnosis is worth: informs the model of the named cause, and shapes the cable again.

    python experiments/23_worth.py --out runs/worth     # seed by seed; resumable
    python experiments/23_worth.py --out runs/worth --report docs/results/worth.md

The plant is MuJoCo in space with contact, and has an effect that the model does not know. The target is the resting
shape of the plant's cable in a letter's gripper poses, as if a person had shown it. Six runs without a learner, 180 s
in all, are the log. The model of every arm but the last is `gns-conditioned`, which estimates stiffness and friction
online. All have the online learner; they differ by what the model was informed of (`cablejax shape --with
verdict.json`):

- `plain`: nothing;
- `diagnosed`: what the verdict on the log names, where that enters a model;
- `oracle`: the true effect;
- `recorded`: `gns-reference`, trained on the log's own 180 transitions with their noise, and let go of its symmetry
  where the effect has a side or an end.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
import os
import pathlib
import re
from collections.abc import Callable, Mapping, Sequence

os.environ.setdefault("NPROC", "4")

import jax.numpy as jnp
import numpy as np

from cablejax.cable import Cable
from cablejax.commands.runs import known_from
from cablejax.control.loop import run_closed_loop
from cablejax.control.shaping import Model, enters, knowing, load_model, make_controller
from cablejax.control.targets import Shape
from cablejax.diagnose import diagnose, write_verdict
from cablejax.effects.given import parse_effect
from cablejax.effects.verdicts import effects_of_verdict
from cablejax.gaplog import gap_log_from_episodes, read_gap_log, write_gap_log
from cablejax.residual import STATIC
from cablejax.simulate.chain.statics import clamped, resting_shapes, statics_with
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.types import GapLog, Trajectory
from closed_loop.cases import PLANT_CHAIN
from closed_loop.fine_tuning import FineTuneConfig, fine_tune
from closed_loop.methods import MethodSpec
from closed_loop.protocols import Task, letter_task
from closed_loop.statistics import PairedDifference, paired_difference
from closed_loop.suite import TRIALS, Case, read_suite, run_suite
from closed_loop.trials import Trial
from executors import add_option, executor_of
from pages import markdown_table, page_of_results, publish
from rows import made_on

EFFECTS = (
    "stiffness_profile:centre_m=0.3,width_m=0.25,ratio=0.2",
    "intrinsic_curvature:centre_m=0.6,width_m=0.3,curvature_per_m=2",
    "gripper_rotation_offset:gripper=1,angle_rad=0.15",
    "gripper_compliance:gripper=1,stiffness_n_m_per_rad=0.15",
)
"""What the plant has, by effect: where the cause changes what a cable is at rest, the oracle gains."""
LEARNED = ("bending_stiffness:ratio=0.1", "table_friction:coefficient=0.6")
"""Effects that the model estimates online anyway."""
LOG_SEEDS, SEEDS = (100, 101), tuple(range(20))
"""Of tasks: for the log, for the table."""
SHAPES = ("S", "Z")
NOISE = 1e-3
COMMANDS = 30
"""Of each run of the log, one a second."""
VERDICT = "verdict.json"
STEPS = 60
"""Commands of a run, one a second."""
NEAR = 0.5
"""Of the target [cm]."""
SETTLING = 8
"""Times that a letter is brought nearer to rest: more change it by less than a micrometre."""
ONLINE = " + learner"
"""Ends the names of the arms in their trials."""
MODEL = "gns-conditioned"
ARMS = tuple(
    MethodSpec(f"{kind}{ONLINE}", MODEL, learner=STATIC, fine_tuned=kind != "plain")
    for kind in ("plain", "diagnosed", "oracle", "recorded")
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/worth"))
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="number of the table's seeds to run")
    parser.add_argument("--report", type=pathlib.Path, help="write the page of the finished rows, and run nothing")
    add_option(parser)
    options = parser.parse_args()
    if options.report is not None:
        publish(page(options.out), options.report)
        return
    trials = options.out / "trials"
    with executor_of(options.executor) as executor:
        for effects in (EFFECTS, LEARNED):
            for seed, text in itertools.product(SEEDS[: options.seeds], effects):
                for spec in ARMS:
                    model = functools.partial(model_for, text, spec.name.removesuffix(ONLINE), options.out / slug(text))
                    own = cases(text, [seed])
                    run_suite(own, [spec], trials, fine_tuned=model, executor=executor, progress=False)
                print(f"seed {seed}, {text}: done", flush=True)


def slug(text: str) -> str:
    """A folder's name for an effect."""
    return re.sub(r"[^\w.-]+", "_", text)


def plant_with(text: str) -> Plant:
    """The plant with an effect."""
    return Plant(PlantConfig(discretisation=PLANT_CHAIN, effects=(parse_effect(text),)))


def shown_letter(text: str, shape: Shape, seed: int) -> Task:
    """The letter that the plant's cable makes where the letter's grippers are, from a straight start."""
    task, statics = letter_task(shape, seed, PLANT_CHAIN), statics_with((parse_effect(text),), Cable())
    keypoints, pose = jnp.asarray(task.target.keypoints), clamped(jnp.asarray(task.target.gripper_pose), statics)
    for _ in range(SETTLING):
        keypoints = resting_shapes(keypoints, pose, pose, length=Cable().length, statics=statics)[0]
    return dataclasses.replace(task, target=dataclasses.replace(task.target, keypoints=np.asarray(keypoints)))


def cases(text: str, seeds: Sequence[int], shapes: Sequence[str] = SHAPES) -> list[Case]:
    """Shown letters on the plant with an effect."""
    return [
        Case(
            table=text,
            scenario=shape,
            stiffness=1.0,
            seed=seed,
            task=functools.partial(shown_letter, text, shape, seed),  # pyright: ignore[reportArgumentType]
            plant=functools.partial(plant_with, text),
            cable=text,
            steps=STEPS,
        )
        for seed in seeds
        for shape in shapes
    ]


def model_for(text: str, kind: str, home: pathlib.Path, case: Case) -> Model:
    """The model of an arm."""
    del case
    if kind == "recorded":
        tuning = FineTuneConfig(symmetric=parse_effect(text).effect.symmetric)
        return fine_tune(transitions_of(log_of(text, home)), tuning, home / kind)
    model = load_model(MODEL)
    if kind == "oracle":
        return knowing(model, (parse_effect(text),))
    informed = known_from(model, (), (verdict_of(text, home),))
    # else nothing of what the verdict names enters it
    return knowing(model, informed) if enters(model, informed) else model


def log_of(text: str, home: pathlib.Path) -> GapLog:
    """Direct transfer on the plant, seen with noise, at 10 Hz."""
    path = home / "log.npz"
    if not path.exists():
        model, episodes, plant = load_model(MODEL), [], plant_with(text)
        for case in cases(text, LOG_SEEDS, "USZ"):
            task = case.task()
            controller = make_controller(model, task.target, method="direct", solver="levenberg-marquardt")
            run = run_closed_loop(
                plant, controller, task.target, COMMANDS, start=task.start_pose, record_hz=10.0, patience=None
            )
            rng = np.random.default_rng((case.seed, len(episodes)))
            noisy = run.episode.keypoints + rng.normal(0.0, NOISE, run.episode.keypoints.shape)
            episodes.append(dataclasses.replace(run.episode, keypoints=noisy))
        home.mkdir(parents=True, exist_ok=True)
        write_gap_log(path, gap_log_from_episodes(episodes, Cable(), source="direct transfer on a plant with contact"))
    return read_gap_log(path)


def verdict_of(text: str, home: pathlib.Path) -> pathlib.Path:
    """The verdict on the log."""
    path = home / VERDICT
    if not path.exists():
        write_verdict(path, diagnose(log_of(text, home)))
    return path


def transitions_of(log: GapLog) -> Trajectory:
    """The transitions of a log, a second apart."""
    every = round(1.0 / float(log.time[0, 1] - log.time[0, 0]))
    return Trajectory(
        np.asarray(log.keypoints[:, ::every], np.float32),  # pyright: ignore[reportArgumentType]
        np.asarray(log.gripper_pose[:, ::every], np.float32),  # pyright: ignore[reportArgumentType]
        np.asarray(log.gripper_command[:, :-1:every], np.float32),  # pyright: ignore[reportArgumentType]
    )


def page(out: pathlib.Path) -> str:
    """The page of what has been run."""
    trials = read_suite(out / "trials")[0]
    seeds = sorted({trial.seed for trial in trials})
    lines = [
        "The plant has an effect that the model does not know. The target is the resting shape of the plant's cable "
        "in a letter's gripper poses, as if shown by hand. A verdict on "
        f"six runs ({6 * COMMANDS} s, 1 mm noise, seeds {', '.join(map(str, LOG_SEEDS))}) informs the model "
        "of the arm *diagnosed*. That of *plain* is informed of nothing, that of *oracle* of the true effect, and that "
        f"of *recorded* is trained on the same six runs instead. All learn online. {len(seeds)} seeds"
        f"{_fewer(trials, len(seeds))}.",
        "",
    ]
    for title, measure in MEASURES.items():
        never = "" if measure is late else f" A run that never gets there counts {STEPS} s."
        table = [row for text in (*EFFECTS, *LEARNED) for row in rows_of(trials, text, measure)]
        lines += [
            f"## {title}",
            "",
            f"Mean, standard deviation, count.{never}",
            "",
            *markdown_table([["effect", "letter", *(spec.name.removesuffix(ONLINE) for spec in ARMS)], *table]),
            "",
            "Paired differences; negative: the first is nearer or sooner. Mean difference, 95 % interval over seeds, "
            "runs better / worse. The share is of the oracle's gain, if the gain's interval excludes 0.",
            "",
            *markdown_table(
                [
                    PAIRED_HEAD,
                    *(row for text in (*EFFECTS, *LEARNED) if (row := paired_row(trials, text, measure, out))),
                ]
            ),
            "",
        ]
    command = "python experiments/23_worth.py --out docs/results/trials/worth --report docs/results/worth.md"
    made = made_on(out / "trials" / TRIALS)
    return page_of_results("What a diagnosis is worth", f"`{command}`", lines, made_on=made)


def _fewer(trials: Sequence[Trial], count: int) -> str:
    """The effects of which fewer seeds have run."""
    seeds = {text: len({trial.seed for trial in trials if trial.table == text}) for text in (*EFFECTS, *LEARNED)}
    return "".join(f", {own} of `{text}`" for text, own in seeds.items() if 0 < own < count)


PAIRED_HEAD = (
    "effect",
    "named",
    "diagnosed less plain",
    "oracle less plain",
    "share",
    "diagnosed less recorded",
)

Values = Mapping[tuple[str, int], float]
"""By letter and seed."""


def late(trial: Trial) -> float:
    return float(trial.late_errors_cm.mean())


def seconds_to_near(trial: Trial) -> float:
    """When the error first is within `NEAR` [s]; the length of a run that never is there."""
    errors = np.array(trial.errors_cm)
    return float(np.argmax(errors < NEAR)) if (errors < NEAR).any() else float(STEPS)


MEASURES = {
    "Mean error of the last 10 s [cm]": late,
    f"Time to within {NEAR} cm [s]": seconds_to_near,
}


def measured(
    trials: Sequence[Trial],
    text: str,
    name: str,
    measure: Callable[[Trial], float],
    shapes: Sequence[str] = SHAPES,
) -> Values:
    return {
        (t.scenario, t.seed): measure(t)
        for t in trials
        if t.table == text and t.method == name and t.scenario in shapes
    }


def rows_of(trials: Sequence[Trial], text: str, measure: Callable[[Trial], float]) -> list[tuple[str, ...]]:
    """Rows of the table of all arms for one effect, by letter."""
    return [
        (
            f"`{text}`" if shape == SHAPES[0] else "",
            shape,
            *(cell(measured(trials, text, spec.name, measure, shape)) for spec in ARMS),
        )
        for shape in SHAPES
    ]


def cell(values: Values) -> str:
    numbers = np.array(list(values.values()))
    return f"{numbers.mean():.2f} ± {numbers.std(ddof=1):.2f} ({len(numbers)})" if len(numbers) else ""


def paired_row(
    trials: Sequence[Trial], text: str, measure: Callable[[Trial], float], out: pathlib.Path
) -> tuple[str, ...] | None:
    """One effect's row of paired differences; None before its arms have run."""
    plain, diagnosed, oracle, recorded = (measured(trials, text, spec.name, measure) for spec in ARMS)
    if not (plain and diagnosed and oracle):
        return None
    ours, best = paired(diagnosed, plain), paired(oracle, plain)
    return (
        f"`{text}`",
        ", ".join(f"`{effect}`" for effect in effects_of_verdict(out / slug(text) / VERDICT)),
        difference_text(ours),
        difference_text(best),
        f"{100 * ours.mean / best.mean:.0f} %" if best.interval.high < 0 else "no gain",
        difference_text(paired(diagnosed, recorded)) if recorded else "",
    )


def paired(method: Values, reference: Values) -> PairedDifference:
    return paired_difference(method, reference, cluster=lambda key: key[1])


def difference_text(one: PairedDifference) -> str:
    return f"{one.mean:+.2f} ({one.interval.low:+.2f} to {one.interval.high:+.2f}), {one.better} / {one.worse}"


if __name__ == "__main__":
    main()
