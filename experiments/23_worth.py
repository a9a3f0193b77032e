"""What a diagnosis is worth: name the cause, put it into the simulator, train on new data, shape the cable again.

    python experiments/23_worth.py --select     # where an oracle gains at all: 13 effects, three seeds each
    python experiments/23_worth.py              # all arms on the effects `CHOSEN`, twenty other seeds each
    python experiments/23_worth.py --report docs/results/worth.md

The plant is MuJoCo in space with contact, and an effect that the model does not know. Six runs by direct transfer, 180
s in all, are its log. The arms differ by what the released network was trained on besides, and by the online learner:

- `direct`: nothing, and nothing is learned online;
- `diagnosed`: 2,000 transitions of the simulator, each trajectory with another draw of the verdict's posterior;
- `oracle`: the same with the true effect;
- `recorded`: the log's own 180 transitions, with their noise.

Everything is resumable; `--effects` names others, so that two processes may share the work.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import pathlib
import re
from collections.abc import Mapping, Sequence

os.environ.setdefault("NPROC", "4")

import numpy as np

from cablejax.cable import Cable
from cablejax.control.loop import run_closed_loop
from cablejax.control.shaping import Model, load_model, make_controller
from cablejax.dataset.generate import make_engine, simulate
from cablejax.dataset.schema import DatasetConfig
from cablejax.diagnose import diagnose, write_verdict
from cablejax.effects.given import GivenEffect, parse_effect, posterior_of_verdict
from cablejax.gaplog import gap_log_from_episodes, read_gap_log, write_gap_log
from cablejax.residual import LearnerConfig
from cablejax.simulate.motions import MotionConfig
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.types import GapLog, Trajectory
from closed_loop.cases import PLANT_CHAIN
from closed_loop.fine_tuning import FineTuneConfig, fine_tune
from closed_loop.methods import MethodSpec
from closed_loop.protocols import letter_task
from closed_loop.statistics import PairedDifference, paired_difference
from closed_loop.suite import Case, read_suite, run_suite
from closed_loop.trials import Trial
from pages import markdown_table, page_of_results, publish

Effects = tuple[GivenEffect, ...]

EFFECTS = (
    "bending_stiffness:ratio=0.1",
    "stiffness_profile:centre_m=0.3,width_m=0.25,ratio=0.2",
    "intrinsic_curvature:centre_m=0.6,width_m=0.3,curvature_per_m=2",
    "plasticity:yield_curvature_per_m=3,hardening=0.3",
    "table_friction:coefficient=0.6",
    "friction_patch:x_m=0,y_m=0.15,radius_m=0.2,coefficient=0.8",
    "gravity_tilt:angle_rad=0.15,direction_rad=1",
    "gripper_slip:gripper=1,time_s=0.5,distance_m=-0.03",
    "gripper_rotation_offset:gripper=1,angle_rad=0.15",
    "gripper_compliance:gripper=0,stiffness_n_m_per_rad=0.15",
    "actuation_gain:gain=0.85",
    "actuation_lag:time_s=0.4,delay_s=0.2",
    "camera_similarity:scale=1.03,angle_rad=0.05,x_m=0.01,y_m=-0.01",
)
"""Effects that an oracle is asked about."""
CHOSEN: tuple[str, ...] = ()
"""Those of them on which it gains most: for the table of all arms."""
LOG_SEEDS, SELECTION_SEEDS, SEEDS = (100, 101), (102, 103, 104), tuple(range(20))
"""Of tasks: for the log, for the choice of effects, for the table."""
SHAPES = ("S", "Z")
NOISE = 1e-3
COMMANDS = 30
"""Of each run of the log, one a second."""
ONLINE = " + online learner"
MODELS = ("direct", "diagnosed", "oracle", "recorded")
ARMS = {
    name: MethodSpec(
        name, "gns-reference", learner=LearnerConfig() if name.endswith(ONLINE) else None, fine_tuned=kind != "direct"
    )
    for kind in MODELS
    for name in (kind, kind + ONLINE)
}
LEARNER = f"direct{ONLINE}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/worth"))
    parser.add_argument("--select", action="store_true", help="online learner and oracle only, on the seeds for that")
    parser.add_argument("--effects", nargs="*", help="these, as NAME:PARAMETER=VALUE,...")
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="so many of the table's seeds")
    parser.add_argument("--report", type=pathlib.Path, help="run nothing; write the page on what is done to this file")
    options = parser.parse_args()
    if options.report is not None:
        publish(page(options.out), options.report)
        return
    seeds = SELECTION_SEEDS if options.select else SEEDS[: options.seeds]
    arms = (LEARNER, f"oracle{ONLINE}") if options.select else tuple(ARMS)
    for text in options.effects or (EFFECTS if options.select else CHOSEN):
        for arm in arms:
            trained = functools.partial(trained_for, text, arm.removesuffix(ONLINE), options.out / slug(text))
            run_suite(cases(text, seeds), [ARMS[arm]], options.out / "trials", fine_tuned=trained)


def slug(text: str) -> str:
    """A folder's name for an effect."""
    return re.sub(r"[^\w.-]+", "_", text)


def plant_with(text: str) -> Plant:
    """The plant with an effect."""
    return Plant(PlantConfig(discretisation=PLANT_CHAIN, effects=(parse_effect(text),)))


def cases(text: str, seeds: Sequence[int], shapes: Sequence[str] = SHAPES) -> list[Case]:
    """Letters from straight starts, on the plant with an effect."""
    return [
        Case(
            table=text,
            scenario=shape,
            stiffness=1.0,
            seed=seed,
            task=functools.partial(letter_task, shape, seed, PLANT_CHAIN),  # pyright: ignore[reportArgumentType]
            plant=functools.partial(plant_with, text),
            cable=text,
            steps=60,
        )
        for seed in seeds
        for shape in shapes
    ]


def trained_for(text: str, kind: str, home: pathlib.Path, case: Case) -> Model:
    """The released network after training on what an arm's model is trained on."""
    del case
    config = FineTuneConfig()
    if kind == "recorded":
        return fine_tune(transitions_of(log_of(text, home)), config, home / kind)
    posterior = ((parse_effect(text),),) if kind == "oracle" else verdict_of(text, home)[1]
    if not posterior:
        return load_model("gns-reference")
    return fine_tune(transitions(posterior, config), config, home / kind)


def log_of(text: str, home: pathlib.Path) -> GapLog:
    """Direct transfer on the plant, seen with noise, at 10 Hz."""
    path = home / "log.npz"
    if not path.exists():
        model, episodes, plant = load_model("gns-reference"), [], plant_with(text)
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


def verdict_of(text: str, home: pathlib.Path) -> tuple[dict, tuple[Effects, ...]]:
    """The verdict on the log and draws of its posterior; none where it names nothing."""
    path = home / "verdict.json"
    if not path.exists():
        write_verdict(path, diagnose(log_of(text, home)))
    verdict = json.loads(path.read_text(encoding="utf-8"))
    return verdict, posterior_of_verdict(path) if verdict["effects"] else ()


def transitions(posterior: tuple[Effects, ...], config: FineTuneConfig) -> Trajectory:
    """Random motions of the simulated cable, each with another draw, as many as `FineTuneConfig` says."""
    data = DatasetConfig(
        n_trajectories=config.trajectories,
        n_steps=config.commands,
        seed=config.seed,
        motion=MotionConfig(start="straight"),
        engine="chain",
        shard_size=config.trajectories,
        posterior=posterior,
    )
    (block,) = simulate(data, make_engine(data), [0])
    return Trajectory(block.keypoints, block.gripper_pose, block.gripper_twist)  # pyright: ignore[reportArgumentType]


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
    lines = [
        "The model is the released network `gns-reference`, corrected online or not; the plant has an effect that the "
        "model does not know. Errors are means of the last 10 s [cm] on S and Z from random straight starts, at equal "
        "seeds.",
        "",
        "## Where adding the cause can pay",
        "",
        f"Seeds {listed(SELECTION_SEEDS)}. The oracle's network was trained on 2,000 transitions more, with "
        "the true effect in the simulator. Negative differences are in its favour, with a 95 % interval over "
        "seeds.",
        "",
        *markdown_table([("effect", "online learner", "oracle + online learner", "difference"), *selection(trials)]),
    ]
    table = [row for text in EFFECTS for row in arms_of(trials, text, out)]
    if table:
        head = ("effect", "letter", *(arm.replace(ONLINE, " + learner") for arm in ARMS))
        lines += ["", "## What the diagnosis is worth", "", *ABOUT_ARMS, "", *markdown_table([head, *table])]
        lines += ["", *markdown_table([PAIRED_HEAD, *paired_rows(trials, out)])]
    return page_of_results("What a diagnosis is worth", f"`python {command()}`", lines)


ABOUT_ARMS = (
    f"Seeds {SEEDS[0]} to {SEEDS[-1]}, apart from those of the choice above and of the log. The diagnosis sees six",
    f"runs by direct transfer, {6 * COMMANDS} s, with 1 mm noise; *recorded* is trained on the same {6 * COMMANDS}",
    "transitions.",
)
PAIRED_HEAD = (
    "effect",
    "verdict",
    "diagnosed less learner alone",
    "oracle less learner alone",
    "share of the oracle's gain",
    "diagnosed less recorded",
)
"""Of the table of paired differences: all arms in it with the online learner."""


def command() -> str:
    return "experiments/23_worth.py --report docs/results/worth.md"


def listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


def late(trials: Sequence[Trial], text: str, arm: str, seeds: Sequence[int]) -> dict[tuple[str, int], float]:
    """Mean errors of the last 10 s by letter and seed [cm]."""
    return {
        (t.scenario, t.seed): float(t.late_errors_cm.mean())
        for t in trials
        if t.table == text and t.method == arm and t.seed in seeds
    }


def selection(trials: Sequence[Trial]) -> list[tuple[str, ...]]:
    rows = []
    for text in EFFECTS:
        plain, oracle = (late(trials, text, arm, SELECTION_SEEDS) for arm in (LEARNER, f"oracle{ONLINE}"))
        if plain and oracle:
            row = difference_text(paired(oracle, plain))
            rows.append((f"`{text}`", mean_text(plain), mean_text(oracle), row))
    return rows


def arms_of(trials: Sequence[Trial], text: str, out: pathlib.Path) -> list[tuple[str, ...]]:
    """Rows of the table of all arms for one effect, by letter."""
    del out
    rows = []
    for shape in SHAPES:
        cells = []
        for arm in ARMS:
            values = {key: value for key, value in late(trials, text, arm, SEEDS).items() if key[0] == shape}
            cells.append(mean_text(values) if values else "")
        if any(cells[2:]):
            rows.append((f"`{text}`" if shape == SHAPES[0] else "", shape, *cells))
    return rows


def paired_rows(trials: Sequence[Trial], out: pathlib.Path) -> list[tuple[str, ...]]:
    rows = []
    for text in EFFECTS:
        learner, diagnosed, oracle, recorded = (
            late(trials, text, f"{kind}{ONLINE}", SEEDS) for kind in ("direct", "diagnosed", "oracle", "recorded")
        )
        if not diagnosed:
            continue
        ours, best = paired(diagnosed, learner), paired(oracle, learner)
        share = f"{100 * ours.mean / best.mean:.0f} %" if best.interval.high < 0 else "no gain"
        verdict = verdict_of(text, out / slug(text))[0]
        names = " + ".join(effect["name"] for effect in verdict["effects"])
        rows.append(
            (
                f"`{text}`",
                f"{verdict['verdict']}: {names}" if names else verdict["verdict"],
                difference_text(ours),
                difference_text(best),
                share,
                difference_text(paired(diagnosed, recorded)),
            )
        )
    return rows


def paired(method: Mapping[tuple[str, int], float], reference: Mapping[tuple[str, int], float]) -> PairedDifference:
    return paired_difference(method, reference, cluster=lambda key: key[1])


def difference_text(one: PairedDifference) -> str:
    return f"{one.mean:+.2f} ({one.interval.low:+.2f} to {one.interval.high:+.2f}), {one.pairs} pairs"


def mean_text(values: Mapping[tuple[str, int], float]) -> str:
    numbers = np.array(list(values.values()))
    return f"{numbers.mean():.2f} ± {numbers.std():.2f} ({len(numbers)})"


if __name__ == "__main__":
    main()
