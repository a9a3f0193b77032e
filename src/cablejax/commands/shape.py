"""`cablejax shape`: shapes one cable into one target, with your own settings."""

from __future__ import annotations

import dataclasses
import math
import pathlib
import shlex
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from cablejax.commands.cable import find_cable
from cablejax.commands.options import SeededCommand, UsageError, say, text_table
from cablejax.limits import require
from cablejax.solver_names import SolverName

if TYPE_CHECKING:
    from cablejax.effects.given import GivenEffect

# Log ratio of stiffness to friction that a model may miss without a word.
_LEFT_OUT = 0.01


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shape(SeededCommand):
    """Shape one cable into a target, on a simulated plant with the model's cable and effects of your choice.

    The target is a letter or a file: .npz or .json with "keypoints" [N, 2] in metres, or .csv with rows x,y. Writes
    summary.json, log.npz, report.html and demo.gif.

    Attributes:
        target: U, S, Z, or a file with the keypoints to reach.
        out: Folder for the results.
        overwrite: Replace the results that are in the folder.
        method: residual: correct the model online. direct: use the trained model alone. both: one run of each.
        weights: Released model by name, or the folder of a training by `cablejax train`.
        solver: How the controller finds its plan.
        steps: Commands, one second each.
        cable: The plant's cable: a cable file, or a data set, weights or a log that holds one. By default the cable
            that the model was trained on.
        plant_effect: An effect of the plant that the model may not know, as NAME:PARAMETER=VALUE,... in SI units; may
            be given several times. By default bending_stiffness:ratio=0.2; `none` for no effect. With from_s=... and
            until_s=... it begins and ends during the run.
        effect: An effect that the model is informed of, written as for --plant-effect; may be given several times.
            stiffness_profile, intrinsic_curvature, gripper_rotation_offset and gripper_compliance change the resting
            shape of the model's cable; bending_stiffness, table_friction and linear_density change the initial estimate
            of a conditioned model. Others do not enter the model.
        with_: A verdict.json of `cablejax diagnose`: the model is informed of the named effects, as by --effect. If
            none of them enters the model, it is informed of the first of their look-alikes that does.
        perception: true: the controller observes the simulated keypoints. cloud: it observes keypoints estimated from
            clouds of a depth camera; the printed errors are still those of the true keypoints.
        motion: Play this motion on the plant instead of shaping: a gap log with commands, such as the next_motion.npz
            of `cablejax diagnose`. Writes only log.npz. The plant has the cable of that log unless --cable is given. Of
            the other options only --plant-effect, --noise-mm, --links and --seed are used.
        noise_mm: Noise: standard deviation of the observed keypoints, per coordinate, or of the camera's range [mm]. By
            default 0 for keypoints and 2 for the range.
        links: Links of the plant's cable. Fewer are faster, but the plant's own error grows with the square of their
            length, and a diagnosis of the log mistakes this error for a gap.
    """

    resume_hint: ClassVar[str] = "Run the same command again: finished runs are kept and not repeated."

    target: str = "U"
    out: pathlib.Path = pathlib.Path("runs/shape")
    overwrite: bool = False
    method: Literal["residual", "direct", "both"] = "both"
    weights: str = "gns-reference"
    solver: SolverName = "levenberg-marquardt"
    steps: int = 40
    cable: pathlib.Path | None = None
    plant_effect: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    effect: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    with_: Annotated[tuple[pathlib.Path, ...], tyro.conf.arg(name="with"), tyro.conf.UseAppendAction] = ()
    perception: Literal["true", "cloud"] = "true"
    motion: pathlib.Path | None = None
    noise_mm: float | None = None
    links: int = 48

    def execute(self):
        """Brings the cable to the targets, keeps each run as it ends, and reports."""
        from cablejax.commands.results import table_of
        from cablejax.commands.resuming import unfinished
        from cablejax.commands.runs import Job, known_from, plant_of, shape_and_report, staged_effects
        from cablejax.control.shaping import METHODS, knowing, load_model
        from cablejax.control.targets import load_target, make_target
        from cablejax.perceive.camera import CameraConfig

        if self.motion is not None and self.perception == "cloud":
            raise UsageError("--motion records the keypoints of the plant: leave --perception out.")
        if self.motion is not None and (self.effect or self.with_):
            raise UsageError("--motion uses no model that could be informed by --effect or --with: leave them out.")
        if self.noise_mm is not None:
            require(self.noise_mm, "noise_mm", "--noise-mm")
        effects = staged_effects(self.plant_effect)
        cloud = self.perception == "cloud"
        noise_mm = (2.0 if cloud else 0.0) if self.noise_mm is None else self.noise_mm
        if self.motion is not None:
            return self._play(self.motion, effects)
        model = load_model(self.weights)
        if known := known_from(model, self.effect, self.with_):
            model = knowing(model, known)
            out = model.inputs.left_out(known, model.cable) if model.config.conditioned else 0.0
            if abs(out) > _LEFT_OUT:
                say(
                    f"The model's training data had no cable like this one: it is informed of {math.exp(-out):.2g} "
                    "times the ratio of stiffness to friction that the effects make, the nearest in its data."
                )
        cable = model.cable if self.cable is None else find_cable(self.cable)
        plant = plant_of(
            cable,
            effects,
            links=self.links,
            seed=self.seed,
            keypoint_noise=0.0 if cloud else 1e-3 * noise_mm,
        )
        target = make_target(self.target, cable) if self.target in ("U", "S", "Z") else load_target(self.target, cable)
        # a longer cable is seen from farther away
        camera = CameraConfig(
            distance=CameraConfig.distance * cable.length, range_noise=1e-3 * noise_mm, seed=self.seed
        )
        job = Job(
            plant=plant,
            model=model,
            targets=(target,),
            methods=METHODS if self.method == "both" else (self.method,),
            solver=self.solver,
            steps=self.steps,
            camera=camera if cloud else None,
        )
        facts = {
            field.name.replace("_", " "): str(getattr(self, field.name))
            for field in dataclasses.fields(self)
            if field.name not in ("json", "out", "overwrite", "device", "cable", "plant_effect", "effect", "with_")
        }
        facts["model knows of"] = ", ".join(model.known) or "nothing"
        facts["plant effect"] = ", ".join(map(str, effects)) or "none"
        with unfinished(self.out, job.settings(), overwrite=self.overwrite) as parts:
            summary = shape_and_report(job, self.out, parts, facts=facts)
        table = text_table(*table_of(summary))
        return summary, f"{table}\n\nLook at {self.out / 'report.html'}"

    def _play(self, path: pathlib.Path, effects: tuple[GivenEffect, ...]):
        """Plays a motion on the plant and writes the log of it."""
        from cablejax.commands.resuming import unfinished
        from cablejax.commands.runs import plant_of
        from cablejax.gaplog import read_gap_log, write_gap_log
        from cablejax.simulate.plant import Plant
        from cablejax.simulate.play import even_intervals, play

        commands, cable = read_gap_log(path), find_cable(path if self.cable is None else self.cable)
        if abs(cable.length - (planned := commands.meta["cable"]["length_m"])) > 0.01 * planned:
            raise UsageError(
                f"{path} is a motion of a cable of {planned:g} m, but {self.cable} has one of {cable.length:g} m, "
                "which it may tear or fold: give a cable of that length, or leave --cable out."
            )
        plant = plant_of(cable, effects, links=self.links, seed=self.seed)
        shortest, *others = sorted(set(even_intervals(commands)))
        # a motion at 30 Hz, of which no time step of the plant is a part
        fitting = plant.discretisation.dividing(shortest)
        try:
            for interval in others:
                fitting.steps_in(interval)
        except ValueError as error:
            raise UsageError(
                f"{path} has episodes at {1 / others[-1]:.6g} to {1 / shortest:.6g} samples a second, expected one "
                "rate, or rates that one time step fits: write the episodes of each rate to a log of their own "
                "(cablejax.gaplog_join.chosen) and play these in turn."
            ) from error
        plant = dataclasses.replace(plant, discretisation=fitting)
        noise = 1e-3 * (self.noise_mm or 0.0)
        settings = {"motion": commands.meta, "plant": dataclasses.asdict(plant), "noise": noise}
        with unfinished(self.out, settings, overwrite=self.overwrite):
            source = f"contact plant, {', '.join(map(str, effects)) or 'no effect'}"
            log = play(Plant(plant), commands, source=source, noise=noise, seed=self.seed)
            for old in ("report.html", "summary.json", "demo.gif"):  # of another run, whose log goes
                (self.out / old).unlink(missing_ok=True)
            written = write_gap_log(self.out / "log.npz", log, overwrite=True)
        seconds = float(log.intervals.sum())
        result = {"log": str(written), "episodes": len(log.episode_length), "seconds": seconds}
        return result, f"{written}\n\nDiagnose it with `cablejax diagnose {shlex.quote(str(written))}`."
