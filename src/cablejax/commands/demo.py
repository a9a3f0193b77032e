"""`cablejax demo`: runs the whole method on three shapes, with and without its online correction."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import ClassVar, Literal

from cablejax.commands.artefacts import PAGE
from cablejax.commands.options import SeededCommand, say, text_table

PUSHED_AT = 25.0
"""When the cable is pushed [s]."""
PUSH = f"gravity_tilt:angle_rad=0.6,direction_rad=1.6,from_s={PUSHED_AT:g},until_s={PUSHED_AT + 1.5:g}"
"""Gravity seems tilted for a moment, so that the cable slides aside by a decimetre."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo(SeededCommand):
    """Shape a cable into a U, an S and a Z with the released model, and make a page about it.

    The cable is a fifth as stiff as the one that the model was trained on, and the table's friction follows another
    law. Each shape is made with and without the online residual; after 25 s the cable is pushed aside. Writes
    summary.json, log.npz, report.html and demo.gif. Then diagnoses its own run until the push: diagnosis/report.html
    names what the simulator lacks.

    Attributes:
        out: Folder for the results.
        overwrite: Replace the results that are in the folder.
        weights: Released model by name, or the folder of a training by `cablejax train`.
        shapes: Which shapes to make.
        steps: Commands per run, one second each.
        links: Links of the plant's cable.
        solver: How the controller finds its plan.
    """

    resume_hint: ClassVar[str] = "Run the same command again: finished runs are kept and not repeated."

    out: pathlib.Path = pathlib.Path("runs/demo")
    overwrite: bool = False
    weights: str = "gns-reference"
    shapes: tuple[Literal["U", "S", "Z"], ...] = ("U", "S", "Z")
    steps: int = 45
    links: int = 24
    solver: Literal["levenberg-marquardt", "projected-gradient"] = "levenberg-marquardt"

    def execute(self):
        """Shapes U, S and Z with and without the residual, reports, and diagnoses the run."""
        from cablejax.commands.reproduce import command_line
        from cablejax.commands.results import table_of
        from cablejax.commands.resuming import unfinished
        from cablejax.commands.runs import PLANT_EFFECT, Job, plant_of, shape_and_report, staged_effects
        from cablejax.control.shaping import METHODS, load_model
        from cablejax.control.targets import make_target

        model = load_model(self.weights)
        plant = plant_of(model.cable, staged_effects((PLANT_EFFECT, PUSH)), links=self.links, seed=self.seed)
        job = Job(
            plant=plant,
            model=model,
            targets=tuple(make_target(shape, plant.cable) for shape in dict.fromkeys(self.shapes)),
            methods=METHODS,
            solver=self.solver,
            steps=self.steps,
        )
        facts = {
            "command": command_line(self, "demo"),
            "model": self.weights,
            "solver": self.solver,
        }
        with unfinished(self.out, job.settings(), overwrite=self.overwrite) as parts:
            summary = shape_and_report(job, self.out, parts, facts=facts)
            gap = self._diagnosed()
        table = text_table(*table_of(summary))
        text = f"{table}\n\n{summary['total_s']:.0f} s. Look at {self.out / 'report.html'}"
        return {
            **summary,
            "diagnosis": gap,
        }, text if gap is None else f"{text}\nThe gap: {gap['sentence']}\n{gap['report']}"

    def _diagnosed(self) -> dict[str, str] | None:
        """Diagnosis of the gap between plant and simulator until the push; None for a run that is too short."""
        from cablejax.commands.diagnose import diagnose_and_report
        from cablejax.diagnose import DiagnosisError
        from cablejax.gaplog import read_gap_log, until

        folder = self.out / "diagnosis"
        try:
            folder.mkdir(exist_ok=True)
            for old in (PAGE, "verdict.json", "simulated.npz"):  # of another run, whose log goes
                (folder / old).unlink(missing_ok=True)
            result, page = diagnose_and_report(until(read_gap_log(self.out / "log.npz"), PUSHED_AT), folder)
        except DiagnosisError as error:
            say(f"The gap was not diagnosed: {error}")
            return None
        return {"verdict": result.verdict, "sentence": result.sentence, "report": str(page)}
