"""Stages every effect in the contact plant, diagnoses it, and adds the named effects to the engine that makes data.

    python experiments/24_named_is_added.py --rows ROWS.jsonl    # a minute or two per effect; resumable
    python experiments/24_named_is_added.py --rows ROWS.jsonl --report PAGE.md

For each of the 22 effects the plant executes nine motions. Six of them are the log that is diagnosed (1 mm noise); the
other three are held out, without noise. The effects of `verdict.json` are then added to the engine that makes training
data, as `cablejax simulate --with verdict.json --engine chain` does, and the held-out commands are replayed open loop,
with and without them. `floor` is the engine's error where neither has an effect: the plant is another simulator.

The log is diagnosed once more in other units of length, as one of a short and one of a long cable that move alike.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import tempfile
from typing import Any

os.environ.setdefault("NPROC", "4")

import numpy as np
from jaxtyping import Float

from blind.motions import INTERVAL, Commands, draw_motion
from blind.rod import arch
from cablejax.cable import Discretisation
from cablejax.diagnose import CableDiagnosis, diagnose, write_verdict
from cablejax.effects.given import GivenEffect, parse_effect, with_effects
from cablejax.effects.physics import nominal_physics
from cablejax.effects.verdicts import effects_of_verdict
from cablejax.gaplog import Episode, gap_log_from_episodes
from cablejax.simulate import ChainEngine
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.simulate.play import played
from cablejax.types import GapLog
from executors import add_option, executor_of
from pages import markdown_table, page_of_results, publish
from rows import Rows, made_on
from staged import EFFECTS, similar

LOGGED = ("approach_s", "mirror_approach_s", "overload_return", "translation", "ramp_hold", "taut")
HELD_OUT = ("approach_u", "overload_return", "taut")
SEED, NOISE = 24, 1e-3
SIZES = (0.25, 4.0)
"""Lengths of the similar cables [m]; that of the plant is 1 m."""
PLANT = Discretisation(n_links=24, dimension=3, timestep=0.005)
ENGINE = Discretisation()


def motions() -> tuple[list[Commands], list[Commands]]:
    """The commands of the log and those held out; the same for every effect."""
    rng = np.random.default_rng(SEED)
    every = [draw_motion(rng, name, ENGINE.cable.length) for name in (*LOGGED, *HELD_OUT)]
    return every[: len(LOGGED)], every[len(LOGGED) :]


def recorded(commands: Commands, effects: tuple[GivenEffect, ...], noise: np.random.Generator | None) -> Episode:
    """One motion of the plant; keypoints with noise unless `noise` is None."""
    return played(
        Plant(PlantConfig(discretisation=PLANT, effects=effects)),
        commands.start,
        commands.twist,
        INTERVAL,
        motion=commands.motion,
        hold=commands.hold,
        # several shapes fit some starts; every motion begins with a gentle arch
        guess=arch(commands.start, ENGINE.cable.length, 2 * PLANT.n_links),
        noise=0.0 if noise is None else NOISE,
        random=noise,
    )


def replayed(commands: Commands, effects: tuple[GivenEffect, ...]) -> Float[np.ndarray, "T N 2"]:
    """The same commands in the engine that makes training data, open loop from the settled start."""
    engine = ChainEngine(ENGINE)
    physics = with_effects(nominal_physics(ENGINE), effects, ENGINE)
    between = ENGINE.cable.n_keypoints - 1
    guess = arch(commands.start, ENGINE.cable.length, 10 * between)[::10]
    state = engine.initial_state(commands.start, guess=guess)
    _, trajectory = engine.rollout(physics, state, commands.twist[:-1].astype(np.float32), INTERVAL)
    return np.asarray(trajectory.keypoints, float)


def error_mm(held_out: list[Commands], truth: list[np.ndarray], effects: tuple[GivenEffect, ...]) -> float:
    """Root mean square of the engine's keypoints against the plant's, per coordinate [mm]."""
    off = [replayed(commands, effects) - true for commands, true in zip(held_out, truth, strict=True)]
    return float(1e3 * np.sqrt(np.mean(np.concatenate([o.ravel() for o in off]) ** 2)))


def said(diagnosis: CableDiagnosis) -> dict[str, Any]:
    """Verdict, named effects and the whole set."""
    named = [effect.name for effect in diagnosis.effects]
    every = sorted({*named, *(name for group in diagnosis.equivalent for name in group)})
    return {"verdict": diagnosis.verdict, "named": named, "set": every}


def examine(text: str) -> dict[str, Any]:
    """The row of one staged effect, or of none ("none")."""
    effects = () if text == "none" else (parse_effect(text),)
    logged, held_out = motions()
    noise = np.random.default_rng(np.random.SeedSequence(SEED, spawn_key=(1,)))
    log: GapLog = gap_log_from_episodes(
        [recorded(commands, effects, noise) for commands in logged], ENGINE.cable, source="contact plant"
    )
    diagnosis = diagnose(log)
    truth = [recorded(commands, effects, None).keypoints for commands in held_out]
    before = error_mm(held_out, truth, ())
    after, added = before, ()
    if diagnosis.effects:
        with tempfile.TemporaryDirectory() as folder:
            added = effects_of_verdict(write_verdict(pathlib.Path(folder) / "verdict.json", diagnosis))
        after = error_mm(held_out, truth, added)
    return {
        **said(diagnosis),
        "similar": {f"{size:g}": said(diagnose(similar(log, size))) for size in SIZES},
        "added": [str(effect) for effect in added],
        "fitting_shrinkage": diagnosis.gap.shrinkage,
        "before_mm": before,
        "after_mm": after,
    }


def page(rows: list[dict[str, Any]], made: str) -> str:
    """The table, with how many of the staged effects are in the set, and the median of the shrinkage."""
    by_name = {row["effect"]: row for row in rows}
    floor = by_name["none"]["before_mm"] if "none" in by_name else 0.0
    table, hits, ratios, alike = [], 0, [], dict.fromkeys((f"{size:g}" for size in SIZES), 0)
    for text in EFFECTS:
        row = by_name.get(text)
        if row is None:
            continue
        name = text.partition(":")[0]
        hit = name in row["set"]
        hits += hit
        for size, other in row["similar"].items():
            alike[size] += name in other["set"]
        gap, left = row["before_mm"] ** 2 - floor**2, row["after_mm"] ** 2 - floor**2
        shrinkage = 1 - left / gap if gap > floor**2 else None
        fitting = row["fitting_shrinkage"]
        if shrinkage is not None and fitting:
            ratios.append(shrinkage / fitting)
        table.append(
            [
                f"`{text}`",
                row["verdict"],
                ", ".join(row["named"]) or "-",
                "yes" if hit else "no",
                *("yes" if name in other["set"] else "no" for other in row["similar"].values()),
                f"{row['before_mm']:.2f}",
                f"{row['after_mm']:.2f}",
                "not resolved" if shrinkage is None else f"{shrinkage:.2f}",
                "-" if fitting is None else f"{fitting:.2f}",
            ]
        )
    head = [
        "staged",
        "verdict",
        "named",
        "in the set",
        *(f"at {size:g} m" for size in SIZES),
        "before [mm]",
        "after [mm]",
        "shrinkage",
        "in the fit's simulator",
    ]
    share = f"{np.median(ratios):.2f}" if ratios else "-"
    lines = [
        f"{hits} of {len(table)} staged effects are in the reported set. The gap shrinks in the engine that makes data",
        f"by {share} times as much as in the fitting simulator (median of {len(ratios)} effects).",
        "",
        "The same logs in other units of length, those of cables that move alike: the effect is in the set of",
        f"{' and '.join(f'{count} of {len(table)} at {size} m' for size, count in alike.items())}.",
        "",
        f"One log each, six motions, {1e3 * NOISE:g} mm noise, seed {SEED}. Errors are root mean squares per",
        f"coordinate on three held-out motions without noise. The floor, {floor:.2f} mm, is the engine's error",
        "without any effect. Shrinkage is `1 - (after^2 - floor^2) / (before^2 - floor^2)`, not resolved if",
        "the gap is below 1.4 times the floor.",
        "",
        *markdown_table([head, *table]),
    ]
    if "none" in by_name:
        lines += ["", f"Without a staged effect the verdict is **{by_name['none']['verdict']}**."]
    return page_of_results(
        "What is named is added",
        "`python experiments/24_named_is_added.py --rows docs/results/named_is_added.jsonl` and "
        "`--report docs/results/named_is_added.md`",
        lines,
        made_on=made,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=pathlib.Path, required=True, help="file of the finished rows")
    parser.add_argument("--report", type=pathlib.Path, help="write the page of the finished rows, and run nothing")
    parser.add_argument("--seconds", type=float, default=np.inf, help="begin no further row after this time")
    add_option(parser)
    options = parser.parse_args()
    rows = Rows(options.rows, ("effect",))
    if options.report is not None:
        publish(page(rows.read(), made_on(options.rows)), options.report)
        return
    wanted = [(text,) for text in ("none", *EFFECTS)]
    with executor_of(options.executor) as executor:
        rows.run(rows.missing(wanted), examine, executor=executor, seconds=options.seconds)


if __name__ == "__main__":
    main()
