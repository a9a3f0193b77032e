"""The closed-form chain as an engine, and the effects in all engines."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from cablejax.cable import Cable, Discretisation
from cablejax.effects.arms import delayed
from cablejax.effects.given import EFFECTS, GivenEffect, parse_effect, with_effects
from cablejax.effects.physics import Physics, nominal_physics, normal_gravity
from cablejax.simulate import ENGINES, ChainEngine, MjxEngine, check_effects
from cablejax.simulate.chain.geometry import levers
from cablejax.simulate.composite import link_lengths
from cablejax.simulate.engine import compiled_rollout
from cablejax.simulate.friction import on_table
from cablejax.simulate.motions import MotionConfig, random_motion

POSE = np.array([[-0.45, 0.0, 0.5], [0.45, 0.0, -0.5]])
GIVEN = tuple(
    map(
        parse_effect,
        (
            "bending_stiffness:ratio=3",
            "stiffness_profile:centre_m=0.3,width_m=0.2,ratio=0.3",
            "intrinsic_curvature:centre_m=0.3,width_m=0.2,curvature_per_m=2",
            "plasticity:yield_curvature_per_m=1.5",
            "bending_hysteresis:moment_n_m=0.02,transition_curvature_per_m=0.5",
            "bending_damping:time_s=2",
            "axial_stretch:stiffness_n=5",
            "table_friction:coefficient=0.3,static_excess=0.5",
            "friction_patch:x_m=0,y_m=0.2,radius_m=0.12,coefficient=1",
            "viscous_drag:coefficient_n_s_per_m2=5",
            "gravity_tilt:angle_rad=0.1,direction_rad=1",
            "linear_density:ratio=3",
            "lumped_mass:centre_m=0.4,mass_kg=0.1",
            "gripper_slip:gripper=1,time_s=1,distance_m=-0.02",
            "gripper_rotation_offset:gripper=0,angle_rad=0.1",
            "gripper_compliance:gripper=0,stiffness_n_m_per_rad=0.3",
            "camera_similarity:scale=1.02,angle_rad=0.05,x_m=0.01,y_m=0.0",
            "keypoint_bias:index=2,offset_m=0.01",
            "camera_lag:time_s=0.3",
            "actuation_gain:gain=0.8",
            "actuation_lag:time_s=0.4,delay_s=0.1",
        ),
    )
)


def motion() -> np.ndarray:
    twist = np.zeros((3, 2, 3))
    twist[:, 0] = [0.03, 0.01, 0.15]
    twist[:, 1] = [-0.03, -0.01, 0.1]
    return twist


def keypoints(engine, physics, twist=None) -> np.ndarray:
    _, trajectory = engine.rollout(physics, engine.initial_state(POSE), motion() if twist is None else twist)
    return np.asarray(trajectory.keypoints)


def test_chain_follows_mjx_within_a_hundredth_of_a_millimetre():
    """After 3 s at equal links. The chain is within 3 um at 50 ms, where MJX is within 10 um at 20 ms."""
    runs = {}
    for engine, timestep in ((ChainEngine, 0.002), (ChainEngine, 0.05), (MjxEngine, 0.002), (MjxEngine, 0.02)):
        config = Discretisation(n_links=17, timestep=timestep)
        runs[engine.name, timestep] = keypoints(engine(config), nominal_physics(config))
    fine = runs["chain", 0.002]
    assert np.abs(fine[-1] - fine[0]).max() > 0.02
    assert np.abs(runs["chain", 0.05] - fine).max() <= 3e-6
    assert np.abs(runs["mjx", 0.002] - fine).max() <= 1e-5
    assert np.abs(runs["mjx", 0.02] - fine).max() <= 1e-5


def test_a_lumped_mass_is_a_point_as_in_mjx():
    """A bead of three times the cable's mass, in a fast motion: not a rod of a link's length."""
    cable = Cable(n_keypoints=9, bending_stiffness=0.02, linear_density=0.05, friction_coefficient=0.0)
    config, twist = Discretisation(cable, n_links=9, timestep=0.001), np.zeros((20, 2, 3))
    twist[:4, 1, 1], twist[:4, 0, 2] = 0.3, -1.5
    pose, bead = np.array([[0.0, 0.0, 0.9], [0.7, 0.0, -0.9]]), np.zeros(9)
    bead[2] = 0.15
    physics = dataclasses.replace(nominal_physics(config), extra_mass=bead)
    runs = []
    for engine in (ChainEngine(config), MjxEngine(config)):
        _, trajectory = engine.rollout(physics, engine.initial_state(pose), twist, 0.05)
        runs.append(np.asarray(trajectory.keypoints))
    assert np.abs(runs[0] - runs[0][0]).max() > 0.05
    assert np.abs(runs[0] - runs[1]).max() <= 3e-5


def test_the_first_step_of_a_command_knows_that_the_grippers_have_turned_round():
    """Friction follows the new direction at once: to and fro at 50 ms is to and fro at 2 ms, within 20 um."""
    twist, runs = np.repeat(motion()[:1], 4, axis=0) * np.array([1, -1, 1, -1])[:, None, None], []
    for timestep in (0.002, 0.05):
        config = Discretisation(n_links=17, timestep=timestep)
        runs.append(keypoints(ChainEngine(config), nominal_physics(config), twist))
    assert np.abs(runs[0][1:] - runs[0][0]).max() > 0.02
    assert np.abs(runs[1] - runs[0]).max() <= 2e-5


@pytest.fixture(scope="module")
def nominal():
    config = Discretisation(Cable(n_keypoints=5), n_links=9)
    return config, {name: keypoints(engine(config), nominal_physics(config)) for name, engine in ENGINES.items()}


def test_every_effect_is_given_once():
    assert sorted(effect.name for effect in GIVEN) == sorted(EFFECTS.keys() - {"obstacle"})


@pytest.mark.slow
def test_an_obstacle_keeps_the_cable_out():
    """The arch rises by 10 cm, and a disc stands 1 cm in its way: a spring, into which the cable goes 1 mm deep."""
    config = Discretisation(Cable(n_keypoints=25), n_links=25)
    still = keypoints(ChainEngine(config), nominal_physics(config))
    (x, y), radius = still[-1, 12], 0.03
    place = {"x_m": float(x), "y_m": float(y) + radius - 0.01, "radius_m": radius}
    physics = with_effects(nominal_physics(config), [GivenEffect("obstacle", tuple(place.items()))], config)
    able = {name: engine for name, engine in ENGINES.items() if "obstacle" in engine.hooks}
    found = {name: keypoints(engine(config), physics) for name, engine in able.items()}
    assert found.keys() == {"chain", "mjx"}
    for name, points in found.items():
        distance = np.linalg.norm(points - [place["x_m"], place["y_m"]], axis=-1).min()
        assert radius - 2e-3 < distance < radius + 2e-3, name
        assert np.abs(points - still).max() > 5e-3
    assert np.abs(found["mjx"] - found["chain"]).max() <= 3e-4


@pytest.mark.parametrize("name", ENGINES)
def test_effects_act_alike_in_every_engine_that_honours_them(nominal, name):
    """What an effect moves in MJX and C is what it moves in the chain, to a twentieth and 0.2 mm."""
    config, still = nominal
    engine = ENGINES[name](config)
    for given in GIVEN:
        if given.effect.hook not in engine.hooks:
            continue
        physics = with_effects(nominal_physics(config), [given], config)
        moved = keypoints(engine, physics) - still[name]
        expected = keypoints(ChainEngine(config), physics) - still["chain"]
        size = np.abs(expected).max()
        assert size > 3e-4, f"{given} does not show"
        assert np.abs(moved - expected).max() <= 0.05 * size + 2e-4, str(given)


def test_grippers_carry_the_ends_as_they_would_a_beam_on_a_table():
    """Against the least energy of a beam that a gripper holds level 1 mm above a table into which it may not sink."""
    cable, height, count = Cable(), 1e-3, 200
    weight, h = 9.81 * cable.linear_density, 0.5 * cable.length / count
    # second differences of the heights, of which the first is the gripper's and mirrored about it
    bend = np.eye(count, k=-2) - 2.0 * np.eye(count, k=-1) + np.eye(count)
    bend[0, 0], held = np.sqrt(2.0), np.zeros(count)
    held[0], held[1] = -np.sqrt(2.0) * height, height
    hessian = cable.bending_stiffness / h**3 * bend.T @ bend
    gradient = cable.bending_stiffness / h**3 * bend.T @ held + weight * h
    root = np.linalg.cholesky(hessian).T
    found = scipy.optimize.lsq_linear(root, -np.linalg.solve(root.T, gradient), (0.0, np.inf), method="bvls")
    pressed = np.where(found.x > 0, 0.0, hessian @ found.x + gradient)
    lands = h * (1 + np.argmax(pressed > 0))

    config = Discretisation(cable, n_links=65)
    physics = dataclasses.replace(nominal_physics(config, np.float64), grip_height=np.float64(height))
    mass = np.full(config.n_links, cable.linear_density * config.link_length)
    load = 9.81 * on_table(physics, mass, config.link_length)
    np.testing.assert_allclose(load, load[::-1], atol=1e-12)
    assert np.argmax(load > 0) * config.link_length == pytest.approx(lands, abs=config.link_length)
    # either gripper has a held half link besides
    hanging = 0.5 * (9.81 * mass[1:-1].sum() - load[1:-1].sum() + 9.81 * mass[0])
    assert hanging == pytest.approx(0.5 * weight * (cable.length + h) - pressed.sum(), rel=0.01)


def test_what_hangs_has_a_slope_where_a_joint_has_no_stiffness():
    """Of both grippers that lie on the table, in every joint; the power that says how far they lift has none at 0."""
    config = Discretisation(n_links=8)
    with jax.enable_x64(True):
        physics = jax.tree.map(jnp.asarray, nominal_physics(config, np.float64))
        mass = jnp.full(config.n_links, 0.01)
        for stiffness in (0.0 * physics.stiffness, physics.stiffness.at[0].set(0.0)):
            slope = jax.grad(
                lambda k: jnp.sum(on_table(dataclasses.replace(physics, stiffness=k), mass, config.link_length) ** 2)
            )(stiffness)
            np.testing.assert_array_equal(slope, 0.0)


def test_without_weight_the_table_carries_what_it_may():
    """Gravity in the table's plane presses nothing on it, and lifts nothing off."""
    config = Discretisation(n_links=8)
    physics = dataclasses.replace(nominal_physics(config, gravity=(0, -9.81, 0)), grip_height=np.float32(1e-3))
    mass = np.full(config.n_links, 0.01, np.float32)
    np.testing.assert_array_equal(on_table(physics, mass, config.link_length), mass)


def test_grippers_that_carry_the_ends_do_so_in_every_engine(nominal):
    config, still = nominal
    physics = dataclasses.replace(nominal_physics(config), grip_height=np.float32(2e-3))
    expected = keypoints(ChainEngine(config), physics) - still["chain"]
    assert 1e-4 < np.abs(expected).max() < 0.02
    for name, engine in ENGINES.items():
        moved = keypoints(engine(config), physics) - still[name]
        assert np.abs(moved - expected).max() <= 0.05 * np.abs(expected).max() + 1e-5, name


@pytest.mark.parametrize("name", ENGINES)
def test_null_values_leave_a_rollout_as_it_is(nominal, name):
    config, still = nominal
    engine = ENGINES[name](config)
    physics = nominal_physics(config)
    for effect in EFFECTS.values():
        if effect.name != "obstacle":
            physics = effect.apply(physics, [np.float32(v) for v in effect.null], effect.variants[0], config)
    np.testing.assert_array_equal(keypoints(engine, physics), still[name])
    # a disc that is far away is looked for, by another program that rounds otherwise
    far = EFFECTS["obstacle"]
    physics = far.apply(physics, [np.float32(v) for v in far.null], 0, config)
    np.testing.assert_allclose(keypoints(engine, physics), still[name], rtol=0, atol=5e-7)


def test_what_an_engine_cannot_simulate_is_refused_with_those_that_can():
    plastic = [GivenEffect("plasticity", (("yield_curvature_per_m", 2.0),))]
    check_effects(plastic, "chain")
    for engine in ("mjx", "threaded"):
        with pytest.raises(ValueError, match=rf"{engine} cannot simulate plasticity.* memory.*: chain\."):
            check_effects(plastic, engine)
    compliant = [parse_effect("gripper_compliance:gripper=0,stiffness_n_m_per_rad=0.3")]
    with pytest.raises(ValueError, match=r"threaded cannot simulate gripper_compliance.*: mjx, chain\."):
        check_effects(compliant, "threaded")
    with pytest.raises(ValueError, match="dimension 3"):
        ChainEngine(Discretisation(dimension=3))


def test_a_rollout_goes_on_where_another_ended():
    """Bends that stay, a slip at a time and friction go on from the state; so do samples of a finer command."""
    config = Discretisation(Cable(n_keypoints=5), n_links=9)
    engine = ChainEngine(config)
    effects = [effect for effect in GIVEN if effect.name in ("plasticity", "bending_hysteresis", "gripper_slip")]
    physics = with_effects(nominal_physics(config), effects, config)
    final, whole = engine.rollout(physics, engine.initial_state(POSE), motion())
    state, first = engine.rollout(physics, engine.initial_state(POSE), motion()[:1])
    state, rest = engine.rollout(physics, state, motion()[1:])
    np.testing.assert_allclose(first.keypoints, whole.keypoints[:2], atol=1e-6)
    np.testing.assert_allclose(rest.keypoints, whole.keypoints[1:], atol=2e-6)
    assert np.abs(np.asarray(final.memory.set_curvature)).max() > 0.1
    np.testing.assert_allclose(state.memory.set_curvature, final.memory.set_curvature, atol=1e-3)


def test_a_batch_equals_its_members():
    config = Discretisation(Cable(n_keypoints=5), n_links=9)
    engine = ChainEngine(config)
    one = [with_effects(nominal_physics(config), [effect], config) for effect in GIVEN[2:4]]
    states = engine.initial_state(np.stack([POSE, POSE * [1, 1, -1]]))
    physics = jax.tree.map(lambda *leaves: np.stack(leaves), *one)
    _, batch = engine.rollout(physics, states, np.stack([motion(), 0.5 * motion()]))
    for i in range(2):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], states)
        _, alone = engine.rollout(one[i], state, motion() * (1.0 - 0.5 * i))
        np.testing.assert_allclose(batch.keypoints[i], alone.keypoints, atol=2e-6)


def test_an_arm_that_lags_follows_its_command_late():
    """A ramp of one second, then rest: what is left decays from 0.4 s of motion with a time constant of 0.4 s."""
    config = Discretisation(Cable(n_keypoints=5), n_links=9)
    given = parse_effect("actuation_lag:time_s=0.4")
    twist = np.zeros((3, 2, 3))
    twist[0, :, 0] = 0.02
    for name, engine in ENGINES.items():
        physics = with_effects(nominal_physics(config), [given], config)
        simulator = engine(config)
        _, trajectory = simulator.rollout(physics, simulator.initial_state(POSE), twist)
        late = np.asarray(trajectory.gripper_pose)[:, 0, 0] - POSE[0, 0]
        left = 0.4 * (1 - np.exp(-1 / 0.4))
        expected = [0.0, 0.02 * (1 - left), 0.02 * (1 - left * np.exp(-1 / 0.4)), 0.02 * (1 - left * np.exp(-2 / 0.4))]
        np.testing.assert_allclose(late, expected, atol=2e-6, err_msg=name)
        np.testing.assert_allclose(trajectory.gripper_twist, twist, atol=1e-8)


@pytest.mark.parametrize("engine", ENGINES.values())
def test_a_cable_without_damping_stays_finite(engine):
    """Bending waves are faster than the time step; without damping MuJoCo's step let them grow without bound."""
    config = Discretisation(Cable(damping_time=0.0), n_links=13)
    fine = keypoints(ChainEngine(dataclasses.replace(config, timestep=0.001)), nominal_physics(config))
    coarse = keypoints(engine(config), nominal_physics(config))
    assert np.abs(coarse - fine).max() < 2e-3


SMALL = Discretisation(Cable(n_keypoints=4), n_links=7)
SMOOTH = {
    "bending": ("stiffness", "rest_curvature", "damping_time"),
    "extension": ("axial_compliance", "slip", "slip_time"),
    "memory": ("yield_curvature", "hardening", "hysteresis_moment", "hysteresis_curvature"),
    "table": (
        *("friction", "static_excess", "patch_centre", "patch_radius", "patch_friction", "drag", "tilt", "gravity"),
        "grip_height",
    ),
    "mass": ("density", "extra_mass"),
    "grasp": ("rotation_offset",),
    "compliance": ("rotation_compliance",),
    "input": ("actuation_gain", "actuation_delay", "actuation_time"),
    "observation": ("bias_along", "bias_across", "camera_scale", "camera_angle", "camera_offset", "camera_lag"),
    "obstacle": ("obstacle_centre", "obstacle_radius"),
}


def acting(dtype) -> Physics:
    """Every effect at work, away from kinks."""
    nominal = nominal_physics(SMALL, dtype)
    values = {
        "stiffness": nominal.stiffness * np.linspace(0.8, 1.4, SMALL.n_joints),
        "rest_curvature": np.linspace(-0.5, 0.8, SMALL.n_joints),
        "axial_compliance": 0.02,
        "slip": np.array([0.004, -0.006]),
        "slip_time": 0.6,
        "yield_curvature": 1.2,
        "hardening": 0.4,
        "hysteresis_moment": 0.004,
        "hysteresis_curvature": 0.7,
        "static_excess": 0.3,
        "patch_centre": np.array([0.05, 0.1]),
        "patch_radius": 0.1,
        "patch_friction": 0.1,
        "drag": 0.5,
        "tilt": np.array([0.2, -0.1]),
        "grip_height": 1e-4,
        "extra_mass": np.linspace(0.0, 0.01, SMALL.n_links),
        "rotation_offset": np.array([0.03, -0.02]),
        "rotation_compliance": np.array([0.3, 0.1]),
        "obstacle_centre": np.array([0.0, 0.17]),
        "obstacle_radius": 0.03,
        "bias_along": np.array([0.0, 0.01, -0.006, 0.0]),
        "bias_across": np.array([0.0, 0.004, 0.002, 0.0]),
        "camera_scale": 1.02,
        "camera_angle": 0.03,
        "camera_offset": np.array([0.01, -0.02]),
        "camera_lag": 0.13,
        "actuation_gain": 0.9,
        "actuation_delay": 0.07,
        "actuation_time": 0.2,
    }
    return dataclasses.replace(nominal, **{name: np.asarray(value, dtype) for name, value in values.items()})


@pytest.fixture(scope="module", params=["chain", "mjx"])
def programs(request):
    """The last keypoints of half a second in five commands, and their derivatives in both modes."""
    engine = ENGINES[request.param](SMALL)

    def final(physics, state, twist):
        return engine.unroll(physics, state, twist, 0.2)[1].keypoints[-2:]

    @jax.jit
    def push(physics, state, twist, direction):
        return jax.jvp(lambda physics, twist: final(physics, state, twist), (physics, twist), direction)[1]

    @jax.jit
    def pull(physics, state, twist, cotangent):
        return jax.vjp(lambda physics, twist: final(physics, state, twist), physics, twist)[1](cotangent)

    return engine, jax.jit(final), push, pull


@pytest.mark.slow
def test_a_rollout_is_differentiable_within_programs_of_the_callers():
    engine = ChainEngine(Discretisation(n_links=5, timestep=0.05))
    physics, state = nominal_physics(engine.config), engine.initial_state(np.array([[-0.35, 0, 1], [0.35, 0, -1]]))

    def moved(twist):
        return jnp.sum(engine.rollout(physics, state, twist, 0.1)[1].keypoints ** 2)

    twist = jnp.full((2, 2, 3), 0.01)
    slopes = [jax.grad(moved)(twist), jax.jit(jax.grad(moved))(twist), jax.jacfwd(moved)(twist)]
    for slope in slopes[1:]:
        np.testing.assert_allclose(slope, slopes[0], rtol=1e-3, atol=1e-5)
    assert np.abs(slopes[0]).max() > 0.01
    # `bench simulate` asks the compiled program for its memory
    program = compiled_rollout(engine, physics, 0, 0.1).lower(physics, state, twist)
    assert program.compile().memory_analysis().temp_size_in_bytes > 0


@pytest.mark.parametrize("lag", [0.0, 0.1, 0.13])
def test_the_derivative_by_a_lag_is_that_of_becoming_later(lag):
    values = jnp.array(np.random.default_rng(0).normal(size=(6, 2)))
    slope = jax.jacfwd(lambda time: delayed(values, time / 0.1))(lag)
    step = 1e-3
    np.testing.assert_allclose(
        slope, (delayed(values, (lag + step) / 0.1) - delayed(values, lag / 0.1)) / step, rtol=1e-2, atol=2e-2
    )


@pytest.mark.slow
@pytest.mark.parametrize("start", ["moving", "straight at rest"])
def test_derivatives_in_every_hook(programs, start):
    """JVP against central differences, relative 1e-5, and against VJP, for every parameter of every hook."""
    engine, final, push, pull = programs
    with jax.enable_x64(True):
        as_double = functools.partial(jax.tree.map, lambda leaf: jnp.asarray(leaf, jnp.float64))
        pose, speed = (POSE, 1.0) if start == "moving" else (np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]), 0.0)
        twist = as_double(speed * np.repeat(motion()[:1], 5, axis=0))
        physics, state = as_double(acting(np.float64)), as_double(engine.initial_state(pose))
        if start != "moving":
            # a straight cable between fixed grippers has no freedom to follow these
            fixed = {"slip": 0.0, "rotation_offset": 0.0, "axial_compliance": 0.02, "obstacle_radius": 0.0}
            physics = dataclasses.replace(
                physics, **{name: jnp.full_like(getattr(physics, name), value) for name, value in fixed.items()}
            )
        nothing = jax.tree.map(jnp.zeros_like, (physics, twist))
        found = {}
        for hook in sorted(engine.hooks):
            for name in SMOOTH[hook]:
                leaf = getattr(physics, name)
                direction = jnp.ones_like(leaf) * jnp.where(leaf == 0, 0.01, leaf)
                if name == "bias_along":
                    # an end's keypoint moves inwards only: `test_simulate_keypoints.py`
                    direction = direction.at[jnp.array([0, -1])].set(0.0)
                change = (dataclasses.replace(nothing[0], **{name: direction}), nothing[1])
                exact = push(physics, state, twist, change)
                # the grasps of a taut cable are nearly one condition too many, which rounds coarsely: the more so, the
                # smaller the step, and the larger it is, the more curvature is in it
                sizes = (1e-5,) if start == "moving" else (1e-4, 1e-3)

                def shifted(s, name=name, direction=direction):
                    moved = dataclasses.replace(physics, **{name: getattr(physics, name) + s * direction})
                    return final(moved, state, twist)

                differences = [
                    (8 * (shifted(size) - shifted(-size)) - (shifted(2 * size) - shifted(-2 * size))) / (12 * size)
                    for size in sizes
                ]
                scale = jnp.abs(differences[0]).max()
                cotangent = jnp.asarray(np.random.default_rng(5).standard_normal(exact.shape))
                gradient = jnp.sum(getattr(pull(physics, state, twist, cotangent)[0], name) * direction)
                found[name] = (
                    min(float(jnp.abs(exact - difference).max()) for difference in differences),
                    float(scale),
                    float(jnp.abs(jnp.sum(exact * cotangent) - gradient)),
                )
        wrong = {n: v for n, v in found.items() if v[0] > 1e-5 * v[1] + 1e-10 or v[2] > 1e-7 * (v[1] + 1e-3)}
        assert not wrong, wrong
        if start == "moving":
            # ten times what the comparison resolves
            silent = [name for name, value in found.items() if value[1] < 1e-9]
            assert not silent, silent


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.0, -9.81, 0.0), (0.0, 0.0, -9.81)])
def test_weight_has_a_derivative_without_weight_too(gravity):
    """The mass that the grippers carry, and gravity across a table in whose plane all of it lies."""
    config = Discretisation(Cable(), n_links=9)
    with jax.enable_x64(True):
        nominal = jax.tree.map(jnp.asarray, nominal_physics(config, np.float64, gravity=gravity))
        mass = jnp.full(config.n_links, 0.01)

        def carried(change):
            stiffness, tilt = nominal.stiffness * (1 + change[0]), nominal.tilt + change[1]
            physics = dataclasses.replace(nominal, stiffness=stiffness, tilt=tilt)
            return jnp.append(on_table(physics, mass, config.link_length), normal_gravity(physics))

        derivative = jax.jit(jax.jacfwd(carried))(jnp.zeros(2))
        assert np.isfinite(derivative).all() and np.abs(derivative).max() < 1.0


ROPE = Cable(length=2.2, bending_stiffness=4e-4, linear_density=0.09, friction_coefficient=0.5)
"""Friction bends it over a decimetre: its links are hardly shorter."""


def test_a_soft_rope_rests_in_single_precision():
    config = Discretisation(ROPE, timestep=0.05)
    pose = jnp.array([[[0, 0, 0.3], [share * 2.2, 0.22, -0.2]] for share in (0.5, 0.7, 0.9)], jnp.float32)
    engine = ChainEngine(config)
    physics = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], 3, axis=0), nominal_physics(config))
    points = engine.rollout(physics, engine.initial_state(pose), jnp.zeros((3, 20, 2, 3)))[1].keypoints
    np.testing.assert_allclose(points, np.broadcast_to(points[:, :1], points.shape), atol=1e-4)


def test_a_soft_rope_that_buckles_stays_finite():
    config = Discretisation(ROPE, timestep=0.05)
    motion = MotionConfig.for_length(ROPE.length)
    poses, twists = zip(
        *(random_motion(np.random.default_rng(seed), config, 20, motion) for seed in range(8)), strict=True
    )
    engine = ChainEngine(config)
    physics = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], 8, axis=0), nominal_physics(config))
    points = engine.rollout(physics, engine.initial_state(jnp.array(poses)), jnp.array(twists))[1].keypoints
    assert np.isfinite(points).all() and np.abs(points).max() < 2 * ROPE.length


def test_a_loose_chain_between_steady_grippers_keeps_its_energy():
    """Without friction, damping or stiffness, as seen from the grippers: centrifugal forces do no work."""
    with jax.enable_x64(True):
        loose = Cable(n_keypoints=9, friction_coefficient=0.0, bending_stiffness=1e-9, damping_time=0.0)
        config = Discretisation(loose, n_links=9, timestep=1e-3)
        engine, physics, twist = ChainEngine(config), nominal_physics(config, np.float64), np.zeros((1, 2, 3))
        twist[..., :2] = 0.3
        state = engine.initial_state(np.array([[-0.3, 0.0, 1.0], [0.3, 0.05, -0.7]]))
        energies = []
        for time in (1e-3, 0.1, 0.1):  # first the grippers' jump
            state, _ = engine.rollout(physics, state, twist, time)
            energies.append(kinetic_energy(config, state, twist[0, 0, :2]))
    np.testing.assert_allclose(energies, energies[0], rtol=0.01)


def kinetic_energy(config: Discretisation, state, velocity) -> float:
    """Of all links relative to grippers that move with a velocity [J]."""
    qpos, qvel, length = np.asarray(state.qpos), np.asarray(state.qvel), link_lengths(config)
    theta, rate, mass = np.cumsum(qpos[2:]), np.cumsum(qvel[2:]), config.cable.linear_density * length
    across = rate[:, None] * np.stack([-np.sin(theta), np.cos(theta)], axis=1)
    of_nodes = qvel[:2] - velocity + levers(config) @ across
    return float(0.5 * (mass @ (of_nodes**2).sum(axis=1) + mass @ (length * rate) ** 2 / 12))


def test_a_short_cable_held_above_the_table_is_lifted_once():
    config = Discretisation(Cable(length=0.3), n_links=17)
    physics = dataclasses.replace(nominal_physics(config), grip_height=np.float32(1e-3))
    mass = on_table(physics, np.full(17, 0.08 * config.link_length, np.float32), config.link_length)
    assert np.min(mass) >= 0 and np.argmax(mass) == 8 and np.sum(mass) < 0.5 * 0.08 * 0.3
