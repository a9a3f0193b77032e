"""A model that is informed of effects: its cable rests as one with them does, and it begins with their belief."""

import dataclasses
import json
import re
from typing import get_args

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from cablejax.adaptation.belief import AdaptationConfig
from cablejax.cable import Cable, Discretisation
from cablejax.cable_file import cable_to_fields
from cablejax.cli import main
from cablejax.commands.runs import Job, about, known_from
from cablejax.control.link import RobotLink
from cablejax.control.link_state import LinkConfig
from cablejax.control.shaping import (
    enters,
    initial_history,
    knowing,
    load_model,
    make_controller,
    not_within_reach,
)
from cablejax.control.targets import Shape, make_target, target_from_keypoints
from cablejax.dataset.generate import make_engine, simulate
from cablejax.dataset.schema import DatasetConfig
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.weights import WeightsError, released_names, save_weights
from cablejax.effects.given import GivenEffect, parse_effect
from cablejax.effects.physics import mean_resistance, nominal_physics
from cablejax.mpc import MPCConfig
from cablejax.report.diagnosis_page import INFORMING
from cablejax.residual import STATIC, LearnerConfig
from cablejax.simulate.plant.config import PlantConfig
from cablejax.types import Trajectory, cable_descriptor
from dynamics_cases import SMALL
from open_loop import open_loop_error
from test_dataset_generate import VALUES

CURVED = "intrinsic_curvature:centre_m=0.6,width_m=0.3,curvature_per_m=2"


@pytest.fixture(scope="module")
def model():
    return load_model("gns-reference")


@pytest.mark.slow
def test_a_model_that_knows_the_cause_is_right_without_another_training(model):
    effects = (parse_effect(CURVED),)
    config = DatasetConfig(n_trajectories=2, n_steps=25, seed=5, effects=effects)
    (block,) = simulate(config, make_engine(config), [0])
    data = Trajectory(*(jnp.asarray(a) for a in (block.keypoints, block.gripper_pose, block.gripper_twist)))
    plain, informed = (
        open_loop_error((one.dynamics.graphdef, one.weights), data, one.config, horizons=(20,), stride=5).median_cm[0]
        for one in (model, knowing(model, effects))
    )
    assert informed < 0.1 < 0.5 < plain


@pytest.mark.parametrize("name", released_names())
def test_the_controller_of_every_released_model_takes_a_history(name):
    released = load_model(name)
    controller = make_controller(
        released, make_target("U", released.cable), method="residual", solver="levenberg-marquardt"
    )
    state = controller.init(initial_history(released.cable, released.config))
    assert (state.history.cable is not None) == released.config.conditioned


def test_a_model_is_not_informed_of_what_acts_for_a_time(model):
    with pytest.raises(ValueError, match=r"from_s=5.* acts for a time, but a model is informed of what acts all"):
        knowing(model, (parse_effect(f"{CURVED},from_s=5"),))


def test_what_the_limits_of_a_conditioned_model_leave_out():
    conditioned = load_model("gns-conditioned")
    low, high = conditioned.inputs.limits[0]
    for ratio, left in ((1.5, 0.0), (50.0, 1.0)):
        effects = (parse_effect(f"bending_stiffness:ratio={ratio}"),)
        out = conditioned.inputs.left_out(effects, conditioned.cable)
        beyond = np.log(ratio) - (knowing(conditioned, effects).believed[0] - conditioned.believed[0])
        assert low < high and (out > 0) == (left > 0)
        np.testing.assert_allclose(out, beyond, atol=1e-6)


def test_informed_of_nothing_a_model_is_as_it_was(model):
    same = knowing(model, ())
    assert same.config == model.config and same.dynamics == model.dynamics and same.known == ()


def test_a_conditioned_model_that_records_no_inputs_begins_with_its_own_cable(tmp_path):
    """The inputs are log ratios to the reference cable, which this one is not."""
    cable = Cable(length=0.6, linear_density=0.3, bending_stiffness=0.2, n_keypoints=SMALL.n_keypoints)
    config = dataclasses.replace(SMALL, conditioned=True, length=0.6)
    info = {"cable": cable_to_fields(cable)}
    save_weights(tmp_path / "weights.safetensors", config, nnx.split(GNS(config, nnx.Rngs(0)))[1], info)
    model = load_model(str(tmp_path))
    physics = nominal_physics(Discretisation(cable), np.float64)
    own = np.array([float(x) for x in cable_descriptor(*map(np.asarray, mean_resistance(physics)))])
    assert own.min() > 1.0
    np.testing.assert_allclose(model.believed, own)
    softer = knowing(model, (parse_effect("bending_stiffness:ratio=0.5"),))
    np.testing.assert_allclose(softer.believed, own + np.log([0.5, 1.0]), atol=1e-6)
    adaptation = make_controller(model, make_target("U", cable), method="direct", solver="two-trials").config.adaptation
    np.testing.assert_allclose(np.array(adaptation.limits), own[:, None] + [-2.4, 1.2])


def test_a_conditioned_model_begins_with_what_it_was_trained_on_and_believes_no_more(tmp_path):
    cable, config = Cable(n_keypoints=SMALL.n_keypoints), dataclasses.replace(SMALL, conditioned=True, prior="static")
    weights = nnx.split(GNS(config, nnx.Rngs(0)))[1]

    def saved(**inputs):
        info = {"cable": cable_to_fields(cable), "inputs": inputs}
        save_weights(tmp_path / "weights.safetensors", config, weights, info)
        return load_model(str(tmp_path))

    # five times as stiff, and always on the same table
    limits = ((1.5, 1.7), (0.2, 0.2))
    model = saved(mean=(1.6, 0.2), limits=limits)
    assert model.believed == knowing(model, ()).believed == (1.6, 0.2)
    mpc = make_controller(model, make_target("U", cable), method="direct", solver="two-trials")
    assert mpc.config.adaptation.limits == limits and mpc.config.adaptation.prior_mean == (1.6, 0.2)
    stiffer = knowing(model, (parse_effect("bending_stiffness:ratio=5.2"),))
    np.testing.assert_allclose(stiffer.believed, [np.log(5.2), 0.2], rtol=1e-6)
    # an effect that says nothing of either leaves both; the nominal cable is far from here
    assert knowing(model, (parse_effect(CURVED),)).believed == (1.6, 0.2)
    for wrong in ({"mean": (1.8, 0.2)}, {"mean": (1.6,)}, {"limits": 3}, {"mean": ("soft", 0.2)}, {"range": 1}):
        with pytest.raises(WeightsError, match="records inputs that cannot be used"):
            saved(**{"mean": (1.6, 0.2), "limits": limits} | wrong)


def test_a_conditioned_model_begins_with_what_it_is_informed_of():
    conditioned = load_model("gns-conditioned")
    informed = knowing(conditioned, tuple(map(parse_effect, ("bending_stiffness:ratio=0.5", "linear_density:ratio=2"))))
    np.testing.assert_allclose(informed.believed, np.log([0.5, 2.0]), rtol=1e-5)
    mpc = make_controller(informed, make_target("U", informed.cable), method="direct", solver="levenberg-marquardt")
    assert mpc.config.adaptation is not None and mpc.config.adaptation.prior_mean == informed.believed
    # only the ratio of both matters in slow motion: what is beyond the bound of friction is taken up by stiffness
    far = knowing(conditioned, (parse_effect("linear_density:ratio=8"),))
    np.testing.assert_allclose(far.believed[1] - far.believed[0], np.log(8.0), rtol=1e-5)
    assert far.believed[1] == mpc.config.adaptation.limits[1][1]
    make_controller(far, make_target("U", far.cable), method="direct", solver="levenberg-marquardt")


def test_a_cables_own_rest_curvature_is_no_effect(model):
    """A model has learned it; effects that act otherwise than on the rest do not enter because of it."""
    curved = dataclasses.replace(model, cable=dataclasses.replace(model.cable, rest_curvature=1.5))
    friction, profile = map(parse_effect, ("viscous_drag:coefficient_n_s_per_m2=5", CURVED))
    assert not enters(curved, (friction,)) and enters(curved, (profile,))
    np.testing.assert_allclose(
        knowing(curved, (profile,)).config.statics.rest_curvature,
        knowing(model, (profile,)).config.statics.rest_curvature,
        atol=1e-6,
    )


def test_a_model_without_prior_can_be_informed_of_stiffness_alone():
    model = load_model("gns-no-prior")
    informed = knowing(model, (parse_effect("bending_stiffness:ratio=0.5"),))
    np.testing.assert_allclose(informed.believed, [np.log(0.5), 0.0], atol=1e-5)
    with pytest.raises(ValueError, match="Nothing of intrinsic_curvature"):
        knowing(model, (parse_effect(CURVED),))
    target = make_target("S", model.cable)
    mpc = make_controller(model, target, method="residual", solver="levenberg-marquardt")
    assert mpc.config.residual == LearnerConfig().scaled(model.config.length) and mpc.config.adaptation is not None
    assert make_controller(model, target, method="direct", solver="levenberg-marquardt").config.residual is None


def test_the_error_bar_of_the_adaptation_scales_with_the_cable():
    """As the learner's does: errors of a network are so many parts of the length."""
    model = load_model("gns-conditioned")
    for length in (0.4, 1.0, 1.5):
        config = dataclasses.replace(model.config, length=length)
        cable = dataclasses.replace(model.cable, length=length)
        other = dataclasses.replace(model, config=config)
        found = make_controller(other, make_target("S", cable), method="residual", solver="levenberg-marquardt").config
        assert found.adaptation.error_std == pytest.approx(length * AdaptationConfig.error_std)
        assert found.residual.error_std == pytest.approx(length * LearnerConfig().scaled(1.0, 1.0).error_std)


def test_the_learner_scales_responses_only_of_a_model_without_static_prior(model):
    target = make_target("S", model.cable)
    learner = make_controller(model, target, method="residual", solver="levenberg-marquardt").config.residual
    assert learner == STATIC.scaled(model.config.length)
    assert not any(candidate.response for candidate in STATIC.candidates)
    assert LearnerConfig().candidates[: len(STATIC.candidates)] == STATIC.candidates


def test_what_does_not_enter_a_model_is_refused_with_what_to_do(model, tmp_path, capsys):
    with pytest.raises(ValueError, match=r"Nothing of viscous_drag.* enters.*simulate --with.*--start-from"):
        knowing(model, (parse_effect("viscous_drag:coefficient_n_s_per_m2=2"),))
    with pytest.raises(ValueError, match=r"camera_lag:time_s=0.3.*Correct the camera"):
        knowing(model, (parse_effect("camera_lag:time_s=0.3"),))
    with pytest.raises(
        ValueError, match=r"actuation_gain:gain=0.8: a model is of the cable.*poses of arms are measured"
    ):
        knowing(model, (parse_effect("actuation_gain:gain=0.8"),))
    words = ["shape", "--out", str(tmp_path / "run"), "--effect", "bending_stiffness:ratio=0.3", "--steps", "1"]
    assert main(words) == 2
    assert "such as gns-conditioned" in capsys.readouterr().err
    assert main([*words, "--motion", "next.npz"]) == 2
    assert "--motion uses no model" in capsys.readouterr().err


def test_a_model_is_not_informed_of_what_it_was_trained_on(model):
    offset, drag, stiffness = map(
        parse_effect,
        (
            "gripper_rotation_offset:gripper=0,angle_rad=0.15",
            "viscous_drag:coefficient_n_s_per_m2=2",
            "bending_stiffness:ratio=0.5",
        ),
    )
    trained = (str(offset), "viscous_drag (in 3 of 16 draws)", "bending_stiffness (in 13 of 16 draws)")
    conditioned = load_model("gns-conditioned")
    for one in (model, conditioned):
        one = dataclasses.replace(one, effects=trained)
        for effects in ((offset,), (drag,), (offset, parse_effect(CURVED))):
            with pytest.raises(ValueError, match=f"trained on data with {effects[0].name}.*would have it twice"):
                knowing(one, effects)
        assert knowing(one, (parse_effect(CURVED),)).known
    # stiffness is an input of a conditioned model: it has to be told which cable this is
    assert knowing(dataclasses.replace(conditioned, effects=trained), (stiffness,)).believed[0] < 0
    with pytest.raises(ValueError, match="would have it twice"):
        knowing(dataclasses.replace(model, effects=trained), (stiffness,))


def test_a_page_proposes_to_inform_a_model_of_what_enters_one():
    def informed(name):
        model = load_model(name)
        return {name for name, values in VALUES.items() if enters(model, (GivenEffect(name, values),))}

    assert informed("gns-conditioned") == INFORMING.keys()
    assert informed("gns-reference") == {name for name, words in INFORMING.items() if words == "a model"}


def test_of_look_alikes_a_model_is_informed_of_the_first_that_enters_it(tmp_path):
    def written(effect):
        name, parameters = effect.split(":")
        return {
            "name": name,
            "parameters": {k: float(v) for k, v in (pair.split("=") for pair in parameters.split(","))},
        }

    patch, friction = "friction_patch:x_m=0,y_m=0,radius_m=0.4,coefficient=0.6", "table_friction:coefficient=0.6"
    named = written(patch)
    named["parameters"] = {name: {"value": value} for name, value in named["parameters"].items()}
    verdict = {"schema": "cablejax-verdict/1", "verdict": "ambiguous", "effects": [named]}
    verdict["posterior"] = [[written(patch)], [written(friction)]]
    path = tmp_path / "verdict.json"
    path.write_text(json.dumps(verdict))
    conditioned = load_model("gns-conditioned")
    assert not enters(conditioned, (parse_effect(patch),))
    assert known_from(conditioned, (), (path,)) == (parse_effect(friction),)
    # of a robot whose world begins elsewhere, too
    named["parameters"]["x_m"] = {"value": 4.7}
    verdict["posterior"][0][0]["parameters"]["x_m"] = 4.7
    path.write_text(json.dumps({**verdict, "place_m": [4.5, 0.0]}))
    assert known_from(conditioned, (), (path,)) == (parse_effect(friction),)
    # neither enters a model that knows no friction: the message is about what was named
    with pytest.raises(ValueError, match="Nothing of friction_patch"):
        knowing(load_model("gns-reference"), known_from(load_model("gns-reference"), (), (path,)))


@pytest.mark.slow
def test_shape_with_a_verdict_tells_the_model(tmp_path, capsys):
    parameters = {"centre_m": 0.6, "width_m": 0.3, "curvature_per_m": 2.0}
    effect = {"name": "intrinsic_curvature", "parameters": {name: {"value": v} for name, v in parameters.items()}}
    verdict = {"schema": "cablejax-verdict/1", "verdict": "named", "effects": [effect]}
    (tmp_path / "verdict.json").write_text(json.dumps(verdict))
    words = ["shape", "--target", "S", "--method", "direct", "--steps", "20", "--plant-effect", CURVED, "--json"]
    errors = []
    for name, more in (("plain", []), ("informed", ["--with", str(tmp_path / "verdict.json")])):
        assert main([*words, "--out", str(tmp_path / name), *more]) == 0
        errors.append(json.loads(capsys.readouterr().out)["shapes"]["S"]["terminal_error_without_residual_cm"])
    assert errors[1] < errors[0]
    page = (tmp_path / "informed" / "report.html").read_text()
    assert "It was informed of intrinsic_curvature" in page


def test_what_a_controller_cannot_be_made_of_is_refused():
    model = load_model("gns-reference")
    target, options = make_target("U", model.cable), {"method": "direct", "solver": "levenberg-marquardt"}
    with pytest.raises(ValueError, match=r"0\.5 m long along its keypoints.*for a cable of 1 m"):
        make_controller(model, make_target("U", Cable(length=0.5)), **options)
    for wrong in ({"method": "residuals"}, {"solver": "two-trial"}):
        with pytest.raises(ValueError, match="expected one of"):
            make_controller(model, target, **{**options, **wrong})


def test_a_controller_plans_for_the_models_interval(model):
    config = dataclasses.replace(model.config, interval=0.5)
    target = make_target("S", model.cable)
    fast = dataclasses.replace(model, config=config)
    controller = make_controller(fast, target, method="direct", solver="levenberg-marquardt")
    assert controller.interval == 0.5
    with pytest.raises(ValueError, match=r"plans for 0\.5 s between commands, but the interval of this run is 1 s"):
        RobotLink(controller, target)
    RobotLink(controller, target, LinkConfig(interval=0.5))


def test_a_target_whose_ends_meet_is_out_of_the_grippers_reach(model):
    angle = np.linspace(0, 2 * np.pi, model.config.n_keypoints)
    ring = np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1) * model.cable.length / (2 * np.pi)
    bounds = MPCConfig.for_length(model.config.length)
    assert re.match(
        r"The ends of ring are \S+ cm apart, and the controller keeps the grippers 15 to 99 cm apart .* only come near",
        not_within_reach(target_from_keypoints("ring", ring, model.cable), bounds),
    )
    assert not any(not_within_reach(make_target(shape, model.cable), bounds) for shape in get_args(Shape))


def test_a_plant_whose_cable_is_curved_at_rest_is_not_the_same(model):
    def said(cable):
        chain = dataclasses.replace(PlantConfig().discretisation, cable=cable)
        job = Job(
            plant=PlantConfig(discretisation=chain),
            model=model,
            targets=(make_target("S", model.cable),),
            methods=("direct",),
            solver="levenberg-marquardt",
            steps=1,
        )
        return about(job)

    assert "The plant has the same cable." in said(model.cable)
    curved = said(dataclasses.replace(model.cable, rest_curvature=3.0))
    assert "The plant has curvature at rest 3 1/m (the model's is 0)." in curved and "same cable" not in curved


@pytest.mark.parametrize("ratio", [0.2, 15.0])
def test_a_model_that_estimates_nothing_may_be_of_any_cable(model, ratio):
    cable = dataclasses.replace(model.cable, bending_stiffness=ratio * model.cable.bending_stiffness)
    other = dataclasses.replace(model, cable=cable)
    assert not other.config.conditioned
    controller = make_controller(other, make_target("U"), method="direct", solver="levenberg-marquardt")
    assert controller.config.adaptation is None
