"""Rough slopes: the values of the network itself, a Jacobian that is nearly its own, and exact ones in float64."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from cablejax.control.shaping import NetworkDynamics
from cablejax.dynamics.bfloat16_slopes import product, with_bfloat16_slopes
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.model import apply
from cablejax.mpc.feasible import feasible_from
from cablejax.mpc.problem import ShapingProblem
from cablejax.residual import Corrected, zero_residual
from cablejax.residual.jacobian import step_jacobian
from dynamics_cases import SMALL, arched_history, as_float64, network

TWIST = jnp.array([[0.01, -0.02, 0.1], [-0.03, 0.005, -0.2]])
WIDE = dataclasses.replace(SMALL, latent=64, hidden=64)


def model_of(config: ModelConfig):
    graphdef, weights = network(config)
    return NetworkDynamics(graphdef), weights, jax.tree.map(jnp.float32, arched_history(config))


def plain(dynamics):
    """The same model without a Jacobian of its own."""
    return lambda weights, history, twist: dynamics(weights, history, twist)


def jacobians(dynamics, weights, history, twist):
    """Its own, and that of the network as it is."""
    own, exact = (
        jax.jit(functools.partial(step_jacobian, d))(weights, history, twist) for d in (dynamics, plain(dynamics))
    )
    return own, exact


def test_values_are_those_of_the_network_to_the_bit():
    graphdef, weights = network(WIDE)
    history = jax.tree.map(jnp.float32, arched_history(WIDE))

    def displacement(weights, change):
        return apply(change(nnx.merge(graphdef, weights)), history, TWIST)

    exact, rough = (
        jax.jit(functools.partial(displacement, change=c))(weights) for c in (lambda n: n, with_bfloat16_slopes)
    )
    np.testing.assert_array_equal(rough, exact)


def test_slopes_are_rounded_in_single_precision_and_by_little():
    dynamics, weights, history = model_of(WIDE)
    own, exact = jacobians(dynamics, weights, history, TWIST)
    for a, b in zip(own, exact, strict=True):
        # bfloat16 rounds by up to 2^-8
        assert 0 < np.linalg.norm(a - b) < 2 * 2.0**-8 * np.linalg.norm(b)
    assert np.linalg.norm(own.twist - exact.twist) < 3e-3 * np.linalg.norm(exact.twist)


def test_slopes_are_exact_in_double_precision():
    """By central differences too, of the command."""
    with jax.enable_x64(True):
        graphdef, weights = network(WIDE)
        dynamics, weights, history = NetworkDynamics(graphdef), as_float64(weights), as_float64(arched_history(WIDE))
        twist = jnp.float64(TWIST)
        own, exact = jacobians(dynamics, weights, history, twist)
        for a, b in zip(own, exact, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15)
        move = 1e-6 * np.random.default_rng(0).standard_normal(twist.shape)
        ahead, behind = (jax.jit(dynamics)(weights, history, twist + sign * move) for sign in (1, -1))
        np.testing.assert_allclose(np.tensordot(own.twist, move, 2), (ahead - behind) / 2, atol=1e-13)


def test_held_keypoints_depend_on_their_grippers_command_alone():
    dynamics, weights, history = model_of(WIDE)
    own, _ = jacobians(dynamics, weights, history, TWIST)
    for end, gripper in ((0, 0), (-1, 1)):
        assert not np.any(own.keypoints[end]) and not np.any(own.gripper_pose[end])
        wanted = np.zeros((2, 2, 3))
        wanted[:, gripper, :2] = WIDE.interval * np.eye(2)
        np.testing.assert_array_equal(own.twist[end], wanted)


def test_a_products_slope_is_that_of_the_rounded_factors_summed_exactly():
    rng = np.random.default_rng(0)
    x, kernel, weight = (jnp.asarray(rng.standard_normal(s), jnp.float32) for s in ((3, 5, 40), (40, 7), (3, 5, 7)))
    of_x, of_kernel = jax.grad(lambda x, kernel: jnp.sum(weight * product(x, kernel)), argnums=(0, 1))(x, kernel)
    low = [np.asarray(v.astype(jnp.bfloat16), np.float64) for v in (weight, kernel)]
    np.testing.assert_allclose(of_x, low[0] @ low[1].T, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(of_kernel, np.einsum("abi,abo->io", x, weight), rtol=1e-5, atol=1e-5)


def test_a_plan_is_linearised_with_them_and_judged_without():
    dynamics, weights, history = model_of(WIDE)
    used = Corrected(dynamics)
    motion = 0.01 * jnp.ones((3, 2, 3))

    def problem(dynamics):
        return ShapingProblem(
            dynamics=dynamics,
            weights=(weights, zero_residual(WIDE.n_keypoints)),
            history=history,
            target=history.keypoints[-1] + 0.01,
            feasible=feasible_from(history.gripper_pose, jnp.float32(0.05), (0.1, 0.99)),
        )

    residuals, jacobian = jax.jit(lambda p, u: p.linearise(u))(problem(used), motion)
    values, true_jacobian = jax.jit(lambda p, u: (p.residuals(u), p.linearise(u)[1]))(problem(plain(used)), motion)
    np.testing.assert_allclose(residuals, values, atol=1e-6)
    assert 0 < np.linalg.norm(jacobian - true_jacobian) < 3e-3 * np.linalg.norm(true_jacobian)


def test_a_residual_adds_its_gain_and_any_function_can_be_linearised():
    def still(weights, history, twist):
        return 0.5 * (history.keypoints[-1] - history.keypoints[-2])

    history = jax.tree.map(jnp.float32, arched_history(WIDE))
    residual = zero_residual(WIDE.n_keypoints)
    gain = jnp.asarray(np.random.default_rng(0).standard_normal(residual.gain.shape), jnp.float32)
    weights = (None, dataclasses.replace(residual, gain=gain))
    own, exact = jacobians(Corrected(still), weights, history, TWIST)
    for a, b in zip(own, exact, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    assert np.any(own.twist)
