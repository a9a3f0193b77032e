"""The closed loop, driven by controllers simple enough to check by hand."""

import dataclasses

import numpy as np
import pytest

from cablejax.cable import Discretisation
from cablejax.control.loop import run_closed_loop
from cablejax.control.run import settling_time, shape_error_cm
from cablejax.control.targets import Target, make_target, straight_start
from cablejax.gaplog import gap_log_from_episodes, read_gap_log, write_gap_log
from cablejax.simulate.plant import Plant, PlantConfig

CABLE = Discretisation(n_links=12, dimension=3, timestep=0.005)
CONFIG = PlantConfig(discretisation=CABLE, settle_time=0.2)


@dataclasses.dataclass(frozen=True)
class Info:
    residual_share: float
    radius: float


@dataclasses.dataclass(frozen=True)
class GoToPose:
    """Moves the grippers straight to given poses, in bounded steps; its state counts the commands."""

    pose: np.ndarray
    bound: float = 0.05

    def init(self, history):
        assert history.keypoints.shape == (6, 13, 2) and np.isfinite(history.keypoints).all()
        return 0

    def step(self, state, measurement):
        twist = self.pose - measurement.gripper_pose
        size = np.linalg.norm(twist * [1.0, 1.0, 0.15], axis=1).max()
        return state + 1, twist * min(1.0, self.bound / max(size, 1e-12)), Info(state / 100, self.bound)


@dataclasses.dataclass(frozen=True)
class Failing(GoToPose):
    """Commands nonsense from the third step on."""

    def step(self, state, measurement):
        state, twist, info = super().step(state, measurement)
        return state, twist * (np.nan if state > 2 else 1.0), info


def test_a_reachable_shape_is_reached_and_recorded(tmp_path):
    target = make_target("U", CABLE.cable)
    run = run_closed_loop(
        Plant(CONFIG), GoToPose(target.gripper_pose), target, 14, start=straight_start(CABLE.cable), record_hz=5.0
    )
    assert run.times.tolist() == list(range(15))
    assert run.initial_error_cm > 20
    assert run.terminal_error_cm < 1.0
    assert 4 < run.settling_time_s < 12
    assert run.verdict().startswith("U: reached")
    assert run.stopped is None and run.unobserved == 0
    # Commands lead from each row to the next; none was computed at the last.
    np.testing.assert_allclose(np.diff(run.gripper_pose, axis=0), run.twist[:-1], atol=1e-12)
    for rows in (run.twist.sum(axis=(1, 2)), run.residual_share, run.radius, run.mpc_ms):
        assert np.isfinite(rows[:-1]).all() and np.isnan(rows[-1])
    assert run.residual_share[3] == 0.03
    assert (run.mpc_ms[:-1] < 50).all()

    episode = run.episode
    assert episode.motion == "approach_u"
    assert len(episode.time) == 15 * 5 + 1  # one interval at rest, fourteen commands, both ends
    np.testing.assert_allclose(np.diff(episode.time), 0.2)
    dt = np.diff(episode.time)[:, None, None]
    np.testing.assert_allclose(np.diff(episode.gripper_pose, axis=0), episode.gripper_command[:-1] * dt, atol=1e-12)
    assert episode.hold.sum() == 6 and (episode.gripper_command[:5] == 0).all()
    np.testing.assert_array_equal(episode.keypoints[5::5], run.keypoints)
    assert np.abs(episode.keypoints[episode.hold] - episode.keypoints[0]).max() < 1e-4

    path = write_gap_log(tmp_path / "log.npz", gap_log_from_episodes([episode], CABLE.cable, source="test"))
    np.testing.assert_array_equal(read_gap_log(path).keypoints[0], episode.keypoints.astype(np.float32))


def test_an_unreachable_target_says_how_far_it_got():
    shape = make_target("U", CABLE.cable)
    far = Target("far", shape.keypoints + np.array([0.0, 2.0]), shape.gripper_pose + np.array([0.0, 2.0, 0.0]))
    run = run_closed_loop(
        Plant(CONFIG), GoToPose(far.gripper_pose), far, 3, start=straight_start(CABLE.cable), record_hz=1.0
    )
    assert run.settling_time_s == float("inf")
    assert f"from {run.initial_error_cm:.2f} to {run.terminal_error_cm:.2f} cm" in run.verdict()
    assert "not reached within 1.00 cm" in run.verdict()


def test_a_failing_controller_loses_nothing():
    target = make_target("S", CABLE.cable)
    run = run_closed_loop(Plant(CONFIG), Failing(target.gripper_pose), target, 9, start=straight_start(CABLE.cable))
    assert run.stopped is not None and "not finite" in run.stopped
    assert len(run.times) == 3 and np.isfinite(run.error_cm).all()
    assert len(run.episode.time) == 3 * 10 + 1
    assert "It stopped after 2 s" in run.verdict()


class Silent(Plant):
    """Loses its encoders after two seconds."""

    def record(self, twist, interval, *, samples):
        seen = super().record(twist, interval, samples=samples)
        lost = np.full((2, 3), np.nan)
        return [one if one.time < 2.5 else dataclasses.replace(one, gripper_pose=lost) for one in seen]


def test_a_plant_that_falls_silent_loses_nothing():
    target = make_target("U", CABLE.cable)
    run = run_closed_loop(Silent(CONFIG), GoToPose(target.gripper_pose), target, 9, start=straight_start(CABLE.cable))
    assert run.stopped is not None and "The observations of the plant cannot be used" in run.stopped
    assert 1 <= len(run.times) <= 4 and np.isfinite(run.error_cm).all()


def test_a_run_whose_end_was_hardly_seen_is_not_a_success():
    target = make_target("U", CABLE.cable)
    run = run_closed_loop(
        Plant(CONFIG), GoToPose(target.gripper_pose), target, 14, start=straight_start(CABLE.cable), record_hz=1.0
    )

    def observed(*seen: int):
        keypoints = run.keypoints.copy()
        keypoints[1:] = np.nan
        keypoints[1:, list(seen)] = run.keypoints[1:, list(seen)]
        error = shape_error_cm(keypoints, target.keypoints)
        return dataclasses.replace(run, keypoints=keypoints, error_cm=error)

    assert observed(*range(7)).reached and not observed(0, 12).reached
    assert "at the end 2 of 13 keypoints were observed, of which keypoint" in observed(0, 12).verdict()
    assert "at the end 0 of 13 keypoints were observed." in observed().verdict()
    # the simulation knows better than its camera
    assert dataclasses.replace(observed(0, 12), error_cm=run.error_cm).reached
    nothing = dataclasses.replace(observed(), error_cm=np.full(15, np.nan))
    assert nothing.verdict() == "U: no keypoint of the cable was ever observed."


def test_a_taut_pull_stops_the_run():
    start = straight_start(CABLE.cable)
    apart = start + np.array([[-0.3, 0, 0], [0.3, 0, 0]])
    run = run_closed_loop(Plant(CONFIG), GoToPose(apart), make_target("U", CABLE.cable), 5, start=start)
    assert run.stopped is not None and "taut" in run.stopped and len(run.times) == 1


def test_missing_keypoints_are_counted_and_do_not_spread():
    plant = Plant(dataclasses.replace(CONFIG, keypoint_dropout=0.3))
    target = make_target("U", CABLE.cable)
    run = run_closed_loop(
        plant, GoToPose(target.gripper_pose), target, 2, start=straight_start(CABLE.cable), record_hz=1.0
    )
    assert run.unobserved == np.isnan(run.keypoints[..., 0]).sum() > 0
    assert np.isfinite(run.error_cm).all()


def test_wrong_requests_are_refused():
    target, start = make_target("U", CABLE.cable), straight_start(CABLE.cable)
    plant, controller = Plant(CONFIG), GoToPose(target.gripper_pose)
    with pytest.raises(ValueError, match="at least one step"):
        run_closed_loop(plant, controller, target, 0, start=start)
    with pytest.raises(ValueError, match=r"The time of a run is 20001.*, expected .* to 10000 s.* make several runs"):
        run_closed_loop(plant, controller, target, 20_000, start=start)
    with pytest.raises(ValueError, match="whole number of samples"):
        run_closed_loop(plant, controller, target, 1, start=start, record_hz=2.5)
    short = dataclasses.replace(target, keypoints=target.keypoints[:-1])
    with pytest.raises(ValueError, match=r"\(12, 2\), but the cable is seen at \(13, 2\)"):
        run_closed_loop(plant, controller, short, 1, start=start)


def test_shape_error_is_the_root_mean_square_distance():
    target = np.zeros((4, 2))
    shape = np.array([[0.03, 0.04], [0.0, 0.0], [0.03, 0.04], [0.0, 0.0]])
    assert shape_error_cm(shape, target) == pytest.approx(5 / np.sqrt(2))
    shape[1] = np.nan
    assert shape_error_cm(shape, target) == pytest.approx(5 * np.sqrt(2 / 3))
    assert np.isnan(shape_error_cm(np.full((4, 2), np.nan), target))


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        ([10, 5, 2, 1.05, 0.95, 1.0], 3.0),
        ([10, 1, 5, 1.0, 1.0, 1.0], 3.0),  # leaving the band starts anew
        ([1.0, 1.0, 1.0, 1.0], 0.0),
        ([10, 8, 6, 4, 2], np.inf),
        ([10, 0.15, 0.12, 0.1, 0.05], 1.0),  # below a millimetre all is settled
        ([60, 58, 56, 54, 52], np.inf),  # a far target is not settled just because 10 % of far is much
        ([10, 5, 5, np.nan], np.inf),
    ],
)
def test_settling_time(error, expected):
    assert settling_time(np.arange(len(error), dtype=float), np.array(error), 1.0) == expected
    # in a cable of another length everything is in proportion
    assert settling_time(np.arange(len(error), dtype=float), 0.3 * np.array(error), 0.3) == expected
