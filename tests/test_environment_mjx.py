"""The environment for learners written in JAX: Gymnasium's one as pure functions, and a stock PPO that learns in it."""

import dataclasses
import importlib.util
import json
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

# ruff: noqa: E402
gymnasium = pytest.importorskip("gymnasium", reason="needs Gymnasium: pip install 'cablejax[rl]'")

from cablejax.cable import Cable, Discretisation
from cablejax.dataset.schema import Randomisation
from cablejax.environment import MjxShapeCable, ShapeCableConfig, ShapeCableEnv
from cablejax.simulate.compile import compiler_options

CONFIG = ShapeCableConfig(
    discretisation=Discretisation(cable=Cable(n_keypoints=7), n_links=8, timestep=0.05),
    targets=("U",),
    effects=("bending_stiffness:ratio=0.5",),
)
VARIED = dataclasses.replace(
    CONFIG,
    targets=("U", "S"),
    randomisation=Randomisation(stiffness=(0.3, 3.0), friction=(0.5, 2.0)),
    keypoint_noise=1e-3,
)


def compiled(function):
    return jax.jit(function, compiler_options=compiler_options())


def test_it_is_gymnasiums_environment():
    pure, stateful = MjxShapeCable(CONFIG), ShapeCableEnv(CONFIG)
    state, step = compiled(pure.reset)(jax.random.key(0)), compiled(pure.step)
    observation, info = stateful.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 2, 3)).astype(np.float32)
    actions[1, 0], actions[2, 1] = (np.nan, 0.5, 9.0), (-np.inf, -5.0, 0.0)
    for action in actions:
        parts = [observation[name].ravel() for name in ("keypoints", "gripper_pose", "target")]
        np.testing.assert_allclose(state.obs, np.concatenate(parts), atol=1e-5)
        np.testing.assert_allclose(state.metrics["error"], info["error"], atol=1e-5)
        state = step(state, action.ravel())
        observation, reward, terminated, _, info = stateful.step(action)
        assert float(state.done) == terminated == 0.0
        np.testing.assert_allclose(state.reward, reward, atol=1e-5)
        np.testing.assert_allclose(state.info["executed_action"], info["executed_action"].ravel(), atol=1e-5)


def test_the_grippers_stay_within_the_same_limits():
    env = MjxShapeCable(CONFIG)
    step, length = compiled(env.step), CONFIG.cable.length
    for outwards, low, high in ((1.0, 0.99, 0.995), (-1.0, 0.1, 0.11)):
        state = env.reset(jax.random.key(0))
        for _ in range(30):
            state = step(state, outwards * jnp.array([-1.0, 0, 0, 1.0, 0, 0]))
        apart = float(jnp.linalg.norm(state.data.gripper_pose[1, :2] - state.data.gripper_pose[0, :2]))
        assert low * length - 1e-5 <= apart <= high * length + 1e-5


def test_every_episode_is_drawn_and_a_key_repeats_it():
    env = MjxShapeCable(VARIED)
    keys = jax.random.split(jax.random.key(1), 64)
    states = compiled(jax.vmap(env.reset))(keys)
    nominal = CONFIG.cable.bending_stiffness * 0.5
    factors = np.asarray(states.info["physics"].stiffness)[:, 0] / nominal
    assert 0.3 <= factors.min() < 0.5 and 2.0 < factors.max() <= 3.0
    assert 0.7 < np.median(factors) < 1.4  # log-uniform
    assert len(np.unique(np.asarray(states.info["target"])[:, 3, 1])) == 2
    spread = np.asarray(states.obs)[:, :14].std(axis=0)
    assert (spread > 0.7e-3).all() and (spread < 1.3e-3).all()
    again = compiled(jax.vmap(env.reset))(keys)
    np.testing.assert_array_equal(states.obs, again.obs)
    np.testing.assert_array_equal(states.info["physics"].stiffness, again.info["physics"].stiffness)


def test_an_episode_is_done_at_the_target_or_where_the_simulation_diverges():
    near = MjxShapeCable(dataclasses.replace(CONFIG, tolerance=0.9))
    state = compiled(near.step)(near.reset(jax.random.key(0)), jnp.zeros(6))
    assert float(state.done) == 1.0
    env = MjxShapeCable(CONFIG)
    state, step = env.reset(jax.random.key(0)), compiled(env.step)
    lost = dataclasses.replace(state, data=dataclasses.replace(state.data, qpos=state.data.qpos.at[2].set(1e20)))
    after = step(lost, jnp.ones(6))
    assert float(after.done) == 1.0
    np.testing.assert_array_equal(after.obs, state.obs)


def test_it_has_what_playground_asks_of_an_environment():
    env = MjxShapeCable(CONFIG)
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    assert {field.name for field in dataclasses.fields(state)} == {"data", "obs", "reward", "done", "metrics", "info"}
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((env.action_size,), jnp.float32))
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), after) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), state
    )
    assert state.obs.shape == (env.observation_size,) == (34,) and state.reward.shape == state.done.shape == ()
    assert (env.dt, env.sim_dt, env.n_substeps) == (1.0, 0.05, 20)
    assert env.mj_model.nq == env.mjx_model.nq == state.data.qpos.shape[0] and env.unwrapped is env


# Brax 0.14 calls a function that JAX 0.10 has removed; this is its substitute of JAX's own guide.
LEARNING = """
import functools, json
import jax, jax.numpy as jnp
jax.device_put_replicated = lambda tree, devices: jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), tree)
from brax.training.agents.ppo import networks, train
from mujoco_playground import MjxEnv, wrapper
from cablejax.cable import Cable, Discretisation
from cablejax.environment import MjxShapeCable, ShapeCableConfig

chain = Discretisation(cable=Cable(n_keypoints=7), n_links=8, timestep=0.02)
env = MjxShapeCable(ShapeCableConfig(discretisation=chain, targets=("U",), tolerance=1e-6))
lacking = [name for name in dir(MjxEnv) if not name.startswith("_") and not hasattr(env, name)]
errors = []
train.train(
    environment=env, wrap_env_fn=wrapper.wrap_for_brax_training, episode_length=40, num_timesteps=20480, seed=0,
    num_envs=64, unroll_length=10, batch_size=64, num_minibatches=8, num_updates_per_batch=4, learning_rate=1e-3,
    discounting=0.95, entropy_cost=1e-3, reward_scaling=10.0, normalize_observations=True, deterministic_eval=True,
    num_evals=3, num_eval_envs=32, progress_fn=lambda _, m: errors.append(float(m["eval/episode_error"]) / 40),
    network_factory=functools.partial(
        networks.make_ppo_networks, policy_hidden_layer_sizes=(64, 64), value_hidden_layer_sizes=(64, 64)
    ),
)
print(json.dumps({"lacking": lacking, "errors": errors}))
"""


@pytest.mark.slow
@pytest.mark.skipif(
    not all(map(importlib.util.find_spec, ("brax", "mujoco_playground"))),
    reason="needs MuJoCo Playground and Brax: pip install 'cablejax[playground]'",
)
def test_a_stock_ppo_learns_in_a_minute():
    source = str(pathlib.Path(__file__).parents[1] / "src")
    code = f"import sys; sys.path.insert(0, {source!r})\n{LEARNING}"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=550)
    assert run.returncode == 0, run.stderr[-3000:]
    said = json.loads(run.stdout.splitlines()[-1])
    assert set(said["lacking"]) == {"model_assets", "render"}
    start, *_, end = said["errors"]
    assert end < 0.6 * start, said["errors"]
