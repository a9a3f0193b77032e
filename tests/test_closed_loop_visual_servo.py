"""The visual servo: what it learns of the Jacobian, that it shapes a cable, its bounds, and gaps in what it sees."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.types import History, Measurement
from closed_loop.visual_servo import ServoConfig, VisualServo
from mpc_cases import START, TARGETS, at_rest, hermite_shape, relaxing_cable

N = 7
CONFIG = ServoConfig()
UNITS = np.array([1.0, 1.0, 0.15])


class LinearCable:
    """A cable whose keypoints follow any motion by one constant matrix; what is estimated can be compared with it."""

    def __init__(self, seed=0):
        self.jacobian = np.random.default_rng(seed).normal(size=(N, 2, 6)) / 3
        self.pose = np.array([[0.0, 0.0, 0.0], [0.7, 0.0, 0.0]])
        self.keypoints = np.linspace([0.0, 0.0], [0.7, 0.0], N)

    def step(self, twist):
        self.pose = self.pose + np.asarray(twist, float)
        self.keypoints = self.keypoints + self.jacobian @ (np.asarray(twist, float) * UNITS).ravel()


class HermiteCable:
    """A nonlinear cable, as elsewhere in the tests of planning, that goes most of the way to its curve in a step."""

    def __init__(self, pose=START, rate=0.8):
        self.rate, self.pose = rate, np.asarray(pose, float)
        self.keypoints = np.asarray(hermite_shape(pose, N), float)

    def step(self, twist):
        history = History(keypoints=jnp.asarray(self.keypoints)[None], gripper_pose=jnp.asarray(self.pose))
        self.keypoints = self.keypoints + np.asarray(relaxing_cable(self.rate, history, jnp.asarray(twist)))
        self.pose = self.pose + np.asarray(twist, float)


def run(controller, cable, steps, observe=lambda step, keypoints: keypoints):
    history = History(keypoints=jnp.asarray(cable.keypoints)[None], gripper_pose=jnp.asarray(cable.pose))
    state, infos, twists = controller.init(history), [], []
    for step in range(steps):
        state, twist, info = controller.step(state, Measurement(observe(step, cable.keypoints.copy()), cable.pose))
        cable.step(twist)
        infos.append(info)
        twists.append(np.asarray(twist))
    return state, np.stack(twists), jax.tree.map(lambda *leaves: np.stack(leaves), *infos)


@pytest.mark.parametrize("probe_back", [False, True])
def test_moving_every_input_once_reveals_the_jacobian(probe_back):
    cable = LinearCable()
    config = dataclasses.replace(CONFIG, probe_back=probe_back, window=12)
    controller = VisualServo(config, cable.keypoints + 0.05)
    state, twists, info = run(controller, cable, config.n_probes + 1)
    assert info.probing.tolist() == [True] * config.n_probes + [False]
    motion = (twists[:-1] * UNITS).reshape(-1, 6)
    assert ((np.abs(motion) > 1e-4).sum(axis=1) == 1).all()
    np.testing.assert_allclose(np.abs(motion).sum(axis=1), config.probe, rtol=1e-4)
    np.testing.assert_allclose(state.jacobian, cable.jacobian, atol=5e-3)


def test_the_estimate_follows_a_jacobian_that_changes_and_keeps_what_was_not_moved():
    cable = LinearCable(0)
    controller = VisualServo(CONFIG, cable.keypoints + 0.05)
    state, _, _ = run(controller, cable, CONFIG.n_probes + 1)
    before, other = np.asarray(state.jacobian), LinearCable(1).jacobian
    keypoints, pose = np.asarray(state.keypoints, float), np.asarray(state.gripper_pose, float)
    for _ in range(CONFIG.window + 4):
        # A robot that moves only gripper 1 along y, whatever is commanded, while the cable has become another one.
        motion = np.array([[0.0, 0.0, 0.0], [0.0, 0.02, 0.0]])
        keypoints, pose = keypoints + other @ motion.ravel(), pose + motion
        state, _, _ = controller.step(state, Measurement(keypoints, pose))
    np.testing.assert_allclose(state.jacobian[..., 4], other[..., 4], atol=0.02)
    np.testing.assert_allclose(state.jacobian[..., 0], before[..., 0], atol=0.1)


@pytest.mark.parametrize("target", ["near", "S"])
def test_shapes_a_cable_without_knowing_it_and_stays_there(target):
    controller = VisualServo(CONFIG, hermite_shape(TARGETS[target], N))
    _, twists, info = run(controller, HermiteCable(), 40)
    assert info.shape_error[0] > 0.03
    assert info.shape_error[-1] < 3e-3
    assert np.linalg.norm(twists[-3:] * UNITS, axis=-1).max() < 3e-3


def test_commands_respect_every_bound():
    cable = HermiteCable(pose=[[0.0, 0.0, -0.01], [0.99, 0.0, 0.01]])
    far = np.asarray(hermite_shape(TARGETS["U"], N)) + np.array([0.3, -0.4])
    controller = VisualServo(CONFIG, far)
    state = controller.init(at_rest(jnp.asarray(cable.pose)))
    for _ in range(20):
        state, twist, _ = controller.step(state, Measurement(cable.keypoints, cable.pose))
        assert (np.linalg.norm(np.asarray(twist, float) * UNITS, axis=-1) <= 0.05).all()
        cable.step(twist)
        assert 0.15 <= np.hypot(*(cable.pose[1, :2] - cable.pose[0, :2])) <= 0.99


def test_missing_keypoints_are_held_and_counted_and_not_learned_from():
    cable = LinearCable()
    controller = VisualServo(CONFIG, cable.keypoints + 0.05)

    def hide(step, keypoints):
        if step in (3, 4, 9):
            keypoints[[2, 3]] = np.nan
        return keypoints

    state, twists, info = run(controller, cable, 12, hide)
    assert info.unobserved.tolist() == [0, 0, 0, 2, 2, 0, 0, 0, 0, 2, 0, 0]
    assert int(state.unobserved) == 6
    assert np.isfinite(twists).all() and np.isfinite(info.shape_error).all()
    # The steps that end at 9, and the one that starts there, say nothing about the two keypoints.
    valid = np.asarray(state.valid)
    assert valid[:, [0, 1, 4, 5, 6]].all()
    assert valid[:, 2].tolist() == [False, False, True, True, True, False, False, True]
    np.testing.assert_allclose(np.asarray(state.jacobian)[[0, 6]], cable.jacobian[[0, 6]], atol=0.02)


def test_nothing_seen_at_all_gives_finite_commands_and_recovers():
    controller = VisualServo(CONFIG, hermite_shape(TARGETS["S"], N))

    def blind(step, keypoints):
        return np.full_like(keypoints, np.nan) if 10 <= step < 13 else keypoints

    state, twists, info = run(controller, HermiteCable(), 45, blind)
    assert np.isfinite(twists).all()
    assert info.shape_error[-1] < 5e-3
    _, twist, _ = controller.step(state, Measurement(np.full((N, 2), np.nan), np.full((2, 3), np.nan)))
    assert np.isfinite(np.asarray(twist)).all()
    _, twist, _ = controller.step(state, Measurement(np.full((N, 2), 1e30), np.full((2, 3), 1e30)))
    assert np.isfinite(np.asarray(twist)).all()


def test_an_outlier_counts_for_less_than_in_least_squares():
    cable = LinearCable()
    controller = VisualServo(CONFIG, cable.keypoints + 0.3)

    def jump(step, keypoints):
        keypoints[3] += 0.5 * (step == 9)
        return keypoints

    robust, _, _ = run(controller, LinearCable(), 11, jump)
    naive, _, _ = run(VisualServo(dataclasses.replace(CONFIG, outlier=1e3), controller.target), LinearCable(), 11, jump)
    off = [np.abs(np.asarray(state.jacobian) - cable.jacobian)[3].max() for state in (robust, naive)]
    assert off[0] < 0.5 * off[1]


def test_many_cables_at_once_are_the_same_as_one_by_one():
    history = at_rest(jnp.asarray(START), n_keypoints=N)
    targets = jnp.stack([hermite_shape(TARGETS[name], N) for name in ("U", "S")])
    many = VisualServo(CONFIG, targets)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), VisualServo(CONFIG, targets[0]).init(history))
    pose = jnp.stack([history.gripper_pose] * 2)
    keypoints = jnp.stack([history.keypoints[-1]] * 2)
    step = jax.jit(jax.vmap(VisualServo.step))
    for _ in range(8):
        # A cable that moves with its grippers' mean.
        batch, twist, _ = step(many, batch, Measurement(keypoints, pose))
        keypoints = keypoints + twist[:, :, :2].mean(axis=1)[:, None]
        pose = pose + twist
    one = VisualServo(CONFIG, targets[1])
    single, keypoints, pose = one.init(history), history.keypoints[-1], history.gripper_pose
    for _ in range(8):
        single, twist, _ = one.step(single, Measurement(keypoints, pose))
        keypoints, pose = keypoints + twist[:, :2].mean(axis=0), pose + twist
    np.testing.assert_allclose(single.gripper_pose, batch.gripper_pose[1], atol=1e-5)
    np.testing.assert_allclose(single.jacobian, batch.jacobian[1], atol=1e-3)


def test_bad_settings_and_shapes_are_refused():
    for field, value in [("gain", 0.0), ("gain", 1.5), ("damping", -1.0), ("window", 5), ("max_distance", 0.1)]:
        with pytest.raises(ValueError, match=f"ServoConfig.*{field}" if field != "max_distance" else "distances"):
            ServoConfig(**{field: value})
    with pytest.raises(ValueError, match="non-finite"):
        VisualServo(CONFIG, np.full((N, 2), np.nan))
    controller = VisualServo(CONFIG, hermite_shape(TARGETS["U"], N))
    with pytest.raises(ValueError, match=r"\(7, 2\)"):
        controller.init(at_rest(jnp.asarray(START), n_keypoints=N + 1))
    history = at_rest(jnp.asarray(START), n_keypoints=N)
    with pytest.raises(ValueError, match="non-finite"):
        controller.init(dataclasses.replace(history, keypoints=history.keypoints.at[0, 0, 0].set(jnp.nan)))
    with pytest.raises(ValueError, match=r"\(2, 2\)"):
        controller.step(controller.init(history), Measurement(np.zeros((N, 2)), np.zeros((2, 2))))
