"""Cables that move as nobody's simulator does, but fast and by known rules; and networks small enough for tests."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.networks import GNS
from cablejax.dynamics.train_config import Phase, TrainConfig
from cablejax.types import History, Trajectory

SMALL = ModelConfig(
    n_keypoints=5,
    radius=0.5,
    history=3,
    latent=8,
    hidden=8,
    hidden_layers=1,
    message_passing=2,
    prior="rigid",
)

TINY_TRAINING = TrainConfig(
    model=SMALL,
    phases=(Phase(steps=4, batch=4, rollout=1), Phase(steps=3, batch=2, rollout=2)),
    warmup=2,
    chunk=2,
    checkpoint_every=1,
    evaluate_every=2,
    evaluate_starts=4,
)


def trajectories(m: int = 4, t: int = 8, n: int = 5, seed: int = 0) -> Trajectory:
    """Cables between randomly moving grippers, arched by an amount that follows what the grippers do."""
    rng = np.random.default_rng(seed)
    pose = np.zeros((m, t + 1, 2, 3))
    pose[:, 0, 0, 0], pose[:, 0, 1, 0] = -0.4, 0.4
    pose[:, 0] += 0.05 * rng.standard_normal((m, 2, 3))
    twist = 0.02 * rng.standard_normal((m, t, 2, 3))
    pose[:, 1:] = pose[:, :1] + np.cumsum(twist, axis=1)
    s = np.linspace(0.0, 1.0, n)[:, None]
    line = (1 - s) * pose[:, :, None, 0, :2] + s * pose[:, :, None, 1, :2]
    arch = np.cumsum(twist[..., 2].sum(-1), axis=1)
    arch = np.concatenate([np.zeros((m, 1)), arch], axis=1)[..., None, None] + 0.3
    keypoints = line + arch * (s * (1 - s)) * np.array([0.2, 1.0])
    return Trajectory(*(a.astype(np.float32) for a in (keypoints, pose, twist)))


def network(config: ModelConfig, seed: int = 0, last: float = 0.1) -> tuple[nnx.GraphDef, nnx.State]:
    """A network whose decoder does not start at zero."""
    model = GNS(config, nnx.Rngs(seed))
    kernel = model.decoder.rest[-1].kernel
    kernel.set_value(last * jax.random.normal(jax.random.key(seed), kernel.shape))
    return nnx.split(model)


def arched_history(config: ModelConfig, seed: int = 0) -> History:
    """An arched cable that has been moving a little."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0.0, 1.0, config.n_keypoints)[:, None]
    shape = config.length * np.concatenate([0.8 * (s - 0.5), 1.2 * s * (1 - s)], axis=1)
    past = shape + 1e-3 * np.cumsum(rng.standard_normal((config.history, config.n_keypoints, 2)), axis=0)
    lean = np.arctan2(1.2, 0.8)
    pose = np.concatenate([past[-1, [0, -1]], np.array([[lean], [-lean]])], axis=1)
    return History(jnp.asarray(past), jnp.asarray(pose))


def straight_history(config: ModelConfig) -> History:
    """A straight cable at rest, the grippers a whole length apart."""
    x = np.linspace(-0.5, 0.5, config.n_keypoints) * config.length
    shape = np.stack([x, np.zeros_like(x)], axis=1)
    pose = np.array([[x[0], 0.0, 0.0], [x[-1], 0.0, 0.0]])
    return History(jnp.asarray(np.repeat(shape[None], config.history, axis=0)), jnp.asarray(pose))


def moved_rigidly(history: History, angle: float, shift: np.ndarray) -> History:
    """The same cable, turned about the origin and then shifted."""
    turn = rotation(angle)
    pose = history.gripper_pose
    return History(
        history.keypoints @ turn.T + shift,
        jnp.concatenate([pose[:, :2] @ turn.T + shift, pose[:, 2:] + angle], axis=1),
    )


def turned_twist(twist, angle: float):
    """The same command in a turned world."""
    return jnp.concatenate([twist[:, :2] @ rotation(angle).T, twist[:, 2:]], axis=1)


def rotation(angle: float):
    """Matrix of a turn in the plane."""
    return jnp.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def direction_like(tree, seed: int = 0):
    """A random direction of unit length in a pytree's space, in its dtypes."""
    rng = np.random.default_rng(seed)
    raw = jax.tree.map(lambda x: rng.standard_normal(np.shape(x)), tree)
    size = np.sqrt(sum(np.sum(leaf**2) for leaf in jax.tree.leaves(raw)))
    return jax.tree.map(lambda r, x: jnp.asarray(r / size, x.dtype), raw, tree)


def check_derivatives(function, point, *, step: float = 1e-6, seeds=(0, 1, 2)) -> None:
    """In float64: all finite, JVP = VJP to 1e-8, JVP = central difference to 1e-5 of the derivative's size."""
    value = jax.eval_shape(function, point)
    cotangent = direction_like(value, seed=99)
    function, backward = jax.jit(function), jax.jit(lambda point: jax.vjp(function, point)[1](cotangent)[0])
    forward = jax.jit(lambda point, direction: jax.jvp(function, (point,), (direction,)))
    gradient = backward(point)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    for seed in seeds:
        direction = direction_like(point, seed)
        value, derivative = forward(point, direction)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((value, derivative)))
        ahead, behind = (function(jax.tree.map(lambda p, d, h=h: p + h * d, point, direction)) for h in (step, -step))
        numeric = jax.tree.map(lambda a, b: (a - b) / (2 * step), ahead, behind)
        size = max(np.abs(leaf).max() for leaf in jax.tree.leaves(derivative))
        assert size > 0
        for a, b in zip(jax.tree.leaves(derivative), jax.tree.leaves(numeric), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5 * size, rtol=0)
        assert inner(gradient, direction) == pytest.approx(inner(cotangent, derivative), abs=1e-8, rel=1e-8)


def inner(a, b) -> float:
    """Inner product of two pytrees."""
    return float(sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)))


def as_float64(tree):
    """The same pytree in float64; only under `jax.enable_x64(True)`."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tree)


def resized(config: TrainConfig, **changes) -> TrainConfig:
    """The training with other sizes of the network."""
    return dataclasses.replace(config, model=dataclasses.replace(config.model, **changes))
