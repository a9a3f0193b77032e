"""Compares designed next motions with Fisher-optimal and random safe ones, on effects that look alike.

    python experiments/25_next_motion.py --seeds 20 --executor 2    # three to seven minutes a seed; resumable
    python experiments/25_next_motion.py --report docs/results/next_motion.md

For every seed an effect is drawn from those that one log hardly separates, and staged in the contact plant (MuJoCo in
space) or in the rod of the blind check, which shares no code with the package, five seeds each in turn. The first log
has three motions; after its diagnosis one motion is added, and after the next another one, as long as `cablejax study`
would go on. The arms differ by that motion only:

- `designed`: most information about which explanation holds, within the bounds;
- `fisher`: the same search for most information about the parameters of the most probable explanation;
- `random`: one of the safe motions that keep the bounds, drawn at random.

Constants of the search were chosen on seed 0; the table has the seeds from 1 on. Densities and drags were made larger
after those of seeds 2, 3 and 8 had made no gap, or hardly one.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import pathlib
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

os.environ.setdefault("NPROC", "4")

import numpy as np
from jaxtyping import Float

from blind.effects import Setup
from blind.motions import INTERVAL, Commands, draw_motion
from blind.record import family_a, record
from blind.rod import arch
from blind.world import World
from cablejax.cable import Discretisation
from cablejax.diagnose import CableDiagnosis, diagnose
from cablejax.diagnose.motion_bounds import Bounds, cable_beyond, grippers_beyond
from cablejax.diagnose.motion_judge import Objective
from cablejax.diagnose.safe_motions import safe_motions, starting_pose
from cablejax.diagnose.study import ended, left_open
from cablejax.effects.given import parse_effect
from cablejax.gaplog import Episode, gap_log_from_episodes
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.simulate.play import played, settled
from executors import add_option, executor_of
from pages import markdown_table, page_of_results, publish
from rows import Rows, made_on

ARMS: dict[str, Objective | None] = {"designed": "explanations", "fisher": "parameters", "random": None}
"""What the search maximises; None = no search."""
FIRST = ("approach_s", "mirror_approach_s", "overload_return")
"""Motions of the first log."""
ADDED = 2
"""Motions that are added one by one."""
ROWS = pathlib.Path("docs") / "results" / "trials" / "next_motion.jsonl"
NOISE = 1e-3
SEED = 25
PLANT = Discretisation(n_links=24, dimension=3, timestep=0.005)
CABLE = PLANT.cable
BOUNDS = Bounds(workspace=((-0.5, -0.8), (1.4, 0.8)), keep_out=((0.45, -0.55, 0.08),), max_distance=0.99 * CABLE.length)
RANGES = {
    "table_friction:coefficient": (0.25, 0.5),
    "bending_stiffness:ratio": (0.15, 0.4),
    "linear_density:ratio": (3.5, 7.0),
    "viscous_drag:coefficient_n_s_per_m2": (15.0, 40.0),
    "bending_damping:time_s": (1.5, 5.0),
}
"""Effects that look alike, and where their parameter is drawn from: strong enough to make a gap on the first log."""
INSEPARABLE = {"bending_stiffness", "linear_density"}
"""A uniform cable in slow motion shows only the ratio of stiffness to density and friction."""


def staged(seed: int) -> str:
    """The effect of a seed."""
    rng = np.random.default_rng([SEED, seed])
    name = list(RANGES)[seed % len(RANGES)]
    return f"{name}={np.exp(rng.uniform(*np.log(RANGES[name]))):.3g}"


def family(seed: int) -> str:
    """What a seed's effect is staged in."""
    return ("contact plant", "rod")[(seed - 1) // len(RANGES) % 2]


def rod_with(effect: str) -> World:
    """The rod's cable and table with an effect."""
    name, value = effect.split("=")[0], float(effect.split("=")[1])
    plain = World()
    changes = {
        "table_friction:coefficient": {"friction": value},
        "bending_stiffness:ratio": {"stiffness": plain.stiffness * value},
        "linear_density:ratio": {"linear_density": plain.linear_density * value},
        "viscous_drag:coefficient_n_s_per_m2": {"drag": value},
        "bending_damping:time_s": {"damping_time": value},
    }
    return dataclasses.replace(plain, **changes[name])


class SetUp:
    """One seed's plant, and the motions that have been recorded on it."""

    def __init__(self, seed: int):
        self.text, self._seed = staged(seed), seed
        self._plant = (
            Plant(PlantConfig(discretisation=PLANT, effects=(parse_effect(self.text),)))
            if family(seed) == "contact plant"
            else rod_with(self.text)
        )
        self.episodes: list[Episode] = []
        rng = np.random.default_rng([SEED, seed, 1])
        for name in FIRST:
            commands = draw_motion(rng, name, CABLE.length)
            guess = arch(commands.start, CABLE.length, 2 * PLANT.n_links)
            self._record(commands.start, commands.twist, name, guess=guess)

    def add(self, poses: Float[np.ndarray, "T 2 3"], name: str) -> dict[str, float]:
        """Records a motion; returns by how much its execution breaks each bound."""
        twist = np.append(np.diff(poses, axis=0) / INTERVAL, np.zeros((1, 2, 3)), axis=0)
        self._record(poses[0], twist, name)
        done = self.episodes[-1]
        planar = Discretisation(CABLE)
        # what a camera sees with noise is taken without it
        clean = self._clean[None]
        return grippers_beyond(BOUNDS, planar, poses, INTERVAL) | cable_beyond(BOUNDS, planar, done.gripper_pose, clean)

    def _record(self, start: np.ndarray, twist: np.ndarray, name: str, *, guess: np.ndarray | None = None) -> None:
        if isinstance(self._plant, World):
            still = settled(twist, INTERVAL)
            made = record(Setup(self._plant), [Commands(name, start, twist, still)], family_a)
            time = INTERVAL * np.arange(len(twist))
            episode = Episode(name, time, made.keypoints[0], made.pose[0], twist, still)
        else:
            episode = played(self._plant, start, twist, INTERVAL, motion=name, guess=guess)
        noise = np.random.default_rng([SEED, self._seed, 2, len(self.episodes)])
        self._clean = episode.keypoints
        seen = episode.keypoints + NOISE * noise.standard_normal(episode.keypoints.shape)
        self.episodes.append(
            Episode(name, episode.time, seen, episode.gripper_pose, episode.gripper_command, episode.hold)
        )

    def diagnosed(self, objective: Objective | None) -> CableDiagnosis:
        """The diagnosis of all that was recorded, with the next motion by this objective."""
        log = gap_log_from_episodes(self.episodes, CABLE, source=family(self._seed))
        return diagnose(log, bounds=None if objective is None else BOUNDS, objective=objective or "explanations")


def examine(seed: int, arm: str) -> dict[str, Any]:
    """The row of one seed and arm."""
    case, rng = SetUp(seed), np.random.default_rng([SEED, seed, 3])
    truth, logs, broken = case.text.partition(":")[0], [], []
    for added in range(ADDED + 1):
        begin = time.perf_counter()
        found = case.diagnosed(ARMS[arm])
        named = [effect.name for effect in found.effects]
        following = found.next_motion
        # only the motion that the package recommends is judged for what it separates
        inseparable = ARMS[arm] == "explanations" and following is not None and following.inseparable
        logs.append(
            {
                "verdict": found.verdict,
                "named": named,
                "set": sorted({*named, *(name for group in found.equivalent for name in group)}),
                "open": left_open(found),
                "inseparable": None if following is None else following.inseparable,
                "next": None if following is None else following.motion,
                "information": None if following is None else following.information,
                "doubt": None if following is None else following.doubt,
                "seconds": time.perf_counter() - begin,
                "ended": ended(found, {"inseparable": inseparable}, rounds_left=ADDED - added),
            }
        )
        if logs[-1]["ended"]:
            break
        if ARMS[arm] is None or following is None:
            first = starting_pose(found.log.gripper_pose)
            safe = {
                name: poses
                for name, poses in safe_motions(Discretisation(CABLE), first, bounds=BOUNDS).items()
                if not grippers_beyond(BOUNDS, Discretisation(CABLE), poses, INTERVAL)
            }
            name = str(rng.choice(sorted(safe)))
            broken.append(case.add(safe[name], name))
        else:
            broken.append(case.add(following.poses, following.motion))
    return {"effect": case.text, "family": family(seed), "truth": truth, "logs": logs, "broken": broken}


def after(row: dict[str, Any], added: int) -> dict[str, Any]:
    """Result of a row after at most so many added motions."""
    return row["logs"][min(added, made_in(row))]


def made_in(row: dict[str, Any]) -> int:
    """Number of motions that are added until the study ends."""
    return len(row["logs"]) - 1


def answered(row: dict[str, Any], added: int) -> bool:
    """Whether after at most so many added motions only the truth is left, and what nothing could separate from it."""
    left = after(row, added)["open"]
    others = set(left) - {row["truth"]}
    return row["truth"] in left and (not others or {row["truth"], *others} == INSEPARABLE)


def needed(row: dict[str, Any]) -> float:
    """Motions after which a row is first `answered`; infinite = not reached."""
    return next((added for added in range(len(row["logs"])) if answered(row, added)), np.inf)


def table_of_needs(rows: Sequence[dict[str, Any]]) -> list[list[str]]:
    """By arm: seeds that are answered after so many motions, or wrongly, and the median of motions for the rest."""
    first = {row["seed"] for row in rows if needed(row) == 0}
    head = ["arm", "by the first log", *(f"with {n} more motion{'s' * (n > 1)}" for n in range(1, ADDED + 1))]
    table = [[*head, "one explanation left in the end, and wrong", "motions that the others need, median"]]
    for arm in dict.fromkeys(row["arm"] for row in rows):
        needs = {row["seed"]: needed(row) for row in rows if row["arm"] == arm}
        own = [row for row in rows if row["arm"] == arm]
        counts = [f"{sum(answered(row, added) for row in own)} of {len(own)}" for added in range(ADDED + 1)]
        last = [(after(row, ADDED)["open"], row["truth"]) for row in own]
        wrong = sum(len(left) == 1 and left != [truth] for left, truth in last)
        median = np.median([n for seed, n in needs.items() if seed not in first] or [0])
        table.append(
            [arm, *counts, f"{wrong} of {len(own)}", f"{median:g}" if median <= ADDED else f"more than {ADDED}"]
        )
    return table


def page(rows: Sequence[dict[str, Any]], machines: str) -> str:
    """Set sizes and truth in the set by arm and number of added motions, over seeds that all arms have."""
    arms = [arm for arm in ARMS if any(row["arm"] == arm for row in rows)]
    common = set.intersection(*({row["seed"] for row in rows if row["arm"] == arm} for arm in arms)) if arms else set()
    head = [
        "arm",
        "motions at most",
        "made, mean",
        "set size, median (mean)",
        "truth in the set",
        "without those below 1 %: size, median (mean)",
        "truth among them",
        "the truth alone",
        "several, called inseparable",
    ]
    table = [head]
    for arm in arms:
        own = [row for row in rows if row["arm"] == arm and row["seed"] in common]
        for added in range(ADDED + 1):
            made = np.mean([min(added, made_in(row)) for row in own])
            cells = [f"{arm}", f"{added}", f"{made:.1f}"]
            for kind in ("set", "open"):
                sets = [(after(row, added)[kind], row["truth"]) for row in own]
                sizes, hits = [len(names) for names, _ in sets], [truth in names for names, truth in sets]
                cells += [f"{np.median(sizes):.1f} ({np.mean(sizes):.1f})", f"{sum(hits)} of {len(hits)}"]
            alone = [after(row, added)["open"] == [row["truth"]] for row in own]
            called = ""
            if ARMS[arm] == "explanations":
                several = [log for log in (after(row, added) for row in own) if len(log["open"]) > 1]
                called = f"{sum(bool(log['inseparable']) for log in several)} of {len(several)}"
            table.append([*cells, f"{sum(alone)} of {len(alone)}", called])
    gapless = sorted({row["seed"] for row in rows if row["seed"] in common and row["logs"][0]["verdict"] == "none"})
    families = Counter(family(seed) for seed in common)
    moved = [(row["arm"], broken) for row in rows if row["seed"] in common for broken in row["broken"]]
    kept = {arm: [not broken for name, broken in moved if name == arm] for arm in arms}
    bounds = ", ".join(f"{arm} {sum(k)} of {len(k)}" for arm, k in kept.items())
    lines = [
        f"{len(common)} seeds, {len(RANGES)} effects in turn, "
        + " and ".join(f"{count} in the {name}" for name, count in sorted(families.items()))
        + f", {1e3 * NOISE:g} mm noise; the first log has "
        f"{len(FIRST)} motions. Motions that kept all bounds when the plant executed them: {bounds}.",
        "",
        "`designed` is the motion that the package recommends, `fisher` the same search for the parameters of the most "
        "probable explanation, `random` any safe motion. No motion is added once the answer is clear or the remaining "
        "explanations are inseparable, as in `cablejax study`. A uniform cable in slow motion shows only the ratio "
        "of stiffness to density and friction: stiffness and density cannot be separated.",
        "",
        *markdown_table(table),
        "",
        "Seeds that are answered: only the truth is left, or stiffness and density if one of them is the truth. "
        "Explanations below 1 % do not count.",
        "",
        *markdown_table(
            table_of_needs([row for arm in arms for row in rows if row["arm"] == arm and row["seed"] in common])
        ),
        "",
        f"Seeds whose first log shows no gap above the simulator's own error: {len(gapless)} "
        f'({", ".join(map(str, gapless)) or "none"}). The verdict on them is "none", and the truth counts as missed.',
        "",
        "Staged: "
        + ", ".join(f"`{row['effect']}`" for row in rows if row["arm"] == arms[0] and row["seed"] in common)
        + ".",
    ]
    made_by = (
        f"`python experiments/25_next_motion.py --seeds {max(common, default=0)}` and "
        "`--report docs/results/next_motion.md`"
    )
    return page_of_results("The next motion", made_by, lines, made_on=machines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=pathlib.Path, default=ROWS, help="file of the finished rows")
    parser.add_argument("--seeds", type=int, default=20, help="number of set-ups")
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), default=list(ARMS))
    add_option(parser)
    parser.add_argument("--report", type=pathlib.Path, help="write the page of the finished rows, and run nothing")
    parser.add_argument("--seconds", type=float, default=np.inf, help="begin no further row after this time")
    options = parser.parse_args()
    rows = Rows(options.rows, ("seed", "arm"))
    if options.report is not None:
        publish(page(rows.read(), made_on(options.rows)), options.report)
        return
    wanted = [(seed, arm) for seed in range(1, options.seeds + 1) for arm in options.arms]
    with executor_of(options.executor) as executor:
        rows.run(rows.missing(wanted), examine, executor=executor, seconds=options.seconds)


if __name__ == "__main__":
    main()
