"""`cablejax study`: records and diagnoses in rounds on a simulated plant, until the answer is clear."""

from __future__ import annotations

import dataclasses
import itertools
import pathlib
import shutil
from typing import TYPE_CHECKING, ClassVar

import tyro

from cablejax.commands.cable import find_cable
from cablejax.commands.options import SeededCommand, say
from cablejax.limits import require
from cablejax.text_file import read_json, write_json

if TYPE_CHECKING:
    from cablejax.diagnose import Diagnosis
    from cablejax.types import GapLog


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study(SeededCommand):
    """Record and diagnose a simulated plant in rounds, until it is clear which effect the simulator lacks.

    Records motions to a U, an S and a Z on the plant and diagnoses them. While several causes are left, designs the
    motion that is expected to separate them best, records it, and diagnoses all recordings together. Ends when one
    cause is left, when no motion separates the causes, or after --rounds. Writes report.html, recording_1.npz, ... and
    the diagnosis of each round in round_1, ... A round takes two minutes.

    Attributes:
        out: Folder for the results.
        overwrite: Replace the results that are in the folder.
        cable: The plant's nominal cable: a cable file, or a data set, weights or a log that holds one. By default the
            reference cable.
        plant_effect: An effect of the plant that the diagnosis does not know, as NAME:PARAMETER=VALUE,... in SI units;
            may be given several times. By default bending_stiffness:ratio=0.2; `none` for no effect.
        rounds: Recordings to make at most.
        bounds: Bounds of the motions, a TOML file; by default those of the cable and a usual arm's speed.
        noise_mm: Noise: standard deviation of the recorded keypoints, per coordinate [mm].
        links: Links of the plant's cable. Fewer are faster; the plant's own error grows with the square of their
            length.
    """

    resume_hint: ClassVar[str] = "Run the same command again: finished rounds are kept and not repeated."

    out: pathlib.Path = pathlib.Path("runs/study")
    overwrite: bool = False
    cable: pathlib.Path | None = None
    plant_effect: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    rounds: int = 3
    bounds: pathlib.Path | None = None
    noise_mm: float = 1.0
    links: int = 48

    def execute(self):
        """Records and diagnoses round by round, keeps each as it ends, and reports."""
        from cablejax.commands.diagnose import diagnose_and_report
        from cablejax.commands.resuming import unfinished
        from cablejax.commands.runs import plant_of, staged_effects
        from cablejax.control.targets import make_target, straight_start
        from cablejax.diagnose.motion_bounds import Bounds, read_bounds
        from cablejax.diagnose.study import ENDED, ended, first_recording, left_open
        from cablejax.diagnose.verdict_json import read_verdict
        from cablejax.effects.verdicts import read_verdict_json
        from cablejax.gaplog import read_gap_log, write_gap_log
        from cablejax.gaplog_join import joined
        from cablejax.report.sheet import write_sheet
        from cablejax.report.study_sheet import study_sheet
        from cablejax.simulate.plant import Plant
        from cablejax.simulate.play import play

        require(self.rounds, "count", "--rounds")
        require(self.noise_mm, "noise_mm", "--noise-mm")
        cable = find_cable(self.cable)
        bounds = Bounds() if self.bounds is None else read_bounds(self.bounds)
        config = plant_of(cable, staged_effects(self.plant_effect), links=self.links, seed=self.seed)
        goals = {f"to {letter}": make_target(letter, cable).gripper_pose for letter in ("U", "S", "Z")}
        commands, plant = first_recording(cable, straight_start(cable), goals, bounds), Plant(config)
        settings = {
            "study": dataclasses.asdict(config),
            "bounds": dataclasses.asdict(bounds),
            "noise_mm": self.noise_mm,
        }
        found: list[Diagnosis] = []
        recordings: list[GapLog] = []
        why = None
        with unfinished(self.out, settings, overwrite=self.overwrite) as parts:
            kept = finished_rounds(parts.state)
            remove_rounds(self.out, kept)
            while why is None:
                number = len(found) + 1
                path, folder = self.out / f"recording_{number}.npz", self.out / f"round_{number}"
                if number > kept:
                    say(f"round {number}: recording {', '.join(commands.meta['motion'])} ...")
                    noise, seed = 1e-3 * self.noise_mm, self.seed + number
                    log = play(plant, commands, source="contact plant", noise=noise, seed=seed)
                    write_gap_log(path, log, overwrite=True)
                recordings.append(read_gap_log(path))
                if number > kept:
                    log = joined(recordings, [f"recording_{k}.npz" for k in range(1, number + 1)])
                    folder.mkdir(exist_ok=True)
                    result, _ = diagnose_and_report(log, folder, bounds=bounds)
                    say(f"round {number}: {result.sentence}")
                    write_json(parts.state, {"rounds": number})
                verdict = folder / "verdict.json"
                found.append(read_verdict(verdict))
                worth = read_verdict_json(verdict)["next_motion_worth"]
                why = ended(found[-1], worth, rounds_left=self.rounds - number)
                if why is None:
                    commands = read_gap_log(folder / "next_motion.npz")
            # more of them are kept where --rounds was larger
            remove_rounds(self.out, number)
            motions = [log.meta["motion"] for log in recordings]
            page = write_sheet(self.out / "report.html", study_sheet(found, motions, why, config.effects))
            result = {
                "ended": why,
                "rounds": [
                    {"motions": recorded, "verdict": one.verdict, "left_open": left_open(one)}
                    for recorded, one in zip(motions, found, strict=True)
                ],
                "verdict": read_verdict_json(verdict),
                "report": str(page),
            }
            write_json(self.out / "summary.json", result)
        return result, f"{found[-1].verdict}: {found[-1].sentence} {ENDED[why]}\n{page}"


def finished_rounds(state: pathlib.Path) -> int:
    """Number of complete rounds of an interrupted study; an unreadable round and all after it are made again."""
    from cablejax.diagnose.verdict_json import read_verdict
    from cablejax.effects.verdicts import read_verdict_json
    from cablejax.gaplog import read_gap_log

    out, number = state.parents[1], 0
    try:
        rounds = read_json(state)["rounds"]
        for number in range(rounds):
            folder = out / f"round_{number + 1}"
            read_gap_log(out / f"recording_{number + 1}.npz")
            read_verdict(folder / "verdict.json")
            if read_verdict_json(folder / "verdict.json")["next_motion"] is not None:
                read_gap_log(folder / "next_motion.npz")
        return rounds
    except (FileNotFoundError, ValueError, TypeError, KeyError) as error:
        if state.exists():
            say(f"Round {number + 1} was kept, but is damaged and made again: {error}")
        return number


def remove_rounds(out: pathlib.Path, kept: int) -> None:
    """Deletes all rounds after those that are kept, of an overwritten, damaged or longer study."""
    for old in ("report.html", "summary.json"):
        (out / old).unlink(missing_ok=True)
    for number in itertools.count(kept + 1):
        folder = out / f"round_{number}"
        recording, judged = out / f"recording_{number}.npz", (folder / "verdict.json").is_file()
        # a kill may leave a round without a verdict; what else has such a name is the user's
        if judged or _is_gap_log(recording):
            recording.unlink(missing_ok=True)
            shutil.rmtree(folder, ignore_errors=True)
        elif number > kept + 1:
            return


def _is_gap_log(path: pathlib.Path) -> bool:
    from cablejax.gaplog import read_gap_log

    try:
        read_gap_log(path)
    except (FileNotFoundError, ValueError):
        return False
    return True
