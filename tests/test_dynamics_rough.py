"""Rough slopes: the values of the network itself, a Jacobian that is nearly its own, and exact ones in float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.rough import product
from cablejax.mpc.feasible import feasible_from
from cablejax.mpc.problem import ShapingProblem
from cablejax.residual import Corrected, zero_residual
from cablejax.residual.corrected import slopes_of
from cablejax.shaping import NetworkDynamics
from dynamics_cases import SMALL, arched_history, as_float64, network

TWIST = jnp.array([[0.01, -0.02, 0.1], [-0.03, 0.005, -0.2]])
WIDE = dataclasses.replace(SMALL, latent=64, hidden=64)


def model_of(config: ModelConfig):
    graphdef, weights = network(config)
    return NetworkDynamics(graphdef), weights, jax.tree.map(jnp.float32, arched_history(config))


def test_values_are_those_of_the_network_to_the_bit():
    dynamics, weights, history = model_of(WIDE)
    exact, rough = (jax.jit(d)(weights, history, TWIST) for d in (dynamics, dynamics.slopes))
    np.testing.assert_array_equal(rough, exact)


def test_slopes_are_rounded_in_single_precision_and_by_little():
    dynamics, weights, history = model_of(WIDE)
    exact, rough = (
        jax.jit(jax.jacrev(lambda twist, d=d: d(weights, history, twist)))(TWIST) for d in (dynamics, dynamics.slopes)
    )
    off = np.linalg.norm(rough - exact) / np.linalg.norm(exact)
    assert 0 < off < 3e-3


def test_slopes_are_exact_in_double_precision():
    with jax.enable_x64(True):
        graphdef, weights = network(WIDE)
        dynamics, weights, history = NetworkDynamics(graphdef), as_float64(weights), as_float64(arched_history(WIDE))
        exact, rough = (
            jax.jit(jax.jacrev(lambda twist, d=d: d(weights, history, twist)))(jnp.float64(TWIST))
            for d in (dynamics, dynamics.slopes)
        )
        np.testing.assert_allclose(rough, exact, rtol=1e-12, atol=1e-15)


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

    def exact(weights, history, twist):  # a model without `slopes`
        return used(weights, history, twist)

    residuals, jacobian = jax.jit(lambda p, u: p.linearise(u))(problem(used), motion)
    values, true_jacobian = jax.jit(lambda p, u: (p.residuals(u), p.linearise(u)[1]))(problem(exact), motion)
    np.testing.assert_allclose(residuals, values, atol=1e-6)
    assert 0 < np.linalg.norm(jacobian - true_jacobian) < 3e-3 * np.linalg.norm(true_jacobian)


def test_a_model_without_them_is_differentiated_itself():
    def still(weights, history, twist):
        return jnp.zeros_like(history.keypoints[-1])

    assert slopes_of(still) is still
    assert slopes_of(Corrected(still)) == Corrected(still)
