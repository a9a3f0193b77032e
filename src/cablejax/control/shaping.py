"""A trained model, the controller around it, and one run of both on the plant."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from cablejax.adaptation.belief import AdaptationConfig
from cablejax.cable import Cable
from cablejax.control.cable_inputs import CableInputs, inputs_of, inputs_of_weights
from cablejax.control.loop import run_closed_loop
from cablejax.control.run import ClosedLoopRun
from cablejax.control.targets import Target, straight_start
from cablejax.dynamics.bfloat16_slopes import with_bfloat16_slopes
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.model import apply, structure_of
from cablejax.dynamics.weights import cable_of_weights, load_info, load_weights
from cablejax.effects import OUTSIDE
from cablejax.effects.given import GivenEffect
from cablejax.limits import shown
from cablejax.mpc import MPC, SOLVERS, MPCConfig
from cablejax.perceive.camera import CameraConfig
from cablejax.perceive.plant import CloudPlant
from cablejax.residual import STATIC, Dynamics, LearnerConfig
from cablejax.residual.jacobian import StepJacobian, reverse
from cablejax.simulate.chain.statics import Statics, statics_with
from cablejax.simulate.elastica import elastica
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.solver_names import SolverName
from cablejax.types import History

_NEAR = 0.01
"""By how much a target's ends may be closer or farther apart than the grippers may be, in lengths of the cable."""

Method = Literal["residual", "direct"]
"""The learned model with the online residual, or as it was trained."""

METHODS: tuple[Method, ...] = get_args(Method)
"""Both methods."""

Runs = Mapping[tuple[str, Method], ClosedLoopRun]
"""Runs by name of the target and method."""


@dataclasses.dataclass(frozen=True)
class Model:
    """A trained model in the form that the controller takes.

    Attributes:
        name: where it came from.
        config: its graph and sizes.
        dynamics: `(weights, history, twist) -> displacement`.
        weights: its arrays.
        cable: nominal cable of the data that it was trained on.
        effects: effects in those data, as `DatasetConfig.effects_shown` has them.
        known: effects that the model was informed of after its training, see `knowing`.
        believed: descriptor of the cable before anything was seen, for a conditioned model: see `cable_descriptor`.
        inputs: mean and limits of that descriptor in the data that a conditioned model was trained on.
    """

    name: str
    config: ModelConfig
    dynamics: Dynamics
    weights: nnx.State
    cable: Cable
    effects: tuple[str, ...] = ()
    known: tuple[str, ...] = ()
    believed: tuple[float, float] = (0.0, 0.0)
    inputs: CableInputs = dataclasses.field(default_factory=CableInputs)


@dataclasses.dataclass(frozen=True)
class NetworkDynamics:
    """A network as a function of its weights. Equal structures are equal, so that the controller compiles once for all.

    Attributes:
        graphdef: the network's structure.
    """

    graphdef: nnx.GraphDef

    def __call__(self, weights: nnx.State, history: History, twist: Float[Array, "2 3"]) -> Float[Array, "N 2"]:
        """Displacement of every keypoint [m] under a twist held for one interval."""
        return apply((self.graphdef, weights), history, twist)

    def jacobian(self, weights: nnx.State, history: History, twist: Float[Array, "2 3"]) -> StepJacobian:
        """Derivatives of a step: exact in float64, good to about a thousandth in float32 (`dynamics.bfloat16_slopes`).

        The grasped keypoints move as their grippers do, so that only the others' cotangents go through the network.
        """
        network = with_bfloat16_slopes(nnx.merge(self.graphdef, weights))
        between = reverse(lambda history, twist: apply(network, history, twist)[1:-1], history, twist)
        padded = StepJacobian(*(jnp.pad(part, [(1, 1)] + [(0, 0)] * (part.ndim - 1)) for part in between))
        grasped = network.config.interval * jnp.eye(2, 3, dtype=twist.dtype)
        return padded._replace(twist=padded.twist.at[0, :, 0].set(grasped).at[-1, :, 1].set(grasped))


def load_model(name: str) -> Model:
    """A released model by name, or the one in a training's folder.

    Raises:
        ValueError: there is no such model, its file does not fit this version of the network, or it names no cable.
    """
    config, graphdef, weights = load_weights(name)
    effects = load_info(name).get("effects", [])
    if not isinstance(effects, list) or not all(isinstance(effect, str) for effect in effects):
        raise ValueError(f"{name} records the effects {shown(effects)}, expected a list of texts.")
    cable = cable_of_weights(name)
    inputs = inputs_of_weights(name, cable) if config.conditioned else CableInputs()
    dynamics = NetworkDynamics(graphdef)
    return Model(name, config, dynamics, weights, cable, tuple(effects), believed=inputs.mean, inputs=inputs)


def knowing(model: Model, effects: Sequence[GivenEffect]) -> Model:
    """The model informed that its cable has these effects, without retraining.

    Its static prior rests as a cable with them does (`stiffness_profile`, `intrinsic_curvature`,
    `gripper_rotation_offset`, `gripper_compliance`); a conditioned model begins with the ratios of stiffness and
    friction that they make (`bending_stiffness`, `table_friction`, `linear_density`), within those of its training
    data. What else they do is left to the network and to what is learned online.

    Raises:
        ValueError: nothing of the effects enters the model, one acts for a time only, or the model was trained on one
            that is none of its inputs, and would have it twice; names the ways that remain.
    """
    if passing := [str(one) for one in effects if not one.lasting]:
        raise ValueError(
            f"{', '.join(passing)} acts for a time, but a model is informed of what acts all the time: leave from_s "
            "and until_s out."
        )
    trained = {text.partition(":")[0].partition(" ")[0] for text in model.effects}
    twice = [str(one) for one in effects if one.name in trained and not _input_alone(model, one)]
    if twice:
        raise ValueError(
            f"The model {model.name} was trained on data with {', '.join(twice)}, and would have it twice: leave it "
            "out (--with, --effect)."
        )
    if effects and not enters(model, effects):
        names = ", ".join(map(str, effects))
        if all(effect.name in OUTSIDE for effect in effects):
            raise ValueError(f"{names}: a model is of the cable. Correct the camera; poses of arms are measured.")
        raise ValueError(
            f"Nothing of {names} enters the model {model.name}: neither the rest of its cable, "
            "nor stiffness and friction of a conditioned model, such as gns-conditioned. Simulate data with it "
            "(`cablejax simulate --with`) and train on them (`cablejax train --start-from`)."
        )
    config = dataclasses.replace(model.config, statics=_statics(model, effects))
    return dataclasses.replace(
        model,
        config=config,
        dynamics=NetworkDynamics(structure_of(config)[0]),
        known=tuple(map(str, effects)),
        believed=model.inputs.with_effects(effects, model.cable) if config.conditioned else model.believed,
    )


def enters(model: Model, effects: Sequence[GivenEffect]) -> bool:
    """Whether anything of these effects enters the model, see `knowing`."""
    return bool(effects) and (_changes_inputs(model, effects) or _statics(model, effects) != Statics())


def _input_alone(model: Model, effect: GivenEffect) -> bool:
    """Whether an effect enters a model by its inputs alone, which training data with it vary as well."""
    return _changes_inputs(model, (effect,)) and _statics(model, (effect,)) == Statics()


def _changes_inputs(model: Model, effects: Sequence[GivenEffect]) -> bool:
    nominal, changed = (inputs_of(given, model.cable) for given in ((), effects))
    return model.config.conditioned and not np.allclose(changed, nominal, atol=1e-6)


def _statics(model: Model, effects: Sequence[GivenEffect]) -> Statics:
    """The resting shape of the model's cable with effects, where it has a prior that rests."""
    return statics_with(effects, model.cable) if model.config.prior == "static" else Statics()


def make_controller(model: Model, target: Target, *, method: Method, solver: SolverName) -> MPC:
    """The controller for one target, with or without the online residual; a conditioned model adapts in any case.

    Bounds on motions scale with the cable's length, see `MPCConfig.for_length`.

    Raises:
        ValueError: the target is not of the model's cable, or there is no such method or solver.
    """
    for name, value, known in (("method", method, get_args(Method)), ("solver", solver, tuple(SOLVERS))):
        if value not in known:
            raise ValueError(f"The {name} is {value!r}, expected one of {', '.join(known)}.")
    if len(target.keypoints) != model.config.n_keypoints:
        raise ValueError(
            f"Target {target.name!r} has {len(target.keypoints)} keypoints, expected {model.config.n_keypoints} as "
            f"the model {model.name}: use a model that was trained on this cable."
        )
    target.require_length(model.config.length, f"the model {model.name}")
    learner, adaptation = STATIC if model.config.prior == "static" else LearnerConfig(), None
    if model.config.conditioned:
        adaptation = AdaptationConfig(
            prior_mean=model.believed,
            error_std=AdaptationConfig.error_std * model.config.length,
            limits=model.inputs.limits,
        )
    config = MPCConfig.for_length(
        model.config.length,
        residual=learner.scaled(model.config.length, model.config.interval) if method == "residual" else None,
        adaptation=adaptation,
        solver=SOLVERS[solver],
        history_length=model.config.history,
    )
    objective = dataclasses.replace(config.objective, interval=model.config.interval)
    return MPC(dataclasses.replace(config, objective=objective), model.dynamics, model.weights, target.keypoints)


def not_within_reach(target: Target, config: MPCConfig) -> str:
    """A sentence on why no controller can bring a cable exactly to a target; empty if one can."""
    apart, length = float(np.linalg.norm(target.keypoints[-1] - target.keypoints[0])), config.cable_length
    low, high = config.min_distance * length, config.max_distance * length
    if low - _NEAR * length <= apart <= high + _NEAR * length:
        return ""
    return (
        f"The ends of {target.name} are {100 * apart:.3g} cm apart, and the controller keeps the grippers "
        f"{100 * low:.3g} to {100 * high:.3g} cm apart (`MPCConfig.min_distance`, `max_distance`): the cable can only "
        "come near it."
    )


def initial_history(cable: Cable, config: ModelConfig) -> History:
    """The history of a straight cable at rest, before the controller's first command."""
    pose = straight_start(cable)
    keypoints = elastica(pose, cable.length, cable.keypoint_arclength)
    return History(
        keypoints=np.repeat(keypoints[None], config.history, axis=0),  # pyright: ignore[reportArgumentType]
        gripper_pose=pose,  # pyright: ignore[reportArgumentType]
    )


def check_fit(model: Model, cable: Cable) -> None:
    """Checks that a model can be used on a cable: they agree in length and keypoints.

    Raises:
        ValueError: they do not; names both.
    """
    config = model.config
    if cable.n_keypoints != config.n_keypoints or abs(cable.length - config.length) > 1e-9:
        raise ValueError(
            f"The model {model.name} is for {config.n_keypoints} keypoints on {config.length} m of cable, but the "
            f"plant has {cable.n_keypoints} on {cable.length} m: train one for this cable, or change the plant."
        )
    if cable.marks is not None and np.ptp(np.diff(cable.marks)) > 1e-6 * cable.length:
        raise ValueError(
            f"The plant's keypoints are unevenly spaced, but the model {model.name} expects {config.n_keypoints} at "
            "equal distances along the cable: give the plant's cable n_keypoints instead of marks."
        )


def shape_once(
    plant: PlantConfig,
    model: Model,
    target: Target,
    *,
    method: Method,
    solver: SolverName,
    steps: int,
    camera: CameraConfig | None = None,
) -> ClosedLoopRun:
    """One straight cable brought to one target on a plant of its own.

    Args:
        plant: what the cable and its table really are.
        model: what the controller believes.
        target: the wanted shape.
        method: with the online residual, or without.
        solver: how plans are found.
        steps: commands.
        camera: what the cable is seen with; None = the controller observes the simulated keypoints directly.

    Raises:
        ValueError: the plant's cable is not the one that the model was made for.
    """
    check_fit(model, plant.cable)
    cable, config = plant.cable, model.config
    return run_closed_loop(
        Plant(plant) if camera is None else CloudPlant(plant, camera=camera),
        make_controller(model, target, method=method, solver=solver),
        target,
        steps,
        start=straight_start(cable),
        interval=config.interval,
    )
