import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from cablejax.adaptation.belief import AdaptationConfig
from cablejax.bounded import Result
from cablejax.control.targets import Target
from cablejax.mpc import MPC, Action, LevenbergMarquardt, MPCConfig, ProjectedGradient
from cablejax.mpc.fallback import ABOUT, RETURNS, _followed, radius_after
from cablejax.mpc.state import initial_state
from cablejax.mpc.target_pose import straightened
from cablejax.mpc.validation import check_reach
from cablejax.residual.learner import LearnerConfig
from cablejax.types import History, Measurement
from mpc_cases import START, TARGETS, at_rest, hermite_shape, relaxing_cable

N = 7
CONFIG = MPCConfig(horizon=2)
WITHOUT = dataclasses.replace(CONFIG, residual=None)


class Cable:
    """What stands for reality here: it relaxes more slowly than the model believes and sags to one side."""

    def __init__(self, rate=0.5, sag=0.02, pose=START):
        self.rate, self.pose = rate, np.asarray(pose, float)
        self.sag = np.zeros((N, 2))
        self.sag[:, 1] = sag * np.sin(np.linspace(0, np.pi, N))
        self.keypoints = np.asarray(hermite_shape(jnp.asarray(pose), N), float)

    def step(self, twist):
        self.pose = self.pose + np.asarray(twist, float)
        goal = np.asarray(hermite_shape(jnp.asarray(self.pose), N)) + self.sag
        self.keypoints = self.keypoints + self.rate * (goal - self.keypoints)
        self.keypoints[[0, -1]] = self.pose[:, :2]


def controller(target="U", config=CONFIG, rate=0.8, dynamics=relaxing_cable):
    return MPC(config, dynamics, jnp.asarray(rate), hermite_shape(TARGETS[target], N))


def run(control, cable, steps, hide=None, radius=CONFIG.radius, restarts=0):
    """The last state, commands and reports; `radius` and `restarts` are those of the first state."""
    state = control.init(at_rest(jnp.asarray(cable.pose)))
    # of the same type, strictly: another would compile again
    progress = state.progress._replace(restarts=jnp.asarray(restarts, jnp.int32))
    state = dataclasses.replace(state, radius=jnp.asarray(radius, state.radius.dtype), progress=progress)
    infos, twists = [], []
    for step in range(steps):
        keypoints = cable.keypoints.copy()
        if hide is not None:
            keypoints[hide(step)] = np.nan
        state, twist, info = control.step(state, Measurement(keypoints, cable.pose))
        cable.step(twist)
        infos.append(info)
        twists.append(np.asarray(twist))
    return state, np.stack(twists), jax.tree.map(lambda *leaves: np.stack(leaves), *infos)


@pytest.mark.parametrize("solver", [LevenbergMarquardt(), pytest.param(ProjectedGradient(), marks=pytest.mark.slow)])
def test_brings_the_cable_to_the_target_and_holds_it_there(solver):
    config = dataclasses.replace(CONFIG, solver=solver)
    _, twists, info = run(controller(config=config), Cable(rate=0.8, sag=0.0), 25)
    assert info.shape_error[0] > 0.2
    assert info.shape_error[-1] < 2e-3
    size = np.linalg.norm(twists * [1, 1, 0.15], axis=-1)
    assert (size <= 0.05).all()
    assert size[-3:].max() < 2e-3


def test_settings_given_as_lists_are_the_same_settings():
    """Compiled code is kept by its settings, which lists cannot be."""
    parts = {"workspace": [[-1.0, -1.0], [1.0, 1.0]]}
    learner, belief = LearnerConfig(candidates=[*LearnerConfig.candidates]), AdaptationConfig(prior_mean=[0.0, 0.0])
    listed = MPCConfig(residual=learner, adaptation=belief, **parts)
    expected = MPCConfig(adaptation=AdaptationConfig(), workspace=((-1.0, -1.0), (1.0, 1.0)))
    assert hash(listed) == hash(expected) and listed == expected
    assert MPCConfig(workspace=np.array(parts["workspace"])) == MPCConfig(workspace=expected.workspace)


def test_settings_scale_with_the_length():
    assert MPCConfig.for_length(1.0) == MPCConfig()
    long = MPCConfig.for_length(1.5, horizon=2)
    assert (long.horizon, long.cable_length, long.radius_max) == (2, 1.5, 1.5 * MPCConfig.radius_max)


@pytest.mark.slow
def test_a_longer_cable_is_shaped_in_proportion():
    """Everything 1.5 times as long: commands, errors and bounds are 1.5 times as large, angles the same."""
    sizes = np.array([1.5, 1.5, 1.0])

    def longer(weights, history, twist):
        small = History(keypoints=history.keypoints / 1.5, gripper_pose=history.gripper_pose / sizes)
        return 1.5 * relaxing_cable(weights, small, twist / sizes)

    class LongCable(Cable):
        def step(self, twist):
            self.pose, self.keypoints = self.pose / sizes, self.keypoints / 1.5
            super().step(twist / sizes)
            self.pose, self.keypoints = self.pose * sizes, self.keypoints * 1.5

    with jax.enable_x64(True):
        rate, goal = jnp.asarray(0.8), hermite_shape(TARGETS["U"], N)
        long = LongCable()
        long.pose, long.keypoints = long.pose * sizes, long.keypoints * 1.5
        steps = {}
        for length, cable, dynamics in ((1.0, Cable(), relaxing_cable), (1.5, long, longer)):
            control = MPC(MPCConfig.for_length(length, horizon=2), dynamics, rate, length * goal)
            state, steps[length] = (
                control.init(History(np.repeat(cable.keypoints[None], 3, axis=0), np.asarray(cable.pose))),
                [],
            )
            for _ in range(6):
                state, twist, info = control.step(state, Measurement(cable.keypoints, cable.pose))
                cable.step(twist)
                steps[length].append((np.asarray(twist), float(info.shape_error)))
    for (twist, error), (longer_twist, longer_error) in zip(steps[1.0], steps[1.5], strict=True):
        np.testing.assert_allclose(longer_twist, twist * sizes, atol=1e-4)
        assert longer_error == pytest.approx(1.5 * error, rel=1e-3)
    assert max(np.linalg.norm(twist * [1, 1, 0.15], axis=1).max() for twist, _ in steps[1.0]) > 0.049


@pytest.mark.slow
@pytest.mark.parametrize("target", ["U", "S"])
def test_residual_removes_most_of_what_the_model_gets_wrong(target):
    _, _, without = run(controller(target, WITHOUT), Cable(), 25)
    _, _, info = run(controller(target), Cable(), 25)
    assert without.shape_error[-1] > 0.01
    assert info.shape_error[-1] < 0.7 * without.shape_error[-1]
    assert (without.residual_share == 0).all()
    assert (info.residual_share[2:] > 0).all() and (info.residual_share <= 1).all()
    np.testing.assert_allclose(info.weights.sum(axis=1), 1.0, rtol=1e-5)


def test_commands_respect_every_bound():
    cable = Cable(pose=[[0.0, 0.0, -0.01], [0.99, 0.0, 0.01]])
    control = controller()
    state = control.init(at_rest(jnp.asarray(cable.pose)))
    for _ in range(20):
        state, twist, _ = control.step(state, Measurement(cable.keypoints, cable.pose))
        size = np.linalg.norm(np.asarray(twist, float) * [1, 1, 0.15], axis=-1)
        assert (size <= 0.05).all()
        cable.step(twist)
        assert 0.15 <= np.hypot(*(cable.pose[1, :2] - cable.pose[0, :2])) <= 0.99


def test_grippers_stay_in_the_workspace_and_brake_in_time():
    """The target's ends are held outside; the shape is as good as that allows, and the motion changes slowly."""
    corners = np.array([[-0.5, -0.03], [1.5, 0.03]])
    config = dataclasses.replace(CONFIG, workspace=((-0.5, -0.03), (1.5, 0.03)), max_change=0.01)
    cable = Cable(rate=0.8, sag=0.0)
    control, places = controller(config=config), []
    state, before = control.init(at_rest(jnp.asarray(cable.pose))), np.zeros((2, 3))
    errors = []
    for _ in range(25):
        state, twist, info = control.step(state, Measurement(cable.keypoints, cable.pose))
        cable.step(twist)
        motion = np.asarray(twist, float) * [1, 1, 0.15]
        assert np.linalg.norm(motion - before, axis=-1).max() <= 0.01 + 1e-6
        before = motion
        places.append(cable.pose[:, :2].copy())
        errors.append(float(info.shape_error))
    places = np.array(places)
    assert (places >= corners[0] - 1e-6).all() and (places <= corners[1] + 1e-6).all()
    assert errors[-1] < 0.5 * errors[0]
    assert np.linalg.norm(before) < 5e-3


def test_trust_region_shrinks_when_predictions_fail_and_grows_when_they_hold():
    stuck = Cable(rate=0.0, sag=0.0)
    _, _, info = run(controller(config=WITHOUT), stuck, 6)
    assert (info.rho[1:] < 0.4).all()
    np.testing.assert_allclose(info.radius, 0.05 * 0.95 ** np.arange(6), rtol=1e-5)
    _, _, info = run(controller(config=WITHOUT), Cable(rate=0.8, sag=0.0), 6, radius=0.01)
    np.testing.assert_allclose(info.rho[1:], 1.0, atol=0.05)
    np.testing.assert_allclose(info.radius, 0.01 * 1.05 ** np.arange(6), rtol=1e-5)


def test_trust_region_stays_within_its_limits():
    smallest, largest = WITHOUT.radius_min, WITHOUT.radius_max
    _, _, shrinking = run(controller(config=WITHOUT), Cable(rate=0.0, sag=0.0), 4, radius=1.06 * smallest)
    _, _, growing = run(controller(config=WITHOUT), Cable(rate=0.8, sag=0.0), 4, radius=largest / 1.06)
    assert shrinking.radius[0] > smallest and shrinking.radius[-1] == pytest.approx(smallest)
    assert growing.radius[0] < largest and growing.radius[-1] == pytest.approx(largest)


def test_missing_keypoints_are_held_and_counted_and_not_learned_from():
    def hide(step):
        return [2, 3] if step in (4, 5) else []

    state, twists, info = run(controller(), Cable(), 8, hide)
    assert info.unobserved.tolist() == [0, 0, 0, 0, 2, 2, 0, 0]
    assert int(state.unobserved) == 4
    assert np.isfinite(twists).all() and np.isfinite(info.shape_error).all()
    # Steps that end at 4 and 5, and the one that starts from 5, say nothing about the two keypoints.
    valid = np.asarray(state.learner.window.valid)
    assert valid[:, [0, 1, 4, 5, 6]].all()
    assert valid[:, 2].tolist() == [True, False, False, False, True]
    _, _, clear = run(controller(), Cable(), 25)
    _, _, info = run(controller(), Cable(), 25, hide)
    assert info.shape_error[-1] < clear.shape_error[-1] + 5e-3


def test_nothing_observed_at_all_keeps_going_on_predictions():
    control, cable = controller(), Cable(rate=0.8, sag=0.0)
    state = control.init(at_rest(START))
    for blind in (False, True, True):
        nothing = Measurement(np.full((N, 2), np.nan), np.full((2, 3), np.nan))
        state, twist, _ = control.step(state, nothing if blind else Measurement(cable.keypoints, cable.pose))
        assert np.linalg.norm(twist) > 0.01
        # The model is right here, so that what it expects is where the cable is.
        np.testing.assert_allclose(state.history.keypoints[-1], cable.keypoints, atol=1e-5)
        np.testing.assert_allclose(state.history.gripper_pose, cable.pose, atol=1e-5)
        cable.step(twist)
    assert int(state.unobserved) == 2 * N
    assert not state.learner.window.valid.any()


def test_what_was_not_observed_is_no_evidence_that_the_model_is_right():
    """The prediction stands for the cable, so the error falls as predicted: the radius grew, and was the best seen."""
    control, cable = controller(), Cable(rate=0.8, sag=0.0)
    state = control.init(at_rest(START))
    for _ in range(2):
        state, twist, _ = control.step(state, Measurement(cable.keypoints, cable.pose))
        cable.step(twist)
    state = dataclasses.replace(state, radius=jnp.asarray(0.01, state.radius.dtype))
    best, hidden = float(state.progress.best_error), np.full((N, 2), np.nan)
    for seen in (0, 2, (N + 1) // 2):
        keypoints = hidden.copy()
        keypoints[:seen] = cable.keypoints[:seen]
        after, _, info = control.step(state, Measurement(keypoints, cable.pose))
        assert float(info.shape_error) < 0.99 * best
        blind = 2 * seen < N
        assert float(info.radius) == pytest.approx(0.01 if blind else 0.01 * CONFIG.grow)
        assert (float(after.progress.best_error) == best) == blind


def test_commands_whose_outcome_is_not_seen_did_not_fail():
    """A controller that saw nothing for a while gave up, near its target or far from it."""
    control, cable = controller(), Cable(rate=0.8, sag=0.0)
    state = control.init(at_rest(START))
    state, twist, _ = control.step(state, Measurement(cable.keypoints, cable.pose))
    for _ in range(CONFIG.restart_after + 2):
        cable.step(twist)
        state, twist, info = control.step(state, Measurement(np.full((N, 2), np.nan), cable.pose))
        assert Action(int(info.action)) in (Action.FOLLOW, Action.HOLD) and int(state.progress.mode) == Action.FOLLOW
    assert int(state.progress.since) <= 1 and int(state.progress.restarts) == 0


def test_a_twist_that_is_not_known_is_the_commands():
    control, cable = controller(config=dataclasses.replace(CONFIG, max_change=0.02)), Cable()
    state = control.init(at_rest(START))
    state, twist, _ = control.step(state, Measurement(cable.keypoints, cable.pose))
    cable.step(twist)
    unknown = np.full((2, 3), np.nan)
    results = [
        control.step(state, Measurement(cable.keypoints, pose, known))
        for pose, known in ((cable.pose, unknown), (cable.pose, None), (unknown, unknown))
    ]
    for one, other in zip(*map(jax.tree.leaves, results[:2]), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    assert int(results[2][-1].result) not in (Result.EMPTY_SET, Result.NONFINITE)


@pytest.mark.parametrize("far", [1e20, 3.4e38])
def test_a_keypoint_without_meaning_counts_as_not_observed(far):
    control, cable = controller(), Cable(rate=0.8, sag=0.0)
    state = control.init(at_rest(START))
    for step in range(6):
        keypoints = cable.keypoints.copy()
        if step == 3:
            keypoints[2] = far
        state, twist, info = control.step(state, Measurement(keypoints, cable.pose))
        assert int(info.unobserved) == (step == 3) and int(info.result) != Result.NONFINITE
        assert np.isfinite(info.weights).all() and np.linalg.norm(twist) > 0.01
        cable.step(twist)


def test_a_model_that_yields_nan_makes_the_grippers_hold_still_and_says_so():
    control, cable = controller(rate=float("nan")), Cable()
    state, twists, info = run(control, cable, 4)
    assert (twists == 0).all()
    assert (info.result == Result.NONFINITE).all()
    assert np.isfinite(info.shape_error).all() and np.isfinite(np.asarray(state.last.predicted)).all()
    # It recovers as soon as the model does.
    _, twist, info = dataclasses.replace(control, weights=jnp.asarray(0.8)).step(
        state, Measurement(cable.keypoints, cable.pose)
    )
    assert np.linalg.norm(twist) > 0.01 and int(info.result) != Result.NONFINITE


HEMMED = dataclasses.replace(WITHOUT, workspace=((-3.0, -1.0), (-1.0, 3.0)), restart_after=1)
OUTSIDE = {
    "nowhere": [[-2.0, 0.0, 1.57], [-2.0, 0.9, 1.57]],
    "too far apart": [[-2.0, 0.0, 1.57], [-2.0, 1.2, 1.57]],
    "too near": [[-2.0, 0.0, -0.5], [-2.0, 0.05, 3.64]],
    "outside the workspace": [[-0.9, 0.0, 1.57], [-0.8, 0.9, 1.57]],
    "outside two bounds that contradict each other": [[-0.8, 0.0, 1.57], [-0.8, 1.3, 1.57]],
}


@pytest.mark.parametrize("where", OUTSIDE)
def test_grippers_that_hold_come_back_from_outside_of_their_bounds_and_then_rest(where):
    """Of a model that gives NaN no plan is followed, so every command is that of holding still."""
    cable = Cable(pose=OUTSIDE[where])
    _, twists, info = run(controller(config=HEMMED, rate=float("nan")), cable, 40)
    assert (info.action == Action.HOLD).all()
    size = np.linalg.norm(twists * [1, 1, 0.15], axis=-1)
    assert (size <= 0.05).all()
    assert (twists[0 if where == "nowhere" else 38 :] == 0).all()
    (low, high), place = np.array(HEMMED.workspace), cable.pose[:, :2]
    assert (place >= low - 1e-6).all() and (place <= high + 1e-6).all()
    assert 0.15 - 1e-6 <= np.hypot(*(place[1] - place[0])) <= 0.99 + 1e-6


def test_where_bounds_contradict_each_other_no_plan_is_followed_until_they_agree():
    """Too far apart and outside the workspace, which cannot both be mended as fast as is asked: no straightening."""
    cable = Cable(pose=OUTSIDE["outside two bounds that contradict each other"])
    state, _, info = run(controller(config=HEMMED), cable, 3)
    assert (info.result == Result.EMPTY_SET).all() and (info.action == Action.HOLD).all()
    assert int(state.progress.restarts) == 0


@pytest.mark.slow
def test_data_in_float32_stay_so_where_float64_is_on():
    def single(weights, history, twist):
        return relaxing_cable(weights, history, twist).astype(history.keypoints.dtype)

    with jax.enable_x64(True):
        control, cable = controller(rate=np.float32(0.8), dynamics=single), Cable()
        history = jax.tree.map(lambda x: x.astype(jnp.float32), at_rest(START))
        control = dataclasses.replace(control, target=np.asarray(control.target, float))
        state, twist, _ = control.step(control.init(history), Measurement(cable.keypoints, cable.pose))
        assert {leaf.dtype.name for leaf in (twist, state.last.plan, state.last.predicted, state.radius)} == {"float32"}


def test_at_the_target_the_grippers_rest():
    pose = TARGETS["U"]
    _, twists, info = run(controller(), Cable(rate=0.8, sag=0.0, pose=pose), 4)
    assert (twists == 0).all()
    assert (info.action == Action.HOLD).all()


def stubborn_cable(weights, history, twist):
    """A model in whose eyes every motion but a whole way to the target makes things worse: a valley."""
    newest = history.keypoints[-1]
    away = weights * jnp.sum(jnp.abs(twist)) * jnp.ones_like(newest)
    return away.at[jnp.array([0, -1])].set(twist[:, :2])


@pytest.mark.slow
def test_where_no_plan_helps_the_cable_is_straightened():
    control = controller("S", WITHOUT, rate=5.0, dynamics=stubborn_cable)
    cable = Cable(rate=0.8, sag=0.0, pose=[[0.0, 0.0, 0.6], [0.7, 0.1, -0.6]])
    state, twists, info = run(control, cable, 20)
    count = int((info.action == Action.STRAIGHTEN).sum())
    assert count > 2 and (info.action[:count] == Action.STRAIGHTEN).all(), "at once, and in one go"
    assert (info.action[count:] == Action.HOLD).all() and int(state.progress.restarts) == 1
    assert (np.linalg.norm(twists * [1, 1, 0.15], axis=-1) <= 0.05 * (1 + 1e-5)).all()
    # a cable that seems to be shorter than believed is not straightened to the full
    way = (np.asarray(straightened(control.target, 0.99 * 0.95)) - cable.pose) * [1, 1, 0.15]
    assert np.linalg.norm(way, axis=1).max() < 0.05, "it ends a step before that, where planning takes over"
    assert (run(control, cable, 3, restarts=WITHOUT.max_restarts)[2].action == Action.HOLD).all()


def test_a_cable_that_is_shorter_than_believed_is_not_pulled_taut():
    class Slipped(Cable):
        """Of 0.97 m: no farther apart than that are its grippers."""

        farthest = 0.0

        def step(self, twist):
            super().step(twist)
            apart = self.pose[1, :2] - self.pose[0, :2]
            self.farthest = max(self.farthest, np.linalg.norm(apart))
            offset = np.zeros((N, 2))
            offset[:, 1] = np.sin(np.pi * np.linspace(0.0, 1.0, N))
            flat = self.pose[0, :2] + np.linspace(0.0, 1.0, N)[:, None] * apart

            def length(height):
                return np.linalg.norm(np.diff(flat + height * offset, axis=0), axis=1).sum()

            high = scipy.optimize.brentq(lambda height: length(height) - 0.97, 0.0, 1.0) if length(0.0) < 0.97 else 0.0
            self.keypoints = flat + high * offset

    cable = Slipped(sag=0.0, pose=[[0.0, 0.0, 0.6], [0.7, 0.1, -0.6]])
    cable.step(np.zeros((2, 3)))
    _, _, info = run(controller("S", WITHOUT, rate=5.0, dynamics=stubborn_cable), cable, 20)
    assert (info.action == Action.STRAIGHTEN).sum() > 2
    assert 0.9 < cable.farthest < 0.97


def test_a_cable_that_comes_no_nearer_is_straightened_as_often_as_allowed():
    stuck, last = Cable(rate=0.0, sag=0.0), WITHOUT.max_restarts - 1
    state, twists, info = run(controller("U", WITHOUT), stuck, 60, restarts=last)
    begun = np.diff(np.asarray(info.action == Action.STRAIGHTEN).astype(int), prepend=0) == 1
    assert begun.sum() == 1 and int(state.progress.restarts) == WITHOUT.max_restarts
    assert np.flatnonzero(begun)[0] >= WITHOUT.restart_after and np.isfinite(info.objective).all()
    assert (np.linalg.norm(twists * [1, 1, 0.15], axis=-1) <= 0.05 * (1 + 1e-5)).all()


def test_where_nothing_gets_better_the_grippers_rest_until_it_is_disturbed():
    class Shaken(Cable):
        """Its sag changes from step to step, which no plan can foresee, and jumps in the end."""

        count = 0

        def step(self, twist):
            self.count += 1
            jump = 0.02 if self.count > 45 else 0.0
            self.sag[:, 1] = (0.02 + jump + 3e-4 * np.sin(self.count)) * np.sin(np.linspace(0, np.pi, N))
            super().step(twist)

    _state, twists, info = run(controller("S"), Shaken(rate=1.0), 60)
    moved = np.linalg.norm(twists[:45].reshape(45, -1), axis=1) > 0
    began = int(np.flatnonzero(moved)[-1]) + 1
    assert 0 < began < 40
    assert (info.action[began:45] == Action.HOLD).all()
    assert info.shape_error[began] <= ABOUT * info.shape_error[:began].min()
    assert (info.action[46:50] == Action.FOLLOW).any(), "planning goes on after a disturbance"
    assert info.shape_error[-1] < info.shape_error[47] and np.isfinite(info.objective).all()


def courses(config, errors, ways_back=()):
    """The progress after each of these errors [m], with the ways back [m] at the last ones."""
    pose, yes = jnp.asarray(START), jnp.asarray(True)
    progress = initial_state(config, at_rest(pose)).progress
    for k, error in enumerate(errors):
        ways = jnp.asarray(0.1), jnp.asarray(([0.08] * (len(errors) - len(ways_back)) + [*ways_back])[k])
        progress = _followed(config, progress, pose, jnp.asarray(error), ways, seen=yes, sound=yes, held=~yes)
        yield progress


def test_the_grippers_rest_at_a_good_moment():
    def modes(errors):
        return [Action(int(progress.mode)) for progress in courses(MPCConfig(settle_after=2), errors)]

    follow, rest = Action.FOLLOW, Action.HOLD
    tired = [0.004, 0.003, 0.003, 0.003]
    assert list(modes(tired)) == [follow, follow, follow, rest]
    assert list(modes([*tired, 0.005, 0.0055, 0.0058]))[-3:] == [rest, rest, rest], "the cable relaxes by itself"
    assert list(modes([*tired, 0.005, 0.005, 0.0065]))[-1] == follow, "and is disturbed"
    assert list(modes([*tired, 0.1, 0.03, 0.03]))[-1] == follow, "as it may be while it relaxes"
    far = [0.03, 0.02, 0.02, 0.02, 0.039, 0.077, 0.077]
    assert list(modes(far))[3:] == [rest, rest, rest, follow], "nor far away"


def test_what_makes_the_error_worse_is_taken_back_and_tried_again_with_smaller_motions():
    config, follow, rest, back = MPCConfig(), Action.FOLLOW, Action.HOLD, Action.RETURN
    worse = [0.006, 0.006, 0.0045]
    course = list(courses(config, [0.004, 0.003, *worse], (0.08, 0.03, 0.0)))
    assert [int(progress.mode) for progress in course[2:]] == [follow, back, follow]
    assert float(course[-1].best_error) == pytest.approx(0.0045), "friction may hold the cable in another shape there"
    little = list(courses(config, [0.004, 0.003, 0.0037, 0.0036, 0.0037]))
    assert all(int(progress.mode) == follow for progress in little), "about as low"
    again = list(courses(config, [0.004, *[0.003, *worse] * (RETURNS + 1)], [0.08, 0.08, 0.03, 0.0] * (RETURNS + 1)))
    assert [int(progress.mode) for progress in again].count(back) == RETURNS
    assert int(again[-1].mode) == rest

    radius = jnp.asarray(config.radius)
    assert float(radius_after(config, course[2], course[3], radius)) == pytest.approx(config.radius / 2)
    assert float(radius_after(config, course[3], course[4], radius / 2)) == pytest.approx(config.radius / 2)
    pushed = course[-1]._replace(mode=jnp.asarray(rest, jnp.int32))
    assert float(radius_after(config, pushed, course[-1], radius / 16)) == pytest.approx(config.radius)
    assert float(radius_after(config, course[2], course[3], radius / 24)) == pytest.approx(config.radius_min)


@pytest.mark.parametrize("turns", [0, 1, -2])
def test_the_way_back_is_short_whatever_whole_turns_a_gripper_has(turns):
    class Slipping(Cable):
        """It gets worse for some steps once it is near the target, which is no fault of the commands."""

        count = 0

        def step(self, twist):
            self.count += 1
            if 12 <= self.count < 16:
                self.sag[:, 1] += 0.006 * np.sin(np.linspace(0, 2 * np.pi, N))
            super().step(twist)

    pose = np.array(START, float)
    pose[1, 2] += 2 * np.pi * turns
    _state, twists, info = run(controller("S"), Slipping(rate=1.0, pose=pose), 24)
    back = info.action == Action.RETURN
    assert back.any() and np.abs(twists[back][:, :, 2]).max() < 0.1
    assert info.shape_error[12:].max() < 0.04


@pytest.mark.slow
def test_many_cables_in_one_call_are_the_same_as_one_by_one():
    control = controller()
    starts = [jnp.asarray([[0.0, 0.0, a], [d, 0.0, -a]]) for a, d in ((0.0, 0.97), (0.3, 0.9), (-0.4, 0.8))]
    states = [control.init(at_rest(pose)) for pose in starts]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    keypoints = jnp.stack([hermite_shape(pose, N) for pose in starts])
    step = jax.jit(jax.vmap(control.step))
    batch, twists, _ = step(batch, Measurement(keypoints, jnp.stack(starts)))
    batch, twists, info = step(batch, Measurement(batch.last.predicted, jnp.stack(starts) + twists))
    for i, (state, pose) in enumerate(zip(states, starts, strict=True)):
        state, twist, _ = control.step(state, Measurement(keypoints[i], pose))
        state, twist, alone = control.step(state, Measurement(state.last.predicted, pose + twist))
        np.testing.assert_allclose(twists[i], twist, atol=1e-4)
        assert float(info.objective[i]) == pytest.approx(float(alone.objective), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("adaptation", [None, AdaptationConfig()])
def test_the_model_is_judged_by_the_twist_that_was_executed(adaptation):
    """A command that something else shortened is not an error of the model."""
    config = dataclasses.replace(CONFIG, adaptation=adaptation)
    control, cable = controller(config=config), Cable()
    state = control.init(at_rest(START))
    state, twist, _ = control.step(state, Measurement(cable.keypoints, cable.pose))
    executed = 0.4 * np.asarray(twist)
    cable.step(executed)
    newest, pose = state.history.keypoints[-1], state.history.gripper_pose
    told, *_ = control.step(state, Measurement(cable.keypoints, cable.pose, executed))
    displacement = relaxing_cable(control.weights, state.history, jnp.asarray(executed))
    expected = cable.keypoints - newest - displacement
    np.testing.assert_allclose(told.learner.window.error[-1], expected, atol=1e-12)
    np.testing.assert_allclose(told.learner.window.twist[-1], executed, atol=1e-12)
    # a pose that was not measured is where the executed command led
    blind, *_ = control.step(state, Measurement(cable.keypoints, np.full((2, 3), np.nan), executed))
    np.testing.assert_allclose(blind.history.gripper_pose, pose + executed, atol=1e-12)
    # told the command itself, it does what it does untold
    for one, other in zip(
        *(jax.tree.leaves(control.step(state, Measurement(cable.keypoints, cable.pose, t))) for t in (None, twist)),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-7)


def test_new_weights_and_targets_do_not_compile_anew():
    traces = []

    def counting(weights, history, twist):
        traces.append(1)
        return relaxing_cable(weights, history, twist)

    control, cable = controller(dynamics=counting), Cable()
    state = control.init(at_rest(START))
    control.step(state, Measurement(cable.keypoints, cable.pose))
    before = len(traces)
    other = dataclasses.replace(control, weights=jnp.asarray(0.7), target=control.target + 0.01)
    other.step(state, Measurement(cable.keypoints, cable.pose))
    assert len(traces) == before > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"horizon": -1}, "horizon"),
        ({"horizon": 2.5}, "horizon"),
        ({"cable_length": -1.0}, "cable_length"),
        ({"min_distance": 0.995}, "min_distance"),
        ({"radius": 0.06}, "radius_min"),
        ({"shrink_below": 0.9}, "thresholds"),
        ({"min_reduction": 0.0}, "min_reduction"),
        ({"workspace": ((0.0, 1.0), (1.0, 0.0))}, "workspace"),
        # a bound at infinity took the opposite one with it
        ({"workspace": ((0.0, -1.0), (np.inf, 1.0))}, r"workspace .* each a number from -100 to 100 m"),
        ({"workspace": ("ab", "cd")}, "workspace"),
        ({"max_change": 0.0}, "max_change"),
        ({"max_restarts": 1.5}, "max_restarts"),
        ({"restart_after": 2.5}, "restart_after"),
        ({"solver": "levenberg-marquardt"}, r"solver is 'levenberg-marquardt', expected a solver such as"),
        ({"solver": LevenbergMarquardt}, "expected a solver such as"),
        ({"objective": None}, "objective is None, expected ObjectiveConfig"),
        ({"residual": True}, "residual is True, expected LearnerConfig or None"),
        ({"adaptation": 1.0}, "adaptation is 1.0, expected AdaptationConfig or None"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(MPCConfig(), **change)


def test_impossible_inputs_are_refused():
    with pytest.raises(ValueError, match="non-finite"):
        MPC(CONFIG, relaxing_cable, jnp.ones(()), hermite_shape(START, N).at[2].set(jnp.nan))
    with pytest.raises(ValueError, match=r"shape \(7, 2\) and complex values, expected finite real keypoints"):
        MPC(CONFIG, relaxing_cable, jnp.ones(()), np.asarray(hermite_shape(START, N), complex))
    with pytest.raises(ValueError, match="three or more"):
        MPC(CONFIG, relaxing_cable, jnp.ones(()), hermite_shape(START, 2))
    with pytest.raises(ValueError, match=r"max_iterations is 1\.5, expected a whole number from 1"):
        LevenbergMarquardt(max_iterations=1.5)
    control = controller()
    with pytest.raises(ValueError, match=r"\(7, 2\) as the target"):
        control.init(at_rest(START, n_keypoints=9))
    with pytest.raises(ValueError, match="complete observation"):
        control.init(jax.tree.map(lambda x: x.at[-1].set(jnp.nan), at_rest(START)))
    state = control.init(History(np.tile(hermite_shape(START, N), (3, 1, 1)), np.asarray(START)))
    full = at_rest(START)
    for wrong, message in [
        (dataclasses.replace(full, keypoints=full.keypoints[:0]), "at least one sample"),
        (dataclasses.replace(full, keypoints=full.keypoints[-1]), "at least one sample"),
        (dataclasses.replace(full, keypoints=np.asarray(full.keypoints).tolist()), "keypoints are list"),
        (
            dataclasses.replace(full, keypoints=np.zeros((3, N, 2), int)),
            "array of int64, expected an array of float",
        ),
        (dataclasses.replace(full, gripper_pose=np.zeros((2, 3), complex)), "gripper poses are an array of complex128"),
    ]:
        with pytest.raises(ValueError, match=message):
            control.init(wrong)
    with pytest.raises(ValueError, match="Measured keypoints are list"):
        control.step(state, Measurement([[0.0, 0.0]] * N, np.zeros((2, 3))))
    with pytest.raises(ValueError, match="gripper poses"):
        control.step(state, Measurement(np.zeros((N, 2)), np.zeros((3, 3))))
    with pytest.raises(ValueError, match=r"twist of shape \(3,\), expected \(2, 3\)"):
        control.step(state, Measurement(np.zeros((N, 2)), np.zeros((2, 3)), np.zeros(3)))


@pytest.mark.parametrize(
    ("dynamics", "message"),
    [
        (lambda weights, history, twist: history.keypoints[-1, 1:], rf"an array of shape \({N - 1}, 2\), expected"),
        (lambda weights, history, twist: jnp.zeros(2), r"an array of shape \(2,\), expected displacements"),
        (lambda weights, history, twist: None, "The model gave NoneType, expected"),
        (lambda history, twist: history.keypoints[-1], r"could not be called: .* Expected `dynamics\(weights"),
    ],
)
def test_a_model_that_gives_no_displacements_is_refused_at_the_start(dynamics, message):
    with pytest.raises(ValueError, match=message):
        MPC(CONFIG, dynamics, jnp.ones(()), hermite_shape(START, N)).init(at_rest(START))


def test_millimetres_and_whole_targets_are_refused():
    millimetres = jax.tree.map(lambda x: 1000.0 * x, at_rest(START))
    with pytest.raises(ValueError, match=r"m apart, but the cable is .* expected poses and keypoints in metres"):
        controller().init(millimetres)
    short = jax.tree.map(lambda x: 0.4 * x, at_rest(START))
    with pytest.raises(ValueError, match=r"along its keypoints, but MPCConfig\.cable_length is 1 m: use "):
        controller().init(short)
    check_reach(1.0, dataclasses.replace(short, keypoints=short.keypoints[:, [0, N // 2, -1]]))
    whole = Target("own", np.asarray(hermite_shape(START, N)), np.asarray(START))
    with pytest.raises(ValueError, match=r"The target is a Target, expected an array of keypoints .*: its `keypoints`"):
        MPC(CONFIG, relaxing_cable, jnp.ones(()), whole)  # pyright: ignore[reportArgumentType]
    twice = np.array(whole.keypoints)
    twice[4] = twice[3]
    with pytest.raises(ValueError, match=r"The target's keypoints 3 and 4 are at one point, expected keypoints along"):
        MPC(CONFIG, relaxing_cable, jnp.ones(()), twice)
