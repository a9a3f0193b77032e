"""Common part of `demo` and `shape`: runs on the plant, stored as they finish, and their report."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cablejax.cable import Cable, Discretisation
from cablejax.commands.cable import check_verdicts
from cablejax.commands.options import UsageError, say
from cablejax.commands.results import numbers_of, write_results
from cablejax.commands.resuming import Parts
from cablejax.control.run import ClosedLoopRun
from cablejax.control.shaping import Method, Model, check_fit, enters, not_within_reach, shape_once
from cablejax.control.targets import Target
from cablejax.diagnose.judgement import listed
from cablejax.dynamics.weights import fingerprint
from cablejax.effects.given import GivenEffect, parse_effect
from cablejax.effects.physics import nominal_physics
from cablejax.effects.verdicts import explanations_of_verdict
from cablejax.limits import require
from cablejax.mpc import MPCConfig
from cablejax.perceive.camera import CameraConfig
from cablejax.report.effect_words import EFFECTS
from cablejax.report.style import METHOD_LABEL
from cablejax.simulate.plant import PlantConfig
from cablejax.solver_names import SolverName
from cablejax.text_file import write_json


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """A cable to be brought to every target by every method.

    Attributes:
        plant: what the cable and its table really are.
        model: what the controller believes.
        targets: shapes to make, of different names.
        methods: with the online residual, without, or both.
        solver: how plans are found.
        steps: commands per run.
        camera: what the cable is seen with; None = the controller observes the simulated keypoints directly.
    """

    plant: PlantConfig
    model: Model
    targets: tuple[Target, ...]
    methods: tuple[Method, ...]
    solver: SolverName
    steps: int
    camera: CameraConfig | None = None

    def __post_init__(self):
        require(self.steps, "commands", "--steps")
        check_fit(self.model, self.plant.cable)

    @property
    def out_of_reach(self) -> list[str]:
        """Sentences on why targets are out of reach."""
        bounds = MPCConfig.for_length(self.model.config.length)
        return [text for target in self.targets if (text := not_within_reach(target, bounds))]

    def settings(self) -> dict[str, Any]:
        """All that a run depends on, for JSON: of the model its weights, since a name may mean others later."""
        return {
            "model": {
                "config": dataclasses.asdict(self.model.config),
                "weights": fingerprint(self.model.weights),
                "cable": dataclasses.asdict(self.model.cable),
                "believed": self.model.believed,
                "limits": self.model.inputs.limits,
            },
            "plant": dataclasses.asdict(self.plant),
            "camera": None if self.camera is None else dataclasses.asdict(self.camera),
            "targets": [target.keypoints.tolist() for target in self.targets],
            "solver": self.solver,
            "steps": self.steps,
        }


def shape_and_report(job: Job, out: pathlib.Path, parts: Parts, *, facts: Mapping[str, str]) -> dict[str, Any]:
    """Makes the runs that are not among the parts yet and writes the results.

    Args:
        job: what to do.
        out: folder for `summary.json`, `log.npz`, `report.html` and `demo.gif`, replaced where they are there.
        parts: keeps finished runs.
        facts: settings to print on the page.

    Returns:
        The summary.

    Raises:
        ValueError: model and plant do not fit.
    """
    begin = time.perf_counter()
    kept = {(t.name, method): parts.load(f"{t.name}-{method}") for t in job.targets for method in job.methods}
    for text in job.out_of_reach:
        say(text)
    if any(run is None for run in kept.values()):
        say("compiling the control step ...")
    runs: dict[tuple[str, Method], ClosedLoopRun] = {}
    for target in job.targets:
        for method in job.methods:
            run = kept[target.name, method]
            if run is None:
                run = shape_once(
                    job.plant,
                    job.model,
                    target,
                    method=method,
                    solver=job.solver,
                    steps=job.steps,
                    camera=job.camera,
                )
                parts.save(f"{target.name}-{method}", run)
            runs[target.name, method] = run
            say(f"{time.perf_counter() - begin:5.0f} s  {METHOD_LABEL[method]:22s}{run.verdict()}")
    numbers = numbers_of(runs)
    write_results(out, runs, numbers, believed=job.model.cable, about=about(job), facts=facts)
    summary = {"shapes": numbers, "total_s": round(time.perf_counter() - begin, 3)}
    write_json(out / "summary.json", summary)
    return summary


PLANT_EFFECT = "bending_stiffness:ratio=0.2"
"""The gap between model and plant, unless another one is asked for."""


def staged_effects(given: Sequence[str]) -> tuple[GivenEffect, ...]:
    """The effects of a plant by `--plant-effect`: by default `PLANT_EFFECT`; `none` for none.

    Raises:
        UsageError: `none` is given together with an effect.
        ValueError: a text is no effect.
    """
    if "none" in given and len(given) > 1:
        raise UsageError("--plant-effect is none and an effect: give either.")
    if "none" in given:
        return ()
    return tuple(parse_effect(text) for text in given or (PLANT_EFFECT,))


def known_from(model: Model, given: Sequence[str], verdicts: Sequence[pathlib.Path]) -> tuple[GivenEffect, ...]:
    """The effects that a model is informed of: those of `--effect` and those that the verdicts of `--with` name.

    Where nothing of what a verdict names enters the model, the first of its look-alikes of which something does, as the
    draws of its posterior have them.

    Raises:
        ValueError: a text is no effect, or a file is no verdict, names nothing or is of another cable.
    """
    check_verdicts(verdicts, model.cable, "Take a model that was trained on the verdict's cable.")
    known = list(map(parse_effect, given))
    for path in verdicts:
        # about the log's grippers: places do not enter a model, and a robot's world may begin metres away
        explanations = explanations_of_verdict(path)
        known += next((effects for effects in explanations if enters(model, effects)), explanations[0])
    return tuple(known)


def plant_of(
    cable: Cable, effects: tuple[GivenEffect, ...], *, links: int, seed: int, keypoint_noise: float = 0.0
) -> PlantConfig:
    """A plant with this cable and these effects, at the plant's own time step.

    Args:
        cable: what is simulated.
        effects: what else acts.
        links: of the chain.
        seed: of noise.
        keypoint_noise: standard deviation of the observed keypoints [m].
    """
    default = PlantConfig()
    return dataclasses.replace(
        default,
        discretisation=dataclasses.replace(default.discretisation, cable=cable, n_links=links),
        effects=effects,
        keypoint_noise=keypoint_noise,
        seed=seed,
    )


def about(job: Job) -> str:
    """Sentences on how the plant differs from the model's training data, and on targets that are out of reach.

    Every ratio is computed: the plant's cable with its effects over the model's cable.
    """
    believed, plant = job.model.cable, job.plant
    sentences = [
        f"The model was trained on a cable of {believed.length:g} m with {believed.n_keypoints} keypoints, "
        f"{believed.linear_density:g} kg/m and a bending stiffness of {believed.bending_stiffness:g} N m^2, on a table "
        f"with a friction coefficient of {believed.friction_coefficient:g}."
    ]
    if job.model.effects:
        sentences.append(f"Its training data hold {listed(job.model.effects)}.")
    if job.model.known:
        sentences.append(f"It was informed of {listed(job.model.known)}.")
    changes = _changes(believed, plant)
    if changes:
        sentences.append(f"The plant has {listed(changes)}.")
    always = [f"{EFFECTS.get(e.name, e.name)} ({e})" for e in plant.effects if e.lasting]
    if always:
        sentences.append(f"Staged in the plant: {listed(always)}.")
    sentences += [f"{_when(e)}: {EFFECTS.get(e.name, e.name)} ({e})." for e in plant.effects if not e.lasting]
    if not changes and not plant.effects:
        sentences.append("The plant has the same cable.")
    sentences.append(
        "The plant touches its table with contact and friction cones, where the training simulator has a smoothed "
        "friction law."
    )
    if job.camera is not None:
        sentences.append(
            f"The cable is seen by a depth camera with {1e3 * job.camera.range_noise:g} mm of noise in its range."
        )
    elif plant.keypoint_noise > 0:
        sentences.append(f"The keypoints are seen with {1e3 * plant.keypoint_noise:g} mm of noise.")
    sentences += job.out_of_reach
    return " ".join(sentences)


def _when(effect: GivenEffect) -> str:
    """When an effect acts, in words."""
    return f"From {effect.from_s:g} s" + (" on" if effect.until_s is None else f" to {effect.until_s:g} s")


_QUANTITIES = {
    "stiffness": ("bending stiffness", " N m^2"),
    "rest_curvature": ("curvature at rest", " 1/m"),
    "friction": ("friction coefficient", ""),
    "density": ("mass per length", " kg/m"),
    "damping_time": ("damping time", " s"),
}
"""Fields of `Physics` that are compared where they are uniform along the cable: name and unit."""


def _changes(believed: Cable, plant: PlantConfig) -> list[str]:
    """The values that the plant's cable has everywhere and the believed one has not, with their ratio."""
    ours, theirs = nominal_physics(Discretisation(believed)), plant.physics
    pairs = [(*_QUANTITIES[name], getattr(ours, name), getattr(theirs, name)) for name in _QUANTITIES]
    pairs.append(("diameter", " m", believed.diameter, plant.cable.diameter))
    found = []
    for name, unit, was, now in pairs:
        was, now = np.ravel(np.asarray(was, float)), np.ravel(np.asarray(now, float))
        if np.ptp(now) <= 1e-6 * np.abs(now).max() and abs(now[0] - was[0]) > 1e-6 * abs(was[0]):
            against = f"{now[0] / was[0]:.3g} times the model's" if was[0] else "the model's is 0"
            found.append(f"{name} {now[0]:.3g}{unit} ({against})")
    return found
