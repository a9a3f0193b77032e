"""`cablejax shape`: one cable, one target, your own settings."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import ClassVar, Literal

from cablejax.commands.options import Command, text_table
from cablejax.solver_names import SolverName


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shape(Command):
    """Shape one cable into a target of your own, on a simulated plant of your own.

    The target is a letter or a file: .npz or .json with "keypoints" [N, 2] in metres, or .csv with rows x,y. Writes
    summary.json, log.npz, report.html and demo.gif."""

    resume_hint: ClassVar[str] = "Run the same command again: finished runs are kept and not repeated."

    target: str = "U"
    """U, S, Z, or a file with the keypoints to reach."""

    out: pathlib.Path = pathlib.Path("runs/shape")
    """Folder for the results."""

    overwrite: bool = False
    """Replace the results that are in the folder."""

    method: Literal["residual", "direct", "both"] = "both"
    """residual: correct the model online. direct: trust it as it was trained. both: one run of each."""

    weights: str = "gns-reference"
    """Released model by name, or the folder of a training by `cablejax train`."""

    solver: SolverName = "levenberg-marquardt"
    """How the controller finds its plan."""

    steps: int = 40
    """Commands, one second each."""

    stiffness_ratio: float = 2.0
    """The plant's bending stiffness over that of the training."""

    friction: float = 0.1
    """Coulomb friction coefficient of the plant's table."""

    perception: Literal["true", "cloud"] = "true"
    """true: the controller is told the keypoints. cloud: it gets what is found in the clouds of a depth camera; the
    errors printed remain those of the true keypoints."""

    noise_mm: float | None = None
    """Noise: standard deviation of the observed keypoints, per coordinate, or of the camera's range [mm]. By default 0
    for the first and 2 for the second."""

    links: int = 24
    """Links of the plant's cable."""

    def execute(self):
        from cablejax.commands.parts import unfinished
        from cablejax.commands.results import table_of
        from cablejax.commands.runs import Job, shape_and_report
        from cablejax.control.shaping import METHODS, load_model
        from cablejax.control.targets import load_target, make_target
        from cablejax.effects.given import GivenEffect
        from cablejax.perceive.camera import CameraConfig
        from cablejax.simulate.plant import PlantConfig

        cloud = self.perception == "cloud"
        noise_mm = (2.0 if cloud else 0.0) if self.noise_mm is None else self.noise_mm
        default = PlantConfig()
        cable = dataclasses.replace(default.cable, friction_coefficient=self.friction)
        plant = dataclasses.replace(
            default,
            discretisation=dataclasses.replace(default.discretisation, cable=cable, n_links=self.links),
            effects=(GivenEffect("bending_stiffness", (("ratio", self.stiffness_ratio),)),),
            keypoint_noise=0.0 if cloud else 1e-3 * noise_mm,
            seed=self.seed,
        )
        seen = "The cable is seen by a depth camera" if cloud else "The keypoints are seen"
        target = make_target(self.target, cable) if self.target in ("U", "S", "Z") else load_target(self.target, cable)
        job = Job(
            plant=plant,
            model=load_model(self.weights),
            targets=(target,),
            methods=METHODS if self.method == "both" else (self.method,),
            solver=self.solver,
            steps=self.steps,
            camera=CameraConfig(range_noise=1e-3 * noise_mm, seed=self.seed) if cloud else None,
        )
        about = (
            f"The plant's cable is {self.stiffness_ratio:g} times as stiff as the one that the model was trained on; "
            f"the table's friction coefficient is {self.friction:g}. {seen} with {noise_mm:g} mm of noise."
        )
        facts = {
            field.name.replace("_", " "): str(getattr(self, field.name))
            for field in dataclasses.fields(self)
            if field.name not in ("json", "out", "overwrite", "device")
        }
        with unfinished(self.out, job.settings(), overwrite=self.overwrite) as parts:
            summary = shape_and_report(job, self.out, parts, about=about, facts=facts)
        table = text_table(*table_of(summary))
        return summary, f"{table}\n\nLook at {self.out / 'report.html'}"
