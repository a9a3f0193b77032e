"""The effect library: null values, sensitivities and derivatives of every entry."""

from __future__ import annotations

import dataclasses
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.diagnose import LIBRARY, CableEffect, Parameter
from cablejax.diagnose.case import FINE_LINKS
from cablejax.diagnose.check import check_effect
from cablejax.effects.base import Context
from cablejax.effects.camera import in_camera_frame
from cablejax.effects.effect import Effect
from cablejax.effects.given import EFFECTS, GivenEffect, parse_effect, with_effects
from cablejax.effects.physics import nominal_physics
from cablejax.simulate import MjxEngine, compiler_options
from cablejax.simulate.chain.replay import Chain
from diagnose_cases import evidence

NAMES = {
    "bending_stiffness", "stiffness_profile", "intrinsic_curvature", "plasticity", "bending_hysteresis",
    "bending_damping", "axial_stretch", "table_friction", "friction_patch", "viscous_drag", "gravity_tilt",
    "linear_density", "lumped_mass", "gripper_slip", "gripper_rotation_offset", "gripper_compliance",
    "camera_similarity", "keypoint_bias", "camera_lag", "obstacle",
}  # fmt: skip


def test_library_has_every_effect_of_cable_and_camera():
    assert {effect.name for effect in LIBRARY} == NAMES


@pytest.mark.parametrize("effect", LIBRARY, ids=lambda e: e.name)
def test_effect_passes_its_check(effect):
    check_effect(effect)


PLACE = np.array([4.0, -6.0])


@pytest.mark.parametrize("effect", LIBRARY, ids=lambda e: e.name)
def test_an_effect_about_another_place_is_reported_in_the_worlds_frame(effect):
    """What is reported is what the effect of the library does."""
    config, moved = Discretisation(n_links=12), effect.around(PLACE)
    nominal, variant = nominal_physics(config), effect.variants[:2][-1]
    values = [np.float32(p.value(np.float64(0.7))) for p in moved.parameters]
    physics = moved.apply(nominal, values, variant, config)
    reported = {name: value for name, (value, _) in moved.reported(values, variant, config).items()}
    own, own_variant = effect.given(reported, config)
    same = effect.apply(nominal, [np.float32(value) for value in own], own_variant, config)
    for one, other in zip(jax.tree.leaves(physics), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=2e-6)
    assert moved.given(reported, config)[0] == pytest.approx(values, rel=1e-5, abs=1e-6)
    if effect.name == "camera_similarity":  # a small rotation about the cable is no large offset
        turned = moved.apply(nominal, [np.float32(v) for v in (1.0, 0.02, 0.0, 0.0)], 0, config)
        there = in_camera_frame(turned, PLACE.astype(np.float32)[None])[0]
        np.testing.assert_allclose(there, PLACE, atol=1e-6)


@pytest.mark.parametrize("effect", LIBRARY, ids=lambda e: e.name)
def test_an_effect_given_twice_acts_twice_or_is_refused(effect):
    chain = Discretisation(Cable())
    believed = nominal_physics(chain, np.float64)
    once, other = ([np.float64(p.value(np.float64(z))) for p in effect.parameters] for z in (0.4, 0.9))

    def both(first, second):
        return effect.apply(effect.apply(believed, first, effect.variants[0], chain), second, effect.variants[0], chain)

    # where the order matters, the second takes something from the first
    one, another = both(once, other), both(other, once)
    same = all(np.allclose(getattr(one, f.name), getattr(another, f.name)) for f in dataclasses.fields(one))
    # a factor that is stated as a value does not set that value where it finds another
    stated = effect.reported(once, effect.variants[0], chain)
    same &= all(name != "ratio" or name in stated for name in (p.name for p in effect.parameters))
    # two cameras show what the second makes of the first one's image
    first, second = (effect.apply(believed, values, effect.variants[0], chain) for values in (once, other))
    point = np.array([[0.3, -0.2]])
    same &= np.allclose(in_camera_frame(one, point), in_camera_frame(second, in_camera_frame(first, point)))
    assert same != effect.alone


@pytest.mark.parametrize("number", ["1_0", "0x2", "nan", ""])
def test_a_parameter_is_a_plain_number(number):
    with pytest.raises(ValueError, match="not of the form parameter=number with a finite number"):
        parse_effect(f"bending_stiffness:ratio={number}")


def test_a_time_is_given_once():
    with pytest.raises(ValueError, match="has a time twice, expected from_s and until_s once"):
        parse_effect("bending_stiffness:ratio=2,from_s=1,from_s=2")


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=lambda e: e.name)
def test_symmetric_effects_have_no_side_no_end_and_no_place(effect):
    chain, symmetric = Discretisation(Cable()), True
    believed = nominal_physics(chain, np.float64)
    for variant in effect.variants[:2]:
        values = [np.float64(p.value(np.float64(0.8))) for p in effect.parameters]
        physics = effect.apply(believed, values, variant, chain)
        by_place = {f.name: np.asarray(getattr(physics, f.name)) for f in dataclasses.fields(physics)}
        ends = ("stiffness", "extra_mass", "slip", "rotation_compliance", "bias_across", "bias_along")
        sides = ("rest_curvature", "tilt", "rotation_offset", "bias_across", "patch_friction", "obstacle_radius")
        camera = (physics.camera_angle, *physics.camera_offset, physics.camera_scale - 1, physics.camera_lag)
        symmetric &= all(np.allclose(by_place[name], by_place[name][::-1]) for name in ends)
        symmetric &= not any(by_place[name].any() for name in sides) and not np.any(camera)
    assert symmetric == effect.symmetric


def test_two_patches_at_a_time_are_refused():
    chain, text = Discretisation(Cable()), "friction_patch:x_m={},y_m=0,radius_m=0.1,coefficient=0.6,from_s={}"
    one, other, later = (parse_effect(text.format(x, start)) for x, start in ((0.2, 0), (0.5, 10), (0.5, 20)))
    with pytest.raises(ValueError, match=r"friction_patch is given twice .* each effect once"):
        with_effects(nominal_physics(chain), [one, other], chain)
    with_effects(nominal_physics(chain), [dataclasses.replace(one, until_s=20.0), later], chain)


def test_a_patch_has_its_coefficient_whatever_the_table_around_has():
    chain = Discretisation(Cable())
    patch = parse_effect("friction_patch:x_m=0.2,y_m=0,radius_m=0.1,coefficient=0.1")
    rough = parse_effect("table_friction:coefficient=0.6")
    for effects in ([patch, rough], [rough, patch]):
        physics = with_effects(nominal_physics(chain, np.float64), effects, chain)
        assert physics.friction == pytest.approx(0.6, abs=1e-6)
        assert physics.friction + physics.patch_friction == pytest.approx(0.1, abs=1e-6)


class _Shift(CableEffect):
    """Moves all keypoints aside, even at its null value if told so."""

    name = "shift"
    parameters = (Parameter("offset_m", "m", -1.0, 1.0, 0.0, 0.01),)
    null = (0.0,)
    bias = 0.0
    gain = 1.0

    def apply(self, physics, values, variant, config):
        return dataclasses.replace(physics, camera_angle=physics.camera_angle + self.gain * values[0] + self.bias)

    def starts(self, context):
        return [(0, (0.01,))]


def test_check_accepts_an_effect_of_a_users_own():
    check_effect(_Shift())


def test_check_refuses_a_null_value_that_changes_something():
    effect = _Shift()
    effect.bias = 0.1
    with pytest.raises(ValueError, match="null value"):
        check_effect(effect)


def test_check_refuses_an_effect_that_does_nothing():
    effect = _Shift()
    effect.gain = 0.0
    with pytest.raises(ValueError, match="micrometre"):
        check_effect(effect)


def test_check_refuses_a_parameter_that_is_rounded_away():
    class Rounded(_Shift):
        def apply(self, physics, values, variant, config):
            angle = physics.camera_angle + 0.001 * jnp.round(1e3 * values[0])
            return dataclasses.replace(physics, camera_angle=angle)

    with pytest.raises(ValueError, match="'offset_m' changes nothing from one of its values to the next"):
        check_effect(Rounded())


def test_check_refuses_what_is_no_effect():
    class Elsewhere(_Shift):
        hook = "tabel"  # pyright: ignore[reportAssignmentType]

    class Forgets(_Shift):
        def apply(self, physics, values, variant, config):
            dataclasses.replace(physics, camera_angle=values[0])

    for wrong, message in (
        (_Shift, "expected a `CableEffect`: add brackets"),
        ("shift", "expected a `CableEffect`"),
        (Elsewhere(), "has the hook 'tabel', expected one of"),
        (Forgets(), "`apply` gave a NoneType, expected the changed Physics"),
    ):
        with pytest.raises(ValueError, match=message):
            check_effect(wrong)  # pyright: ignore[reportArgumentType]


def test_check_refuses_a_hidden_derivative():
    class Hidden(_Shift):
        def apply(self, physics, values, variant, config):
            return dataclasses.replace(physics, camera_angle=physics.camera_angle + jax.lax.stop_gradient(values[0]))

    with pytest.raises(ValueError, match="derivative"):
        check_effect(Hidden())


@pytest.mark.slow
def test_chain_moves_like_the_mjx_engine():
    config = Discretisation(n_links=13, timestep=0.002)
    engine = MjxEngine(config)
    pose = np.array([[0.0, 0.0, 0.5], [0.8, 0.0, -0.4]])
    twist = np.zeros((10, 2, 3))
    twist[:, 0] = [0.01, 0.02, 0.1]
    twist[:, 1] = [-0.02, 0.01, -0.2]
    with jax.enable_x64(True):
        state = engine.initial_state(pose)
        _, trajectory = engine.rollout(nominal_physics(config), state, twist, 0.1)
        poses = np.concatenate([pose[None], pose + np.cumsum(twist, axis=0) * 0.1])
        rollout = jax.jit(
            lambda *args: Chain(config).rollout(*args, n_substeps=50), compiler_options=compiler_options()
        )
        physics = nominal_physics(config, dtype=jnp.float64)
        points = rollout(physics, state.qpos[2:], jnp.asarray(poses), jnp.asarray(0.1))
        difference = np.abs(np.asarray(points) - np.asarray(trajectory.keypoints)).max()
    moved = np.abs(np.asarray(points[-1] - points[0])).max()
    assert moved > 0.01
    assert difference < 2e-5


@pytest.mark.parametrize("other", [(), (("bending_stiffness", (0.6,)),)], ids=["alone", "and a softer cable"])
def test_obstacle_is_sought_where_the_observed_cable_is_stopped(other):
    disc = np.array([0.42, 0.25, 0.03])
    facts = evidence(("obstacle", tuple(disc)), *other, n_links=FINE_LINKS)
    effect = {one.name: one for one in LIBRARY}["obstacle"]
    starts = [values for _, values in facts.simulator.starts(effect, facts.nominal, facts.observed - facts.nominal)]
    assert 1 <= len(starts) <= 3
    for x, y, radius in starts:
        assert np.linalg.norm(facts.observed - [x, y], axis=-1).min() > radius - 1e-6
    assert np.hypot(*(np.array(starts[0][:2]) - disc[:2])) < disc[2]


def test_obstacle_is_sought_with_keypoints_that_were_not_seen():
    disc = np.array([0.42, 0.25, 0.03])
    facts = evidence(("obstacle", tuple(disc)), n_links=FINE_LINKS)
    effect = {one.name: one for one in LIBRARY}["obstacle"]
    residual = facts.observed - facts.nominal
    # one never, and every fifth of the others
    residual[:, :, 4] = np.nan
    residual[np.random.default_rng(0).random(residual.shape[:3]) < 0.2] = np.nan
    (_, (x, y, _)), *_ = facts.simulator.starts(effect, facts.nominal, residual)
    assert np.hypot(x - disc[0], y - disc[1]) < disc[2]


def test_no_obstacle_is_sought_where_nothing_was_seen():
    facts = evidence()
    effect = {one.name: one for one in LIBRARY}["obstacle"]
    assert not facts.simulator.starts(effect, facts.nominal, np.full_like(facts.nominal, np.nan))


def test_values_that_a_verdict_rounded_at_a_bound_are_at_it():
    config = Discretisation(Cable(length=0.7312874513))
    given = GivenEffect("gripper_slip", (("gripper", 0), ("time_s", 3.0), ("distance_m", -0.2)))
    assert np.min(given.applied(nominal_physics(config), config).slip) == np.float32(-0.2)
    width = float(f"{config.cable.length:.6g}")
    wide = GivenEffect("stiffness_profile", (("centre_m", 0.3), ("width_m", width), ("ratio", 2.0)))
    assert wide.applied(nominal_physics(config), config).stiffness.max() > 0
    with pytest.raises(ValueError, match=r"distance_m is -0\.21"):
        GivenEffect("gripper_slip", (("gripper", 0), ("time_s", 3.0), ("distance_m", -0.21))).applied(
            nominal_physics(config), config
        )


@pytest.mark.parametrize("values", [(1.0, 0.3), (0.0, 0.97), (-0.6, 0.8)])
def test_a_tilt_is_given_as_it_was_reported(values):
    tilt, config = EFFECTS["gravity_tilt"], Discretisation()
    told = {name: float(f"{value:.4f}") for name, (value, _) in tilt.reported(values, 0, config).items()}
    given = GivenEffect(tilt.name, tuple(told.items())).applied(nominal_physics(config), config)
    sine = np.array(values) / max(1.0, np.hypot(*values))
    np.testing.assert_allclose(given.tilt, 9.81 * sine, atol=2e-3)


@pytest.mark.parametrize("name", ["lumped_mass", "stiffness_profile", "intrinsic_curvature"])
def test_a_place_that_is_not_given_is_the_middle_of_the_cable(name):
    effect = EFFECTS[name]
    *medians, last = effect.parameters
    values, _ = effect.given({last.name: last.high}, Discretisation(Cable(length=0.4)))
    assert values == (*(p.centre for p in medians), last.high)
    assert effect.location(values, 0, Discretisation(Cable(length=0.4)))["along_cable_m"][0] <= 0.2


def test_any_of_many_keypoints_may_be_off():
    config = Discretisation(Cable(n_keypoints=90))
    physics = parse_effect("keypoint_bias:index=80,offset_m=0.01").applied(nominal_physics(config), config)
    assert np.flatnonzero(np.asarray(physics.bias_along)).tolist() == [80]


def test_a_patch_on_a_smooth_table_has_its_stated_coefficient():
    config = Discretisation(Cable(friction_coefficient=0.0))
    for coefficient in (0.05, 0.008):
        patch = parse_effect(f"friction_patch:x_m=0,y_m=0,radius_m=0.1,coefficient={coefficient}")
        physics = patch.applied(nominal_physics(config), config)
        assert float(physics.friction + physics.patch_friction) == pytest.approx(coefficient)


def test_a_scale_seen_about_another_origin_comes_with_another_offset():
    camera, points = EFFECTS["camera_similarity"], np.array([[4.0, 1.0], [4.5, 0.8]])
    values = {"scale": 1.05, "angle_rad": 0.1, "x_m": -0.1, "y_m": 0.02}
    place = (4.0, 1.0)
    config = Discretisation()

    def seen(parameters, at):
        physics = GivenEffect("camera_similarity", tuple(parameters.items())).applied(nominal_physics(config), config)
        return in_camera_frame(physics, at.astype(np.float32))

    moved = camera.seen_from(values, place)
    np.testing.assert_allclose(seen(moved, points - place) + place, seen(values, points), atol=1e-5)


def test_a_short_cable_that_is_carried_far_is_searched_for_obstacles_in_time():
    time = np.linspace(0.0, 1.0, 300)
    centre = np.stack([np.sin(2 * np.pi * time), np.sin(4 * np.pi * time)], axis=-1)
    cable = np.stack([np.linspace(0.0, 0.08, 13), 0.01 * np.sin(np.linspace(0.0, 3.0, 13))], axis=-1)
    keypoints = (centre[:, None] + cable)[None]
    config = Discretisation(Cable(length=0.1, diameter=1e-3))
    about = Context(config, keypoints, np.full_like(keypoints, 2e-3), 30.0, np.ones(1))
    tracemalloc.start()
    EFFECTS["obstacle"].starts(about)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 300e6


def test_an_effect_without_an_opposite_is_not_reversible():
    positive = Parameter("size", "", 1e-3, 1e3, 1.0, 1.0, log=True)
    with pytest.raises(ValueError, match="its opposite does not exist"):
        Effect(name="mine", parameters=(positive,), null=(0.0,), amplitude=0, reversible=True)


@pytest.mark.parametrize(
    "text",
    [
        "axial_stretch:stiffness_n=-5",
        "gripper_compliance:gripper=1,stiffness_n_m_per_rad=-0.05",
        "viscous_drag:coefficient_n_s_per_m2=-0.005",
        "viscous_drag:coefficient_n_s_per_m2=0",
    ],
)
def test_a_value_below_a_small_bound_is_refused(text):
    config = Discretisation()
    with pytest.raises(ValueError, match="expected 0"):
        parse_effect(text).applied(nominal_physics(config), config)
