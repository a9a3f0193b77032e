"""The link between a controller and a robot: what it commands when messages fail."""

import dataclasses
import math
import re

import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.control.command_limits import CommandLimits
from cablejax.control.link import RobotLink
from cablejax.control.link_state import LinkConfig, Status
from cablejax.control.run_log import RunLog
from cablejax.control.targets import make_target, straight_start
from cablejax.gaplog import GapLogError
from cablejax.simulate.table_plant import Observation

CABLE = Cable()
TARGET = make_target("U", CABLE)
START = straight_start(CABLE)
KEYPOINTS = np.stack([np.linspace(-0.495, 0.495, CABLE.n_keypoints), np.zeros(CABLE.n_keypoints)], axis=1)


@dataclasses.dataclass(frozen=True)
class Inwards:
    """Brings the grippers together at a constant speed; its state counts its calls."""

    speed: float = 0.01
    turn: float = 0.0

    def init(self, history):
        assert np.isfinite(history.keypoints).all()
        return 0

    def step(self, state, measurement):
        return state + 1, np.array([[self.speed, 0.0, self.turn], [-self.speed, 0.0, -self.turn]]), None


class Harness:
    """A link on a perfect robot, whose messages a test spoils."""

    def __init__(self, controller=Inwards(), **settings):
        self.link = RobotLink(controller, TARGET, LinkConfig(**settings))
        self.state, self.log, self.pose = self.link.init(), RunLog(), START.copy()

    def seen(self, stamp, **changes):
        # noise, so that no keypoint is frozen
        keypoints = KEYPOINTS + 1e-4 * np.sin(100 * stamp + np.arange(KEYPOINTS.size)).reshape(KEYPOINTS.shape)
        return dataclasses.replace(Observation(keypoints, self.pose.copy(), stamp), **changes)

    def step(self, now, *observations):
        self.state, reply = self.link.step(self.state, now, observations)
        self.log.add(reply)
        return reply

    def run(self, until, begin=0.0, period=0.1):
        """A perfect connection; the last reply."""
        for k in range(round((until - begin) / period) + 1):
            now = begin + k * period
            reply = self.step(now, self.seen(now))
            self.pose = self.pose + period * reply.twist
        return reply


def test_it_rests_then_commands_at_every_interval():
    robot = Harness()
    assert robot.run(0.9).status == Status.RESTING and not robot.log.instants
    reply = robot.run(3.5, begin=1.0)
    assert reply.status == Status.SHAPING and (reply.since, reply.until) == pytest.approx((3.0, 4.2))
    assert [instant.observation.time for instant in robot.log.instants] == pytest.approx([1.0, 2.0, 3.0])
    [(start, episode)] = robot.log.episodes("test")
    assert start == 0.0 and len(episode.time) == 36 and episode.hold.sum() == 11
    assert (episode.gripper_command[:10] == 0).all() and (episode.gripper_command[10:, 0, 0] == 0.01).all()


@pytest.mark.parametrize("silent", [True, False])
def test_a_clock_that_is_set_back_does_not_stop_the_watchdog(silent):
    """A computer's clock may be; a twist ends all the same."""
    robot = Harness()
    robot.run(3.0)
    for k in range(1, 60):
        now = 3.0 + 0.1 * k
        reply = robot.step(now - 50.0, *(() if silent else (robot.seen(now),)))
        robot.pose = robot.pose + 0.1 * reply.twist
    if silent:
        assert reply.status == Status.PAUSED and not reply.twist.any()
        assert robot.pose[0, 0] - START[0, 0] == pytest.approx(0.025, abs=0.01)
    else:
        assert reply.status == Status.SHAPING and robot.pose[0, 0] - START[0, 0] == pytest.approx(0.079, abs=0.01)


def test_a_clock_that_is_set_forward_is_told():
    robot = Harness()
    robot.run(3.0)
    for k in range(1, 20):
        reply = robot.step(63.0 + 0.1 * k, robot.seen(3.0 + 0.1 * k))
    assert reply.status == Status.PAUSED and not reply.twist.any()
    assert re.match(r"Observations are (59\.9|60)\S* s old: do they arrive late, or was a clock set\?", reply.reason)


@pytest.mark.parametrize("spoil", [["keypoints"], ["gripper_pose"], ["keypoints", "gripper_pose"]])
def test_ends_that_are_exchanged_on_the_way_pause_the_robot(spoil):
    robot = Harness()
    robot.run(2.0)
    for k in range(1, 30):
        now = 2.0 + 0.1 * k
        seen = robot.seen(now)
        reply = robot.step(now, dataclasses.replace(seen, **{name: getattr(seen, name)[::-1] for name in spoil}))
        told = "at the other one's last position" if "gripper_pose" in spoil else "first keypoint is at gripper 1"
        assert told in reply.refused[0]
    assert reply.status == Status.PAUSED and not reply.twist.any()


def test_the_watchdog_holds_the_grippers_and_begins_from_rest():
    robot = Harness()
    robot.run(2.0)
    assert robot.step(2.45).twist.any()
    pause = robot.step(2.6)
    assert pause.status == Status.PAUSED and not pause.twist.any() and "0.60 s" in pause.reason
    assert robot.step(3.0).since == pause.since == pytest.approx(2.6, abs=1e-3)
    assert robot.run(4.0, begin=3.1).status == Status.RESTING
    assert robot.run(4.5, begin=4.1).status == Status.SHAPING
    assert robot.state.controller == 1  # it began again
    [(_, episode)] = robot.log.episodes("test")
    moving = episode.gripper_command.any(axis=(1, 2))
    np.testing.assert_array_equal(moving, (episode.time > 0.95) & (episode.time < 2.05) | (episode.time > 4.05))
    assert [event[1] for event in robot.log.events] == ["resting", "shaping", "paused", "resting", "shaping"]


def test_a_command_ends_by_itself_where_the_next_is_not_in_time():
    robot = Harness(watchdog=5.0)
    robot.run(1.9)
    assert robot.step(2.19).twist.any()
    reply = robot.step(2.21)
    assert reply.status == Status.SHAPING and not reply.twist.any() and reply.since == pytest.approx(2.2)


def test_old_news_do_not_feed_the_watchdog_but_are_logged_in_order():
    robot = Harness()
    robot.run(2.0)
    late = robot.seen(1.85)
    for now in (2.2, 2.4, 2.6):
        reply = robot.step(now, late, robot.seen(0.1 * 19))
    assert reply.status == Status.PAUSED
    [(_, episode)] = robot.log.episodes("test")
    assert 1.85 in episode.time and (np.diff(episode.time) > 0).all()
    assert robot.log.counts["doubled"] == 2 + 3


def test_a_slow_connection_is_told_from_a_slow_clock():
    # the robot's clock runs 0.05 % slow and began a year ago: no pause
    robot = Harness()
    for k in range(3000):
        reply = robot.step(0.1 * k, robot.seen(3e7 + 0.1 * k * 0.9995))
    assert reply.status == Status.SHAPING and len([e for e in robot.log.events if e[1] == "paused"]) == 0
    # its messages take longer and longer: a pause
    robot = Harness()
    replies = [robot.step(0.1 * k, robot.seen(0.08 * k)) for k in range(40)]
    assert replies[-1].status == Status.PAUSED


@pytest.mark.parametrize(
    "spoiled",
    [
        {"keypoints": np.full_like(KEYPOINTS, np.nan)},
        {"keypoints": np.full_like(KEYPOINTS, np.inf)},
        {"keypoints": KEYPOINTS + 50.0},
        {"keypoints": KEYPOINTS * 1e200},
        {"gripper_pose": START * np.nan},
        {"gripper_pose": START + np.array([[np.inf, 0, 0], [0, 0, 0]])},
        {"keypoints": KEYPOINTS[1:]},
        {"gripper_pose": START[:1]},
        {"time": math.nan},
        {"time": math.inf},
        {"time": -5.0},
        {"time": 1.7e18},
        {"time": 4e3},
        {"keypoints": "nonsense"},
        {"time": None},
    ],
)
def test_nonsense_is_no_observation(spoiled, tmp_path):
    robot = Harness()
    robot.run(2.0)
    for k in range(1, 8):
        reply = robot.step(2.0 + 0.1 * k, robot.seen(2.0 + 0.1 * k, **spoiled))
    assert reply.status == Status.PAUSED and not reply.twist.any()
    assert robot.run(4.5, begin=2.8).status == Status.SHAPING
    log = robot.log.gap_log(TARGET, CABLE, "test")  # valid
    counts = log.meta["robot_link"]["counts"]
    assert counts["received"] == 21 + 7 + 18 and sum(log.episode_length) == counts["received"] - counts["refused"]


def test_a_tracker_that_stopped_is_blind():
    robot = Harness(Inwards(speed=0.05))
    frozen = KEYPOINTS.copy()
    for k in range(40):
        reply = robot.step(0.1 * k, robot.seen(0.1 * k, keypoints=frozen))
        robot.pose = robot.pose + 0.1 * reply.twist
    assert reply.status == Status.PAUSED and np.abs(robot.pose - START).max() < 0.1


def test_a_tracker_that_stopped_is_blind_while_the_grippers_turn():
    robot = Harness(Inwards(speed=0.0, turn=0.1))
    frozen = KEYPOINTS.copy()
    for k in range(60):
        reply = robot.step(0.1 * k, robot.seen(0.1 * k, keypoints=frozen))
        robot.pose = robot.pose + 0.1 * reply.twist
    assert reply.status == Status.PAUSED and np.abs(robot.pose - START).max() < 0.25


def test_a_tracker_that_stopped_where_a_pose_was_not_known_is_blind():
    robot = Harness(Inwards(speed=0.05))
    robot.run(1.0)
    frozen = KEYPOINTS.copy()
    for k in range(11, 50):
        pose = np.full((2, 3), np.nan) if k == 11 else robot.pose.copy()
        reply = robot.step(0.1 * k, robot.seen(0.1 * k, keypoints=frozen, gripper_pose=pose))
        robot.pose = robot.pose + 0.1 * reply.twist
    assert reply.status == Status.PAUSED and np.abs(robot.pose - START).max() < 0.15


def test_a_clock_that_begins_again_before_the_first_command_is_another_recording():
    robot = Harness()
    robot.run(0.5)
    robot.pose[:, 0] += 0.03
    assert robot.step(3.7).status == Status.WAITING
    for k in range(20):  # a simulation that was reset: its clock, not ours
        robot.step(3.8 + 0.1 * k, robot.seen(0.1 * k))
    [(_, episode)] = robot.log.episodes("test")
    assert (episode.gripper_pose[:, 0, 0] == episode.gripper_pose[0, 0, 0]).all()


def test_what_comes_late_is_commanded_late_in_the_log_too():
    robot = Harness()
    for k in range(41):
        late = 0.3 if k else 0.0
        reply = robot.step(0.1 * k + late, robot.seen(0.1 * k))
        if reply.status == Status.SHAPING and reply.instant is not None:
            assert reply.since == pytest.approx(0.1 * k + 0.3, abs=5e-3)
    [(_, episode)] = robot.log.episodes("test")
    since = [command[0] for command in robot.log._commands]
    assert since == sorted(since)
    # each ends 1.2 s after what it was made for, and the next one comes 1.3 s after that
    moving, index = episode.gripper_command[:, 0, 0] != 0, np.arange(len(episode.time))
    np.testing.assert_array_equal(moving, (index >= 13) & (index % 10 != 2))


def test_a_command_holds_since_it_was_computed():
    """Or a log has it in force before the arms could know of it, and perfect arms seem to lag."""
    clock = [0.0]

    class Slow(Inwards):
        def step(self, state, measurement):
            clock[0] += 0.15
            return super().step(state, measurement)

    robot = Harness(Slow())
    for k in range(25):
        clock[0] = max(clock[0], 0.1 * k)
        robot.state, reply = robot.link.step(robot.state, clock[0], [robot.seen(0.1 * k)], lambda: clock[0])
        robot.log.add(reply)
    since = [since for since, _, twist in robot.log._commands if twist.any()]
    assert since == pytest.approx([1.15, 2.15], abs=5e-3)
    [(_, episode)] = robot.log.episodes("test")
    np.testing.assert_array_equal(episode.gripper_command.any(axis=(1, 2)), episode.time > 1.15)


def test_a_command_that_took_longer_than_it_holds_is_not_executed():
    robot = Harness()
    robot.run(0.9)
    robot.state, reply = robot.link.step(robot.state, 1.0, [robot.seen(1.0)], lambda: 3.0)
    assert reply.instant.twist.any() and not reply.twist.any()


def test_a_pause_is_one_event_however_old_its_observations():
    robot = Harness()
    robot.run(2.0)
    for k in range(21, 200):
        robot.step(0.1 * k + 1.0 + 0.01 * k, robot.seen(0.1 * k))
    assert robot.state.status == Status.PAUSED and len(robot.log.events) < 8


def test_a_first_time_stamp_that_is_wrong_costs_half_a_second():
    robot = Harness()
    assert robot.step(0.0, robot.seen(9e8)).status == Status.RESTING
    assert robot.run(1.0, begin=0.1).status == Status.RESTING
    assert robot.run(2.0, begin=1.1).status == Status.SHAPING


def test_wrapped_angles_are_continued():
    robot = Harness()
    robot.pose[:, 2] = 3.0
    robot.run(0.5)
    robot.pose[:, 2] = 3.2 - 2 * np.pi
    robot.step(0.6, robot.seen(0.6))
    np.testing.assert_allclose(robot.state.newest.gripper_pose[:, 2], 3.2)


def test_a_missing_pose_is_interpolated_in_the_log():
    robot = Harness()
    robot.run(1.5)
    robot.step(1.6, robot.seen(1.6, gripper_pose=START * np.nan))
    robot.pose = robot.pose + 0.1 * robot.state.command[0]
    robot.run(2.0, begin=1.7)
    [(_, episode)] = robot.log.episodes("test")
    np.testing.assert_allclose(episode.gripper_pose[16], episode.gripper_pose[[15, 17]].mean(axis=0))


class Broken(Inwards):
    def step(self, state, measurement):
        if state == 2:
            raise ValueError("the network is not finite")
        state, twist, info = super().step(state, measurement)
        return state, twist * (np.nan if self.turn and state == 2 else 1.0), info


@pytest.mark.parametrize(("turn", "reason"), [(0.0, "network"), (0.1, "not finite or not of shape")])
def test_a_controller_that_fails_stops_the_grippers(turn, reason):
    robot = Harness(Broken(turn=turn))
    reply = robot.run(5.0)
    assert reply.status == Status.STOPPED and not reply.twist.any() and reason in reply.reason
    assert robot.log.run(TARGET, reply.reason).stopped == reply.reason
    assert robot.run(7.0, begin=5.1).status == Status.STOPPED


def test_a_run_is_done_after_its_commands_or_at_rest():
    reply = Harness(steps=2).run(5.0)
    assert reply.status == Status.DONE and "All 2" in reply.reason
    robot = Harness(Inwards(speed=0.0), patience=2)
    reply = robot.run(8.0)
    assert reply.status == Status.DONE and "settled" in reply.reason and len(robot.log.instants) == 3


@pytest.mark.parametrize(("speed", "ended"), [(0.0, True), (0.005, False)])
def test_noise_does_not_keep_a_run_from_settling(speed, ended):
    rng, robot = np.random.default_rng(0), Harness(Inwards(speed=speed), patience=6)
    moved = np.zeros(2)
    for k in range(200):
        keypoints = KEYPOINTS + moved + 2e-3 * rng.standard_normal(KEYPOINTS.shape)
        reply = robot.step(0.1 * k, robot.seen(0.1 * k, keypoints=keypoints))
        moved = moved + 0.1 * reply.twist[0, [1, 0]]
        if reply.status.ended:
            break
    assert (reply.status == Status.DONE) == ended and k >= 69


@dataclasses.dataclass(frozen=True)
class Watching(Inwards):
    """Keeps what it was given."""

    given: list = dataclasses.field(default_factory=list)

    def init(self, history):
        self.given.append(history)
        return super().init(history)

    def step(self, state, measurement):
        self.given.append(measurement)
        return super().step(state, measurement)


def test_an_end_that_a_gripper_hides_is_where_the_gripper_is():
    watching = Watching()
    robot = Harness(watching)
    for k in range(21):
        seen = robot.seen(0.1 * k)
        seen.keypoints[:2] = seen.keypoints[-1] = np.nan
        robot.step(0.1 * k, seen)
    history, first, second = watching.given
    np.testing.assert_allclose(history.keypoints[-1][[0, -1]], START[:, :2])
    np.testing.assert_allclose(history.keypoints[-1][1], (START[0, :2] + history.keypoints[-1][2]) / 2)
    for measurement in (first, second):
        np.testing.assert_allclose(measurement.keypoints[[0, -1]], START[:, :2])
        assert np.isnan(measurement.keypoints[1]).all()
    [(_, episode)] = robot.log.episodes("test")
    assert np.isnan(episode.keypoints[:, 0]).all(), "the log has what was observed"


def test_a_controller_is_told_what_the_limits_left_of_its_command():
    watching = Watching(speed=0.2)
    Harness(watching).run(2.0)
    _, first, second = watching.given
    assert not first.twist.any()
    np.testing.assert_allclose(second.twist[:, 0], [0.1, -0.1])
    watching = Watching(speed=0.2)
    Harness(watching, limits=None).run(2.0)
    assert watching.given[-1].twist is None


LIMITS = CommandLimits(speed=0.1, turn_rate=0.5, max_distance=1.0, workspace=((-0.6, -0.2), (0.6, 0.2)))


@pytest.mark.parametrize(
    ("twist", "share"),
    [
        ([[0.03, 0, 0.1], [-0.03, 0, 0]], 1.0),
        ([[0.4, 0, 0], [0, 0, 0]], 0.25),
        ([[-0.05, 0, 0], [0.05, 0, 0]], 0.04),  # apart: 0.1 m in 1 s, and 4 mm are left
        ([[0.0, 0.1, 0], [0.0, 0.1, 0]], 1.0),
        ([[0.1, 0, 0], [0.1, 0, 0]], 1.0),  # 0.595 m
    ],
)
def test_a_command_is_shortened_to_its_limits(twist, share):
    pose = np.array([[-0.498, 0.05, 0.0], [0.498, 0.05, 0.0]])
    shortened = LIMITS.shortened(np.array(twist, float), pose, 1.0, 1.0)
    np.testing.assert_allclose(shortened, share * np.array(twist), atol=1e-12)


@pytest.mark.parametrize("length", [0.4, 2.0])
def test_distances_are_in_lengths_of_the_cable(length):
    limits = CommandLimits()
    pose = np.array([[0.0, 0.0, 0.0], [0.9 * length, 0.0, 0.0]])
    apart = np.array([[0.0, 0.0, 0.0], [0.05 * length, 0.0, 0.0]])
    assert limits.shortened(apart, pose, 1.0, length) is apart
    ended = pose + 4.0 * limits.shortened(apart, pose, 4.0, length)
    assert 0.985 * length < ended[1, 0] <= 0.995 * length + 1e-9


def test_a_turn_is_shortened_to_its_rate():
    pose, twist = np.array([[-0.45, 0.05, 0.0], [0.45, 0.05, 0.0]]), np.array([[0, 0, -2.0], [0, 0, 0]])
    np.testing.assert_allclose(LIMITS.shortened(twist, pose, 1.0, 1.0), 0.25 * twist, atol=1e-12)


def test_turned_grippers_may_not_be_as_far_apart():
    """A cable that leaves both at an angle does not reach as far as one that leaves them straight."""
    limits, pose = CommandLimits(), np.array([[0.0, 0.0, 0.0], [0.97, 0.0, 0.0]])
    turning = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    turned = pose + limits.shortened(turning, pose, 1.0, 1.0)
    assert 0.3 < turned[0, 2] < 0.9
    assert limits.shortened(turning, pose + np.array([[0.0, 0.0, 0.0], [-0.2, 0.0, 0.0]]), 1.0, 1.0) is turning


def test_grippers_do_not_pass_through_each_other():
    pose, twist = np.array([[0, 0, 0], [0.11, 0, 0.0]]), np.array([[0.1, 0, 0], [-0.1, 0, 0.0]])
    for of in (np.array, jnp.float32):
        np.testing.assert_allclose(LIMITS.shortened(of(twist), of(pose), 1.2, 1.0), 0.04 * twist, atol=1e-7)


def test_from_outside_only_the_way_back_is_open():
    pose = np.array([[-0.7, 0.0, 0.0], [0.1, 0.0, 0.0]])
    back, out = np.array([[0.05, 0, 0], [0, 0, 0]]), np.array([[-0.05, 0, 0], [0, 0, 0]])
    assert LIMITS.shortened(back, pose, 1.0, 1.0) is back
    assert not LIMITS.shortened(out, pose, 1.0, 1.0).any()


@pytest.mark.parametrize("given", [np.asarray, jnp.asarray])
def test_grippers_outside_that_move_alike_may_move_in_either_precision(given):
    rng = np.random.default_rng(0)
    for _ in range(100):
        turn, place = rng.uniform(-3, 3), rng.uniform(-0.05, 0.05, 2)
        along = np.array([np.cos(turn), np.sin(turn)])
        pose = np.array([[*(place - 0.503 * along), turn], [*(place + 0.503 * along), turn]])
        twist = given(np.tile([*rng.uniform(-0.05, 0.05, 2), 0.0], (2, 1)))
        shortened = CommandLimits().shortened(twist, given(pose), 1.0, 1.0)
        np.testing.assert_array_equal(shortened, twist)


@pytest.mark.parametrize("seed", range(3))
def test_commands_stay_within_all_limits(seed):
    rng, kept = np.random.default_rng(seed), 0
    for _ in range(200):
        pose = np.concatenate([rng.uniform(-0.2, 0.2, (2, 2)), rng.uniform(-3, 3, (2, 1))], axis=1)
        pose[0, 0] -= 0.3
        pose[1, 0] += 0.3
        ended = pose + 1.2 * LIMITS.shortened(rng.normal(size=(2, 3)), pose, 1.2, 1.0)
        middle = (pose + ended) / 2
        for at in (middle, ended):
            assert 0.1 <= np.linalg.norm(at[1, :2] - at[0, :2]) <= 1.0
            assert (np.abs(at[:, :2]) <= [0.6, 0.2]).all()
        inside = 0.11 <= np.linalg.norm(pose[1, :2] - pose[0, :2]) <= 0.99
        if inside and (np.abs(pose[:, :2]) <= [0.59, 0.19]).all():
            slow, along, kept = 1e-3 * rng.normal(size=(2, 3)), pose * [1.0, 1.0, 0.0], kept + 1
            np.testing.assert_array_equal(LIMITS.shortened(slow, along, 1.2, 1.0), slow)
    assert kept > 20


@pytest.mark.parametrize(
    "settings",
    [
        {"interval": 0.0},
        {"watchdog": math.nan},
        {"min_seen": 2.0},
        {"steps": 0},
        {"grace": -1.0},
    ],
)
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match=f"LinkConfig.{next(iter(settings))}"):
        LinkConfig(**settings)


def test_limits_are_checked():
    with pytest.raises(ValueError, match="CommandLimits distances"):
        CommandLimits(min_distance=1.0, max_distance=0.5)
    with pytest.raises(ValueError, match="workspace"):
        CommandLimits(workspace=((1.0, 1.0), (0.0, 0.0)))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"keypoints": 1e3 * KEYPOINTS, "gripper_pose": START * [1e3, 1e3, 1]},
            "990 m apart, but the cable is 1 m long",
        ),
        ({"keypoints": 1e3 * KEYPOINTS}, "of the keypoints are known and within reach"),
        ({"gripper_pose": np.full((2, 3), np.nan)}, "poses are not known"),
    ],
    ids=["millimetres", "keypoints in millimetres", "no poses"],
)
def test_the_link_says_why_it_waits(changes, reason):
    harness = Harness()
    reply = harness.step(0.0, harness.seen(0.0, **changes))
    assert reply.status == Status.WAITING and re.search(reason, reply.reason)
    reply = harness.run(1.5, begin=0.1)
    assert reply.status == Status.SHAPING and reply.reason == ""


class Particular(Inwards):
    """Refuses grippers that are farther apart than its cable is long, as a model's statics do."""

    def init(self, history):
        apart = np.linalg.norm(np.diff(history.gripper_pose[:, :2], axis=0))
        if apart > 1:
            raise ValueError(f"The grippers are {apart:.2f} m apart.")
        return super().init(history)


def test_a_first_pose_that_the_controller_refuses_is_why_it_waits():
    robot = Harness(Particular())
    away = robot.pose.copy()
    robot.pose = 1.5 * away
    assert robot.run(1.0).reason == "The grippers are 1.48 m apart." and robot.state.status == Status.WAITING
    robot.pose = away
    assert robot.run(3.0, begin=1.1).status == Status.SHAPING
    robot.step(3.6)
    robot.pose = 1.5 * away
    reply = robot.run(4.7, begin=3.7)
    assert reply.status == Status.PAUSED and reply.reason == "The grippers are 1.48 m apart." and not reply.twist.any()
    robot.pose = away
    assert robot.run(6.5, begin=4.8).status == Status.SHAPING


def test_seldom_observations_and_other_shapes_are_why_it_waits():
    harness = Harness()
    harness.step(0.0, harness.seen(0.0))
    reply = harness.step(0.8)
    assert reply.status == Status.WAITING and "0.80 s, expected one every 0.5 s" in reply.reason
    reply = harness.step(0.9, harness.seen(0.9, keypoints=KEYPOINTS[:5]))
    assert reply.status == Status.WAITING and "(5, 2)" in reply.reason


def test_a_clock_that_was_set_back_is_reported():
    harness = Harness()
    harness.run(503.0, begin=500.0)
    reply = harness.step(504.0)
    assert reply.status == Status.PAUSED
    reply = harness.step(504.1, harness.seen(4.1))
    assert reply.status == Status.PAUSED and "was the clock set back? Then start the run again." in reply.reason


@dataclasses.dataclass(frozen=True)
class Turning(Inwards):
    """Outwards and to one side, faster and faster."""

    def step(self, state, measurement):
        speed = self.speed * (1 + state)
        return state + 1, np.array([[-speed, speed, 0.0], [speed, speed, 0.0]]), None


@pytest.mark.parametrize("late", [0.0, 0.05, 0.1, 0.19, 0.4])
def test_limits_hold_however_late_commands_begin(late):
    """A gripper goes on with the last command until the next one has come, or `until`."""
    limits = CommandLimits(workspace=((-2.0, -0.5), (2.0, 0.1)))
    robot, queue, twist, until = Harness(Turning(speed=0.002), limits=limits), [], np.zeros((2, 3)), np.inf
    robot.pose = robot.pose * [0.96, 1.0, 1.0]
    for k in range(2000):
        now = 0.01 * k
        if k % 10 == 0:
            reply = robot.step(now, robot.seen(now))
            queue.append((now + late, reply.twist, reply.until))
        while queue and queue[0][0] <= now + 1e-9:
            _, twist, until = queue.pop(0)
        robot.pose = robot.pose + 0.01 * (twist if now < until - 1e-9 else 0.0)
        assert np.linalg.norm(robot.pose[1, :2] - robot.pose[0, :2]) <= limits.max_distance + 1e-9
        assert (robot.pose[:, 1] <= 0.1 + 1e-9).all()
    assert robot.log.counts["limited"] > 0


def test_limits_that_leave_no_motion_are_reported():
    harness = Harness(limits=CommandLimits(workspace=((0.6, 0.6), (0.9, 0.9))))
    reply = harness.run(3.0)
    assert reply.status == Status.SHAPING and not reply.twist.any() and "to zero" in reply.reason


def test_nothing_recorded_is_no_log():
    with pytest.raises(GapLogError, match="at least one episode"):
        RunLog().gap_log(TARGET, CABLE, "test")


def test_a_slow_tracker_whose_clock_jitters_makes_one_episode():
    harness = Harness(watchdog=3.0, steps=30)
    jitter = 2e-3 * np.random.default_rng(0).standard_normal(12)
    for k in range(12):
        time = k + jitter[k]
        harness.step(time, harness.seen(time))
    log = harness.log.gap_log(TARGET, CABLE, "test")
    assert log.episode_length.tolist() == [12]
