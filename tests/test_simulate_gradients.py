"""Derivatives of the simulator against central finite differences in float64, and JVP against VJP."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.cable import Discretisation
from cablejax.effects.physics import Physics, nominal_physics
from cablejax.simulate import MjxEngine

CONFIG = Discretisation(n_links=5, timestep=0.02)
STRAIGHT = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
ARCH = np.array([[-0.42, 0.0, 0.6], [0.42, 0.0, -0.4]])


def moving() -> np.ndarray:
    twist = np.zeros((2, 2, 3))
    twist[0] = [[0.03, 0.01, 0.2], [-0.02, 0.0, 0.1]]
    twist[1] = [[0.0, -0.02, -0.1], [-0.01, 0.03, 0.15]]
    return twist


def directions(params: Physics, twist: jax.Array) -> dict[str, tuple[Physics, jax.Array]]:
    """One direction for each input, relative where the input has a size."""
    nothing = (jax.tree.map(jnp.zeros_like, params), jnp.zeros_like(twist))
    slope = jnp.linspace(-1.0, 1.5, CONFIG.n_joints)
    changes = {
        "stiffness": params.stiffness * (1.0 + 0.3 * slope),
        "damping_time": params.damping_time,
        "friction": params.friction,
        "density": params.density,
        "rest_curvature": slope,
    }
    found = {name: (dataclasses.replace(nothing[0], **{name: d}), nothing[1]) for name, d in changes.items()}
    gripper = np.random.default_rng(3).standard_normal(twist.shape) * [0.02, 0.02, 0.1]
    return found | {"gripper_motion": (nothing[0], jnp.asarray(gripper))}


@pytest.fixture(scope="module")
def programs():
    """The last keypoints, their derivative along a direction, and the gradient; compiled once for all starts."""
    engine = MjxEngine(CONFIG)

    @jax.jit
    def final(state, params, twist):
        return engine.unroll(params, state, twist)[1].keypoints[-1]

    @jax.jit
    def push(state, params, twist, direction):
        return jax.jvp(functools.partial(final, state), (params, twist), direction)[1]

    @jax.jit
    def pull(state, params, twist, cotangent):
        return jax.vjp(functools.partial(final, state), params, twist)[1](cotangent)

    return engine, (final, push, pull)


@pytest.fixture(scope="module", params=["moving", "straight at rest"])
def case(request, programs):
    with jax.enable_x64(True):
        engine, functions = programs
        pose, twist = (ARCH, moving()) if request.param == "moving" else (STRAIGHT, np.zeros((2, 2, 3)))
        state, params, twist = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, jnp.float64), (engine.initial_state(pose), nominal_physics(CONFIG), twist)
        )
        final, push, pull = (functools.partial(function, state) for function in functions)
        return request.param, final, push, pull, params, twist


@pytest.mark.parametrize(
    "name",
    ["stiffness", "damping_time", "friction", "density", "rest_curvature", "gripper_motion"],
)
def test_derivatives_of_a_rollout(case, name):
    which, final, push, pull, params, twist = case
    with jax.enable_x64(True):
        direction = directions(params, twist)[name]
        if which == "straight at rest" and name == "gripper_motion":
            # A straight cable cannot follow a change of its ends' distance: that derivative does not exist.
            direction = (direction[0], direction[1].at[..., 0].set(direction[1][:, :1, 0]))

        def shifted(size):
            return final(*jax.tree.map(lambda leaf, d: leaf + size * d, (params, twist), direction))

        # near rest, motion is linear only below the friction's regularisation speed
        step = 1e-4 if which == "moving" else 1e-6
        # fourth order, so that neither truncation nor cancellation hides an error of 1e-5
        difference = (8 * (shifted(step) - shifted(-step)) - shifted(2 * step) + shifted(-2 * step)) / (12 * step)
        forward = push(params, twist, direction)
        scale = jnp.abs(difference).max()
        if which == "moving":
            assert scale > 1e-5, "the direction has no effect, so the comparison would show nothing"
        assert jnp.abs(forward - difference).max() <= 1e-5 * scale + 1e-11

        cotangent = jnp.asarray(np.random.default_rng(5).standard_normal(forward.shape))
        gradient = pull(params, twist, cotangent)
        backward = sum(jax.tree.leaves(jax.tree.map(lambda g, d: jnp.sum(g * d), gradient, direction)))
        assert jnp.abs(jnp.sum(forward * cotangent) - backward) <= 1e-8 * (jnp.abs(backward) + 1e-3)
