"""The methods that are compared: the model of each, and what it learns online."""

from __future__ import annotations

import dataclasses
import functools

from cablejax.control.controller import Controller
from cablejax.control.shaping import Model, make_controller
from cablejax.control.targets import Target
from cablejax.residual import PAPER, STATIC, LearnerConfig
from closed_loop.baselines import StraightDrive, statics_model
from closed_loop.paper import DIRECT, FINE_TUNED, METHOD_LABEL, RANDOMISED, RESIDUAL, VISUAL_SERVO
from closed_loop.visual_servo import ServoConfig, VisualServo
from rivals import load_any

LEARNER = "learner"
NO_PRIOR = "no prior"
NO_PRIOR_LEARNER = "no prior learner"
DRIVE = "straight drive"
STATICS = "statics"
PAPER_DIRECT = "paper network"
PAPER_RESIDUAL = "paper network residual"
RECURRENT_RESIDUAL = "recurrent residual"

LABEL = METHOD_LABEL | {
    LEARNER: "GNS + online learner",
    NO_PRIOR: "conditioned GNS without statics + estimate",
    NO_PRIOR_LEARNER: "conditioned GNS without statics + estimate + learner",
    DRIVE: "straight drive to the goal, no model",
    STATICS: "statics alone",
    PAPER_DIRECT: "GNS without statics, world's frame, direct",
    PAPER_RESIDUAL: "GNS without statics, world's frame + residual",
    RECURRENT_RESIDUAL: "Bi-LSTM + online residual",
}
"""Names for readers."""

WITHOUT_LEARNING = {
    RESIDUAL: DIRECT,
    LEARNER: DIRECT,
    PAPER_RESIDUAL: PAPER_DIRECT,
    NO_PRIOR_LEARNER: NO_PRIOR,
}
"""The same model without what is learned online."""


@dataclasses.dataclass(frozen=True)
class MethodSpec:
    """One row of the tables.

    Attributes:
        name: in trials, see `LABEL`.
        weights: model that it plans with, see `model_named`; None = it has no model.
        learner: what corrects the model's errors online; None = nothing does.
        fine_tuned: whether the model is first trained on transitions of the very cable that it will shape.
    """

    name: str
    weights: str | None
    learner: LearnerConfig | None = None
    fine_tuned: bool = False


METHODS: dict[str, MethodSpec] = {
    spec.name: spec
    for spec in (
        MethodSpec(VISUAL_SERVO, None),
        MethodSpec(DIRECT, "gns-reference"),
        MethodSpec(RANDOMISED, "gns-randomised"),
        MethodSpec(FINE_TUNED, "gns-reference", fine_tuned=True),
        MethodSpec(RESIDUAL, "gns-reference", learner=PAPER),
        MethodSpec(LEARNER, "gns-reference", learner=STATIC),
        MethodSpec(NO_PRIOR, "gns-no-prior"),
        MethodSpec(NO_PRIOR_LEARNER, "gns-no-prior", learner=LearnerConfig()),
        MethodSpec(DRIVE, None),
        MethodSpec(STATICS, STATICS),
        MethodSpec(PAPER_DIRECT, "gns-none-world"),
        MethodSpec(PAPER_RESIDUAL, "gns-none-world", learner=PAPER),
        MethodSpec(RECURRENT_RESIDUAL, "lstm-static", learner=PAPER),
    )
}
"""The paper's methods in its order, two beyond it, and what they have to beat. A conditioned model estimates its cable
in any case."""


LEARNERS: dict[LearnerConfig | None, str] = {
    None: "",
    PAPER: "`residual.PAPER`, the paper's ridge",
    STATIC: "`residual.STATIC`, the learner for a model that expects the cable to relax",
    LearnerConfig(): "`residual.LearnerConfig()`, the learner",
}
"""What corrects a model online, for readers."""


@functools.lru_cache(maxsize=8)
def model_named(name: str) -> Model:
    """A released model, one of `experiments/weights`, a training's folder, or the statics; loaded once."""
    return statics_model() if name == STATICS else load_any(name)


def controller_of(spec: MethodSpec, model: Model | None, target: Target) -> Controller:
    """What shapes the cable.

    Args:
        spec: the method.
        model: as the method's weights say, fine-tuned if it asks for that; None for one without a model.
        target: the wanted shape.
    """
    if spec.name == DRIVE:
        return StraightDrive(target.keypoints)  # pyright: ignore[reportArgumentType]
    if model is None:
        return VisualServo(ServoConfig(), target.keypoints)
    controller = make_controller(model, target, method="direct", solver="levenberg-marquardt")
    learner = spec.learner and spec.learner.scaled(model.config.length, model.config.interval)
    return dataclasses.replace(controller, config=dataclasses.replace(controller.config, residual=learner))
