"""Gymnasium's environment: its rules, its randomisation, its vector form and a controller as its policy."""

import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

# ruff: noqa: E402
gymnasium = pytest.importorskip("gymnasium", reason="needs Gymnasium: pip install 'cablejax[rl]'")

from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from cablejax.cable import Cable, Discretisation
from cablejax.control.targets import make_target
from cablejax.dataset.schema import Randomisation
from cablejax.environment import (
    ENVIRONMENT,
    LinkPolicy,
    MjxShapeCable,
    ShapeCableConfig,
    ShapeCableEnv,
    ShapeCableVectorEnv,
)
from cablejax.mpc import MPC, LevenbergMarquardt, MPCConfig
from mpc_cases import relaxing_cable

CONFIG = ShapeCableConfig(
    discretisation=Discretisation(cable=Cable(n_keypoints=7), n_links=8, timestep=0.05),
    randomisation=Randomisation(stiffness=(0.3, 3.0), friction=(0.5, 2.0)),
    keypoint_noise=1e-3,
    steps=4,
)


def clean(**changes):
    return dataclasses.replace(CONFIG, keypoint_noise=0.0, randomisation=Randomisation(), **changes)


def rollout(env, actions, **options):
    first, _ = env.reset(seed=0, options=options)
    return np.stack([first["keypoints"], *[env.step(action)[0]["keypoints"] for action in actions]])


def random_actions(count, seed=0, envs=()):
    return np.random.default_rng(seed).uniform(-1, 1, (count, *envs, 2, 3)).astype(np.float32)


def test_it_follows_gymnasiums_rules():
    env = gymnasium.make(ENVIRONMENT, config=CONFIG)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_other_libraries_make_it_with_pictures_and_without_a_warning():
    """As `make_vec_env` of Stable-Baselines3 does."""
    env = gymnasium.make(ENVIRONMENT, config=clean(), render_mode="rgb_array")
    with pytest.raises(ResetNeeded):
        env.unwrapped.render()
    env.reset(seed=0, options={"target": "U"})
    before = env.render()
    for _ in range(4):
        env.step(np.full((2, 3), 1.0))
    after = env.render()
    assert before.shape == after.shape == (480, 480, 3) and before.dtype == np.uint8
    assert 0.001 < (before != after).any(axis=-1).mean() < 0.1
    many = gymnasium.make_vec(ENVIRONMENT, 2, config=clean(), render_mode="rgb_array")
    many.reset(seed=0, options={"target": "U"})
    np.testing.assert_array_equal(many.render()[1], before)


def test_without_a_render_mode_nothing_is_drawn():
    env = ShapeCableEnv(CONFIG)
    env.reset()
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.render() is None


def test_the_length_of_an_episode_is_the_configurations():
    """Gymnasium's own time limit would be the same for every configuration."""
    env = gymnasium.make(ENVIRONMENT, config=CONFIG)
    assert env.spec.max_episode_steps is None and env.unwrapped.config.steps == CONFIG.steps


def test_what_of_an_action_was_executed_is_reported():
    config, turn = clean(steps=30), np.zeros((2, 3), np.float32)
    turn[:, 2] = 1.0, -1.0
    env, many = ShapeCableEnv(config), ShapeCableVectorEnv(2, config)
    assert not env.reset(seed=0)[1]["executed_action"].any()
    many.reset(seed=0)
    executed = []
    for _ in range(25):
        before = env.cables.gripper_pose[0].copy()
        executed.append(env.step(turn)[-1]["executed_action"])
        moved = env.cables.gripper_pose[0] - before
        np.testing.assert_allclose(executed[-1], moved / config.scale, atol=1e-5)
        both = many.step(np.stack([turn, 0.1 * turn]))[-1]["executed_action"]
        np.testing.assert_allclose(both[0], executed[-1], atol=1e-5)
    np.testing.assert_allclose(executed[0], turn, atol=0.01)
    assert not executed[-1].any()


def test_an_episode_ends_in_time_or_at_the_target():
    env = ShapeCableEnv(CONFIG)
    env.reset(seed=1)
    ends = [env.step(action)[2:4] for action in random_actions(4)]
    assert ends == [(False, False)] * 3 + [(False, True)]
    near = ShapeCableEnv(dataclasses.replace(CONFIG, tolerance=0.9))
    near.reset(seed=1)
    _, reward, terminated, truncated, info = near.step(np.zeros((2, 3)))
    assert terminated and not truncated and reward == -info["error"] < 0


def test_the_same_seed_is_the_same_episode_and_another_is_not():
    env = ShapeCableEnv(CONFIG)
    runs = [rollout(env, random_actions(3)) for _ in range(2)]
    np.testing.assert_array_equal(*runs)
    other, _ = env.reset(seed=5)
    assert np.abs(other["keypoints"] - runs[0][0]).max() > 1e-4
    names = {env.reset()[1]["target_name"] for _ in range(20)}
    assert names == {"U", "S", "Z"}


def test_cables_side_by_side_differ_from_run_to_run_unless_they_are_seeded():
    runs = [ShapeCableVectorEnv(3, CONFIG) for _ in range(2)]
    first = [env.reset()[0]["keypoints"] for env in runs]
    assert np.abs(first[0] - first[1]).min(axis=(1, 2)).max() > 0
    np.testing.assert_array_equal(*(env.reset(seed=np.int64(4))[0]["keypoints"] for env in runs))
    with pytest.raises(ValueError, match="2 seeds, expected one number, or one for each of 3"):
        runs[0].reset(seed=[1, 2])


def test_effects_targets_and_random_parameters_change_the_episode():
    actions, env = np.full((4, 2, 3), [[1.0, 0.3, -1.0], [-1.0, 0.3, 1.0]]), ShapeCableEnv(clean())
    plain = rollout(env, actions, target="S")
    again = rollout(env, actions, target="S", effects=["bending_stiffness:ratio=0.1", "table_friction:coefficient=0.5"])
    shift = np.abs(again - plain).max(axis=(1, 2))
    # other parameters, and the cable has come to rest with them
    assert shift[0] < 1e-6 and shift[-1] > 1e-3
    np.testing.assert_array_equal(env.reset(options={"target": "U"})[0]["target"].shape, (7, 2))
    varied = ShapeCableEnv(dataclasses.replace(clean(), randomisation=Randomisation(stiffness=(0.1, 0.2))))
    assert np.abs(rollout(varied, actions, target="S") - plain)[-1].max() > 1e-3


def test_the_first_observation_has_the_effects_of_the_reset():
    env = ShapeCableEnv(clean())
    bare, _ = env.reset(seed=1)
    given, _ = env.reset(seed=1, options={"effects": ["keypoint_bias:index=3,across=1,offset_m=0.05"]})
    after = env.step(np.zeros((2, 3), np.float32))[0]
    np.testing.assert_allclose(after["keypoints"], given["keypoints"], atol=1e-4)
    assert given["keypoints"][3, 1] - bare["keypoints"][3, 1] == pytest.approx(0.05, abs=1e-3)


def test_the_grippers_stay_within_their_limits():
    env = ShapeCableEnv(clean(steps=30))
    env.reset(seed=0)
    for action in np.full((30, 2, 3), [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]):  # apart
        observation, *_ = env.step(action)
    distance = np.linalg.norm(np.diff(observation["gripper_pose"][:, :2], axis=0))
    assert 0.99 <= distance <= 0.995
    for action in np.full((30, 2, 3), [[1.0, 0.0, np.nan], [-1.0, 0.0, 0.0]]):  # together
        observation, *_ = env.step(action)
        assert env.observation_space.contains(observation)
    assert 0.1 <= np.linalg.norm(np.diff(observation["gripper_pose"][:, :2], axis=0)) <= 0.11
    observation, *_ = env.step(np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 1e9]]))
    np.testing.assert_allclose(observation["gripper_pose"][:, 2], [-0.01 + 0.5 / 3, 0.01 + 1 / 3], atol=1e-5)


def test_the_vector_form_is_many_of_the_single_one():
    actions = random_actions(6, envs=(3,))
    many = gymnasium.make_vec(ENVIRONMENT, 3, vectorization_mode="vector_entry_point", config=CONFIG)
    seen, _ = many.reset(seed=10)
    singles = [ShapeCableEnv(CONFIG) for _ in range(3)]
    first = [env.reset(seed=10 + row)[0] for row, env in enumerate(singles)]
    np.testing.assert_array_equal(seen["keypoints"], [one["keypoints"] for one in first])
    for step, action in enumerate(actions):
        seen, rewards, terminated, truncated, info = many.step(action)
        assert many.observation_space.contains(seen) and not terminated.any()
        assert truncated.tolist() == [step == 3] * 3
        if step == 4:  # they begin again
            each = [env.reset() for env in singles]
            np.testing.assert_array_equal(rewards, 0.0)
        else:
            each = [env.step(own) for env, own in zip(singles, action, strict=True)]
            np.testing.assert_allclose(rewards, [one[1] for one in each], atol=1e-5)
        np.testing.assert_allclose(seen["keypoints"], [one[0]["keypoints"] for one in each], atol=1e-4)
        assert info["target_name"].tolist() == [one[-1]["target_name"] for one in each]


def test_a_reset_without_the_configured_effects_is_one_of_the_nominal_cable():
    bent = clean(targets=("U",), effects=("intrinsic_curvature:centre_m=0.3,width_m=0.2,curvature_per_m=5",))
    still = np.zeros((2, 2, 3))
    shown = [
        rollout(ShapeCableEnv(one), still, effects=effects)
        for one, effects in ((bent, []), (dataclasses.replace(bent, effects=()), None), (bent, None))
    ]
    np.testing.assert_allclose(shown[0], shown[1], atol=1e-5)
    assert np.abs(shown[2] - shown[1]).max() > 0.01 and np.abs(np.diff(shown[2], axis=0)).max() < 1e-3


@pytest.mark.parametrize("value", [np.nan, 1e20])
def test_a_cable_that_diverges_ends_its_episode_alone(value):
    many = ShapeCableVectorEnv(3, clean())
    many.reset(seed=0)
    many.cables._state.qpos[1] = value
    seen, _, terminated, _, _ = many.step(np.full((3, 2, 3), 0.1))
    assert terminated.tolist() == [False, True, False] and many.observation_space.contains(seen)
    assert not many.cables.executed[1].any()
    seen, rewards, terminated, _, _ = many.step(np.zeros((3, 2, 3)))
    assert not terminated.any() and rewards[1] == 0.0
    seen, rewards, terminated, _, _ = many.step(np.zeros((3, 2, 3)))
    assert not terminated.any() and rewards[1] < 0.0


@pytest.mark.parametrize("form", ["gymnasium", "jax"])
def test_reward_is_of_the_true_keypoints_where_a_marker_is_off_its_place(form):
    biased = clean(targets=("U",), effects=("keypoint_bias:index=6,across=1,offset_m=0.08",))
    seen, errors = [], []
    for one in (biased, dataclasses.replace(biased, effects=())):
        if form == "gymnasium":
            env = ShapeCableEnv(one)
            env.reset(seed=0)
            after, _, _, _, info = env.step(np.full((2, 3), 0.1, np.float32))
            seen.append(after["keypoints"])
            errors.append(info["error"])
        else:
            env = MjxShapeCable(one)
            state = env.step(env.reset(jax.random.key(0)), jnp.full(6, 0.1))
            seen.append(np.asarray(state.obs)[: 2 * one.cable.n_keypoints].reshape(-1, 2))
            errors.append(float(state.metrics["error"]))
    assert errors[0] == pytest.approx(errors[1], rel=1e-5)
    apart = np.linalg.norm(seen[0] - seen[1], axis=1)
    assert apart[6] == pytest.approx(0.08, abs=1e-5) and np.delete(apart, 6).max() < 1e-5


@pytest.mark.parametrize("form", ["gymnasium", "jax"])
def test_reward_is_of_the_true_keypoints_where_the_camera_is_off(form):
    """From the first observation on; without noise the error is not that of what is observed."""
    config = clean(targets=("U",), effects=("camera_similarity:scale=1.05,angle_rad=0.05,x_m=0.05,y_m=0.05",))
    plain, target = dataclasses.replace(config, effects=()), make_target("U", config.cable).keypoints
    seen, errors = [], []
    for one in (config, plain):
        if form == "gymnasium":
            env = ShapeCableEnv(one)
            first, info = env.reset(seed=0)
            second, _, _, _, after = env.step(np.zeros((2, 3), np.float32))
            seen.append([first["keypoints"], second["keypoints"]])
            errors.append([info["error"], after["error"]])
        else:
            env = MjxShapeCable(one)
            states = [state := env.reset(jax.random.key(0)), env.step(state, jnp.zeros(6))]
            seen.append([np.asarray(state.obs)[: target.size].reshape(target.shape) for state in states])
            errors.append([float(state.metrics["error"]) for state in states])
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-5)
    for off, true in zip(*seen, strict=True):
        turned = true @ np.array([[np.cos(0.05), np.sin(0.05)], [-np.sin(0.05), np.cos(0.05)]])
        np.testing.assert_allclose(off, 1.05 * turned + 0.05, atol=1e-5)


@pytest.mark.parametrize("turn", [(1.0, 1.0), (1.0, -1.0)], ids=["both left", "outwards"])
def test_turning_grippers_do_not_tear_the_cable_out(turn):
    """At almost the full length apart, for longer than a turn: in both forms the ends stay in their grippers."""
    config = clean(steps=30)
    action = np.zeros((2, 3), np.float32)
    action[:, 2] = turn
    env, pure = ShapeCableEnv(config), MjxShapeCable(config)
    env.reset(seed=0)
    state, step = pure.reset(jax.random.key(0)), jax.jit(pure.step)
    for _ in range(25):
        seen, _, terminated, _, _ = env.step(action)
        state = step(state, jnp.asarray(action.ravel()))
        observed = np.split(np.asarray(state.obs), [14, 20])
        for keypoints, pose in ((seen["keypoints"], seen["gripper_pose"]), (observed[0], observed[1])):
            ends = np.reshape(keypoints, (-1, 2))[[0, -1]] - np.reshape(pose, (2, 3))[:, :2]
            assert np.abs(ends).max() < 0.01 * config.cable.length
        assert not terminated and not state.done
    assert np.abs(seen["gripper_pose"][:, 2]).min() > 0.25


@pytest.mark.slow
def test_the_controller_is_a_policy():
    config = clean(steps=30, targets=("U",))
    length = config.cable.length
    env, target = ShapeCableEnv(config), make_target("U", config.cable)
    solver = LevenbergMarquardt(max_iterations=1, trials_per_linearisation=1)
    settings = MPCConfig.for_length(length, horizon=1, history_length=3, solver=solver)
    policy = LinkPolicy(config, lambda goal: MPC(settings, relaxing_cable, 0.8, goal.keypoints))
    observation, first = env.reset(seed=0)
    policy.begin(target)
    errors = [first["error"]]
    for _ in range(30):
        observation, _, terminated, _, info = env.step(policy(observation))
        errors.append(info["error"])
        if terminated:
            break
    assert min(errors) < 0.2 * errors[0]


def test_a_policy_says_why_it_cannot_act():
    config = clean(targets=("U",))
    target = make_target("U", config.cable)
    settings = MPCConfig.for_length(config.cable.length, horizon=1, history_length=3)
    policy = LinkPolicy(config, lambda goal: MPC(settings, relaxing_cable, 0.8, goal.keypoints))
    observation, _ = ShapeCableEnv(config).reset(seed=0)
    with pytest.raises(ValueError, match="call `begin`"):
        policy(observation)
    policy.begin(target)
    with pytest.raises(ValueError, match="keypoints of shape"):
        policy({**observation, "keypoints": observation["keypoints"][::2]})
    policy.begin(target)
    with pytest.raises(ValueError, match="metres"):
        policy({name: 1000 * value for name, value in observation.items()})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"effects": ("no_such_effect:ratio=2",)}, "no_such_effect"),
        ({"effects": ("actuation_lag:time_s=0.1,delay_s=0.1",)}, "lag"),
        ({"targets": ()}, "targets is empty"),
        ({"steps": 0}, "ShapeCableConfig.steps"),
        ({"speed": np.nan}, "ShapeCableConfig.speed"),
        ({"speed": 0.0}, r"ShapeCableConfig\.speed is 0\.0, expected a number from 1e-30"),
        ({"turn_rate": 0.0}, r"ShapeCableConfig\.turn_rate is 0\.0"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(CONFIG, **settings)


def test_wrong_targets_are_refused():
    with pytest.raises(ValueError, match=r"expected \(7, 2\) as the cable"):
        ShapeCableEnv(dataclasses.replace(CONFIG, targets=(make_target("U"),)))
    longer = dataclasses.replace(CONFIG.cable, length=2 * CONFIG.cable.length)
    with pytest.raises(ValueError, match="but the environment is for a cable of 1 m"):
        ShapeCableEnv(CONFIG).reset(options={"target": make_target("U", longer)})
    with pytest.raises(ValueError, match="no shape 'X'"):
        ShapeCableEnv(CONFIG).reset(options={"target": "X"})


def test_a_target_needs_no_name():
    env = ShapeCableEnv(CONFIG)
    target = dataclasses.replace(make_target("U", CONFIG.cable), name="")
    assert env.reset(options={"target": target})[1]["target_name"] == ""
    env.step(np.zeros(env.action_space.shape))


@pytest.mark.parametrize(
    "effect",
    [
        "gripper_slip:gripper=1,time_s=0,distance_m=-0.05",
        "intrinsic_curvature:centre_m=0.5,width_m=0.2,curvature_per_m=30",
    ],
)
def test_a_cable_that_an_effect_has_torn_out_may_be_relieved(effect):
    """Or no action would be executed in the whole episode, whatever it does."""
    env, inwards = ShapeCableEnv(), np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    start, _ = env.reset(seed=0, options={"effects": [effect]})
    for _ in range(5):
        observation, *_ = env.step(inwards)
    assert observation["gripper_pose"][0, 0] - start["gripper_pose"][0, 0] > 0.1


def test_a_number_of_environments_is_a_count():
    with pytest.raises(ValueError, match="num_envs is True, expected a whole number"):
        ShapeCableVectorEnv(True, CONFIG)


@pytest.mark.parametrize("make", [ShapeCableEnv, functools.partial(ShapeCableVectorEnv, 2)])
def test_what_cannot_be_rendered_is_refused(make):
    with pytest.raises(ValueError, match="config is of type dict, expected a ShapeCableConfig"):
        make(config={"length": 1.0})
    with pytest.raises(ValueError, match="render_mode is 'human', expected None"):
        make(config=CONFIG, render_mode="human")


def test_seeds_may_be_an_array():
    one, other = (ShapeCableVectorEnv(2, CONFIG).reset(seed=seeds)[0] for seeds in ([1, 2], np.array([1, 2])))
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name])


@pytest.mark.parametrize("make", [ShapeCableEnv, functools.partial(ShapeCableVectorEnv, 1)])
def test_there_is_no_step_before_a_reset(make):
    env = make(config=CONFIG)
    with pytest.raises(ResetNeeded, match="call `reset` before `step`"):
        env.step(np.zeros(env.action_space.shape))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"discretisation": Cable()}, r"discretisation is a Cable, expected a Discretisation: Discretisation\(cable\)"),
        ({"randomisation": {"friction": 0.1}}, "randomisation is a dict"),
        ({"targets": "USZ"}, "targets is 'USZ', expected a tuple"),
        ({"targets": 3}, "targets is 3, expected a tuple"),
        ({"targets": ("Q",)}, "targets has 'Q', expected U, S, Z or a `Target`"),
        ({"effects": 3}, "Effects are 3, expected a list"),
        ({"effects": [3]}, "An effect is 3, expected NAME:PARAMETER=VALUE"),
    ],
)
def test_settings_of_another_type_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        ShapeCableConfig(**settings)


def test_wrong_options_and_actions_are_refused():
    env = ShapeCableEnv(ShapeCableConfig())
    with pytest.raises(ValueError, match="no option 'targte' of `reset`, expected target or effects"):
        env.reset(options={"targte": "S"})
    with pytest.raises(ValueError, match=r"'bending_stiffness:ratio=2', expected a list"):
        env.reset(options={"effects": "bending_stiffness:ratio=2"})
    for options in ([], ["target"]):
        with pytest.raises(ValueError, match=r"options is of type list, expected a dictionary with target or effects"):
            env.reset(options=options)  # pyright: ignore[reportArgumentType]
    env.reset()
    with pytest.raises(ValueError, match=r"actions have complex values, expected real numbers"):
        env.step(np.zeros((2, 3), complex))
    with pytest.raises(ValueError, match=r"action has shape \(6,\), expected \(2, 3\)"):
        env.step(np.zeros(6))
