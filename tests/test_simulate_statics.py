"""The frictionless resting shape: right, the same wherever the cable lies, differentiable even where it is straight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.dataset.generate import make_engine, simulate
from cablejax.dataset.schema import DatasetConfig
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.graph import prior_of
from cablejax.effects.given import parse_effect
from cablejax.simulate.chain.statics import LINKS, Statics, clamped, resting_shapes, statics_with
from cablejax.simulate.composite import link_lengths, node_offsets
from cablejax.simulate.equilibrium import arch_angles, find_equilibrium
from cablejax.simulate.keypoints import hermite_weights
from dynamics_cases import arched_history, check_derivatives, moved_rigidly, straight_history

CONFIG = ModelConfig()
CABLE = Discretisation(n_links=49)
POSES = {
    "arch": np.array([[-0.3, 0.05, 1.2], [0.35, -0.02, -0.7]]),
    "deep": np.array([[-0.2, 0.0, -1.4], [0.2, 0.0, 1.4]]),
    "S": np.array([[-0.3, 0.0, 1.3], [0.3, 0.1, 1.2]]),
}
TWIST = np.array([[0.02, -0.01, 0.1], [-0.015, 0.02, -0.08]])

resting = jax.jit(lambda keypoints, before, after: resting_shapes(keypoints, before, after, length=1.0))
prior = jax.jit(lambda history, twist: prior_of(history, twist, CONFIG))


def equilibrium(pose, guess=None):
    """Joint angles and keypoints of the fine chain at rest."""
    found = find_equilibrium(CABLE, pose, arch_angles(CABLE, pose) if guess is None else guess)
    theta = pose[0, 2] + np.concatenate([[0.0], np.cumsum(found.angles)])
    tangents = np.stack([np.cos(theta), np.sin(theta)], axis=1)
    links = link_lengths(CABLE)[:, None] * tangents
    origins = pose[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(links, axis=0)[:-1]])
    of_nodes, of_tangents = hermite_weights(CABLE)
    return found.angles, of_nodes @ (origins + node_offsets(CABLE)[:, None] * tangents) + of_tangents @ tangents


@pytest.mark.parametrize("name", POSES)
def test_the_shape_is_that_of_a_finer_chain_at_rest(name):
    before = POSES[name]
    angles, shape = equilibrium(before)
    after = before + TWIST
    _, moved = equilibrium(after, angles)
    here, there = resting(*(jnp.asarray(a, jnp.float32) for a in (shape, before, after)))
    assert np.linalg.norm(here - shape, axis=1).max() <= 3e-3
    assert np.linalg.norm(there - moved, axis=1).max() <= 3e-3
    # and it is not that nothing moved
    assert np.linalg.norm(moved - shape, axis=1).max() >= 1e-2


SLIPPERY = Cable(friction_coefficient=0.0, damping_time=0.3)
AT_REST = (
    "stiffness_profile:centre_m=0.3,width_m=0.25,ratio=0.2",
    "intrinsic_curvature:centre_m=0.6,width_m=0.3,curvature_per_m=2",
    "gripper_rotation_offset:gripper=1,angle_rad=0.15",
    "gripper_compliance:gripper=1,stiffness_n_m_per_rad=0.15",
)


@pytest.mark.parametrize("text", AT_REST)
def test_a_known_effect_is_in_the_resting_shape(text):
    """Against the chain in motion, without friction and slow: it is at rest, up to what its inertia does."""
    effects = (parse_effect(text),)
    config = DatasetConfig(
        n_trajectories=2, n_steps=12, discretisation=Discretisation(SLIPPERY, timestep=0.05), effects=effects
    )
    (block,) = simulate(config, make_engine(config), [0])
    errors = {}
    for name, statics in (("known", statics_with(effects, SLIPPERY)), ("not", Statics())):
        found = jax.vmap(
            lambda points, pose, statics=statics: resting_shapes(
                points, clamped(pose, statics), clamped(pose, statics), length=1.0, statics=statics
            )[1]
        )(block.keypoints.reshape(-1, 13, 2), block.gripper_pose.reshape(-1, 2, 3))
        errors[name] = np.median(np.linalg.norm(found - block.keypoints.reshape(-1, 13, 2), axis=-1).max(axis=-1))
    assert errors["known"] < 3e-3 and errors["not"] > 5 * errors["known"]


def test_effects_that_do_not_act_at_rest_change_nothing_there():
    effects = tuple(map(parse_effect, ("bending_stiffness:ratio=0.3", "table_friction:coefficient=0.4")))
    assert statics_with(effects, Cable()) == Statics()
    with pytest.raises(ValueError, match=f"expected 0 or {LINKS - 1} finite numbers"):
        Statics(stiffness=(1.0, 2.0))
    with pytest.raises(ValueError, match="expected positive numbers"):
        Statics(stiffness=(0.0,) * (LINKS - 1))


def test_an_error_in_what_was_observed_fades():
    _, shape = equilibrium(POSES["arch"])
    noise = 3e-3 * np.random.default_rng(0).standard_normal(shape.shape) * np.r_[0, np.ones(11), 0][:, None]
    after = POSES["arch"] + TWIST
    pair = [
        resting(*(jnp.asarray(a, jnp.float32) for a in (x, POSES["arch"], after)))[1] for x in (shape, shape + noise)
    ]
    assert np.linalg.norm(pair[1] - pair[0], axis=1).max() <= 1e-4


def test_the_shape_turns_and_shifts_with_the_cable():
    with jax.enable_x64(True):
        history, angle, shift = arched_history(CONFIG), -2.4, np.array([0.5, 0.2])
        after = history.gripper_pose + TWIST
        there = moved_rigidly(history, angle, shift)
        later = moved_rigidly(type(history)(history.keypoints, after), angle, shift).gripper_pose
        mine = resting(history.keypoints[-1], history.gripper_pose, after)
        other = resting(there.keypoints[-1], there.gripper_pose, later)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        for a, b in zip(mine, other, strict=True):
            np.testing.assert_allclose(a @ turn.T + shift, b, atol=1e-9)


def test_the_prior_moves_both_ends_as_commanded():
    expected = prior(arched_history(CONFIG), jnp.asarray(TWIST)).displacement
    np.testing.assert_array_equal(expected[jnp.array([0, -1])], jnp.asarray(TWIST, expected.dtype)[:, :2])


def test_a_straight_cable_at_rest_stays_straight():
    expected = prior(straight_history(CONFIG), jnp.zeros((2, 3)))
    np.testing.assert_allclose(expected.displacement, 0.0, atol=1e-6)
    np.testing.assert_allclose(expected.strain, 0.0, atol=1e-6)


@pytest.mark.parametrize("where", ["arched", "straight", "known"])
def test_derivatives_against_central_differences(where):
    effects = [parse_effect(text) for text in AT_REST] if where == "known" else []
    statics = statics_with(effects, Cable())
    with jax.enable_x64(True):
        history = straight_history(CONFIG) if where == "straight" else arched_history(CONFIG)
        pose = history.gripper_pose
        # A straight cable cannot be pulled longer: move it as a whole command would, inwards.
        twist = jnp.zeros((2, 3)) if where == "straight" else jnp.asarray(TWIST)
        check_derivatives(
            lambda point: resting_shapes(
                point[0], clamped(point[1], statics), clamped(point[1] + point[2], statics), length=1.0, statics=statics
            ),
            (history.keypoints[-1], pose, twist),
            step=1e-7 if where == "straight" else 1e-6,
        )


@pytest.mark.parametrize("apart", [1.0, 1.005, 1.02])
def test_grippers_a_little_too_far_apart_leave_the_cable_straight(apart):
    """A length that was measured short, or a tool that is off: no chain meets them, and none may wander for that."""
    with jax.enable_x64(True):
        random, pose = np.random.default_rng(0), np.array([[0.0, 0.0, 0.005], [apart, 0.0, -0.005]])
        straight = np.stack([np.linspace(0.0, apart, 13), np.zeros(13)], axis=1)
        seen = straight + 1e-3 * random.standard_normal(straight.shape)
        before, after = resting_shapes(jnp.asarray(seen), jnp.asarray(pose), jnp.asarray(pose), length=1.0)
        slope = jax.jacfwd(lambda points: resting_shapes(points, jnp.asarray(pose), jnp.asarray(pose), length=1.0)[1])
        np.testing.assert_allclose(before, straight, atol=0.012)
        np.testing.assert_allclose(after, before, atol=0.004)
        assert np.abs(slope(jnp.asarray(seen))).max() < 2.0
