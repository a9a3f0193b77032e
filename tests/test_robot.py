"""A robot over TCP and over ROS 2: the server in this process, the robot in a thread or a process of its own."""

import dataclasses
import functools
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import threading
import time
import types

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))

import robot_soak

from cablejax.control.link import RobotLink
from cablejax.control.link_state import LinkConfig
from cablejax.control.targets import straight_start
from cablejax.gaplog import GapLogError, read_gap_log
from cablejax.robot import server
from cablejax.robot.ros_node import spin
from cablejax.robot.session import RobotRun
from cablejax.simulate.elastica import elastica
from cablejax.simulate.table_plant import Observation
from test_control_link import CABLE, START, TARGET, Harness, Inwards


def run_to(path, **settings):
    return RobotRun(RobotLink(Inwards(), TARGET, LinkConfig(**settings)), CABLE, path)


class Client:
    """Serves a run in a thread and talks to it."""

    def __init__(self, run, **settings):
        ports: list[int] = []
        self.ended: list = []
        self.thread = threading.Thread(target=self._serve, args=(run, ports, settings))
        self.thread.start()
        while not ports and self.thread.is_alive():
            time.sleep(0.005)
        self.socket = socket.create_connection(("127.0.0.1", ports[0]), timeout=10)
        self.lines = self.socket.makefile("rb")

    def _serve(self, run, ports, settings):
        try:
            self.ended.append(server.serve(run, port=0, ready=ports.append, **settings))
        except Exception as error:
            self.ended.append(error)

    def say(self, *lines: bytes):
        self.socket.sendall(b"".join(lines))

    def answer(self) -> dict:
        return json.loads(self.lines.readline())

    def leave(self):
        self.lines.close()
        self.socket.close()
        self.thread.join(timeout=20)
        return self.ended[0]


def now(seconds: float) -> bytes:
    return json.dumps({"now": seconds}).encode() + b"\n"


def test_a_short_soak_over_a_bad_connection(tmp_path):
    """The soak of `benchmarks/robot_soak.py` for 50 seconds, with grippers that drive to and fro."""
    soak = robot_soak.Soak(steps=500, links=12, seed=3, outage_every=10.0)
    tour = robot_soak.Tour((Inwards(0.02, 0.01), Inwards(-0.02, -0.01)), commands=8)
    record = robot_soak.soak_once(soak, tour, CABLE, tmp_path / "log.npz")
    assert all(record["sent"][fault] > 0 for fault in ("dropped", "late", "nan", "doubled"))
    assert record["missed"] == record["outside"] == record["lost_in_log"] == 0
    assert record["commands"] > 25 and record["logged"] > 400
    assert record["counts"]["refused"] == record["sent"]["without a time stamp"]
    robot_soak.draw(record, tmp_path / "soak.png")
    page = robot_soak.page(soak, record, "a test", "soak.png", "a command")
    assert "| missed watchdogs | 0 |" in page and (tmp_path / "soak.png").stat().st_size > 1000


@dataclasses.dataclass(frozen=True)
class Sideways(Inwards):
    """Moves the whole cable to one side."""

    def step(self, state, measurement):
        return state, np.array([[0.0, self.speed, 0.0]] * 2), None


@pytest.mark.slow
def test_the_referee_of_the_soak_sees_what_goes_wrong(tmp_path, monkeypatch):
    """A link without a watchdog, limits, or a log of late observations fails the soak."""
    soak = robot_soak.Soak(steps=250, links=12, seed=3, outage_every=10.0)
    broken = dataclasses.replace(robot_soak.LINK, watchdog=30.0, grace=30.0, limits=None)
    add = robot_soak.RobotRun.exchange

    def forgetful(self, at, observations=(), clock=None):
        newest = self._state.newest
        return add(self, at, [o for o in observations if newest is None or o.time > newest.time], clock)

    monkeypatch.setattr(robot_soak.RobotRun, "exchange", forgetful)
    monkeypatch.setattr(robot_soak, "RobotLink", lambda controller, target, _: RobotLink(controller, target, broken))
    tour = robot_soak.Tour((Sideways(0.11), Sideways(-0.11)), commands=3)
    record = robot_soak.soak_once(soak, tour, CABLE, tmp_path / "log.npz")
    assert record["missed"] > 0 and record["outside"] > 50 and record["lost_in_log"] > 3


def test_in_real_time_the_pause_comes_unasked(tmp_path):
    robot, harness = Client(run_to(tmp_path / "log.npz", rest=0.0)), Harness()
    for k in range(6):
        robot.say(robot_soak.observation_line(harness.seen(5.0 + 0.05 * k)))
        reply = robot.answer()
        time.sleep(0.05)
    assert reply["status"] == "shaping" and np.abs(reply["twist"]).max() == 0.01
    began = time.monotonic()
    while (reply := robot.answer())["status"] == "shaping":
        pass
    assert reply["status"] == "paused" and 0.3 < time.monotonic() - began < 10.0
    assert robot.leave() == tmp_path / "log.npz"
    assert read_gap_log(tmp_path / "log.npz").episode_length.tolist() == [6]


NOISE = [
    b"nonsense\n",
    b"[1, 2]\n",
    b'{"time": 0.5}\n',
    b'{"time": "now", "keypoints": [], "gripper_pose": []}\n',
    b'{"time": 0.5, "keypoints": [[0, 0], [1]], "gripper_pose": null}\n',
    b'{"time": 0.5, "keypoints": {"a": 1}, "gripper_pose": [1' + b"0" * 400 + b"]}\n",
    b"[" * 5000 + b"\n",
    b"\xff\xfe\n",
    b'{"time": 0.5, "keypoints": [[0, 0]], "gripper_pose": [[0, 0, 0], [0, 0, 0]]}\n',
]


def test_a_log_of_a_robot_that_came_late_is_plain_json(tmp_path):
    run = run_to(tmp_path / "log.npz")
    run.exchange(0.0)
    for k in range(30):
        run.exchange(0.1 + 0.1 * k, [Harness().seen(0.1 * k)])
    events = read_gap_log(run.finish()).meta["robot_link"]["events"]
    assert events[0] == [None, "waiting", ""] and events[1][:2] == [0.0, "resting"]
    json.dumps(events, allow_nan=False)


def test_a_robot_that_waits_for_what_was_refused_says_so(tmp_path):
    robot = Client(run_to(tmp_path / "log.npz"), simulated_clock=True)
    robot.say(NOISE[2], now(0.0))
    reply = robot.answer()
    assert (
        reply["status"] == "waiting"
        and reply["reason"] == reply["refused"][0]
        and "not an object with" in reply["reason"]
    )
    robot.say(robot_soak.observation_line(Harness().seen(0.1)), now(0.1))
    assert robot.answer()["reason"] == ""
    robot.leave()


@pytest.mark.parametrize("simulated", [True, False])
def test_messages_that_are_none_are_answered_and_counted(tmp_path, simulated):
    robot, harness = Client(run_to(tmp_path / "log.npz"), simulated_clock=simulated), Harness()
    robot.say(robot_soak.observation_line(harness.seen(0.0)), now(0.0) if simulated else b"")
    assert robot.answer()["status"] == "resting"
    refused = []
    for line in NOISE:
        robot.say(line, now(0.1) if simulated else b"")
        while not (reply := robot.answer())["refused"]:
            pass
        refused += reply["refused"]
    assert len(refused) == len(NOISE) and any(words.startswith("A message is no JSON") for words in refused)
    if not simulated:  # a clock of its own is not to be set
        robot.say(now(1e9))
        assert "not an object with" in robot.answer()["refused"][0]
    robot.leave()
    log = read_gap_log(tmp_path / "log.npz")
    assert log.meta["robot_link"]["counts"]["refused"] == len(NOISE) + (not simulated)


def test_half_lines_wait_for_their_end(tmp_path):
    robot, harness = Client(run_to(tmp_path / "log.npz"), simulated_clock=True), Harness()
    line = robot_soak.observation_line(harness.seen(0.0)) + now(0.0)
    for byte in range(0, len(line), 100):
        robot.say(line[byte : byte + 100])
        time.sleep(0.001)
    assert robot.answer()["status"] == "resting"
    assert robot.leave() == tmp_path / "log.npz"


def test_lines_of_a_simulated_clock_count_in_their_order(tmp_path):
    """A client that does not wait for replies says everything at once."""
    robot, harness = Client(run_to(tmp_path / "log.npz"), simulated_clock=True), Harness()
    times = [0.1 * k for k in range(15)]
    robot.say(b"".join(robot_soak.observation_line(harness.seen(t)) + now(t) for t in times))
    assert [robot.answer()["status"] for _ in times][-3:] == ["shaping"] * 3
    assert robot.leave() == tmp_path / "log.npz"


def test_a_line_without_end_ends_the_run_and_keeps_the_log(tmp_path, monkeypatch):
    monkeypatch.setattr(server, "LONGEST_LINE", 10_000)
    robot, harness = Client(run_to(tmp_path / "log.npz"), simulated_clock=True), Harness()
    robot.say(robot_soak.observation_line(harness.seen(0.0)), now(0.0))
    robot.answer()
    robot.say(b"x" * 50_000)
    assert "longer than 10000 bytes" in str(robot.leave())
    assert read_gap_log(tmp_path / "log.npz").episode_length.tolist() == [1]


SERVED = """
import pathlib, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from cablejax.robot import server
from test_robot import run_to
server.serve(run_to(pathlib.Path(sys.argv[1])), port=0, ready=lambda port: print("port", port, flush=True))
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, -signal.SIGINT), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_server_and_keeps_the_log(tmp_path, number, code):
    tests = str(pathlib.Path(__file__).parent)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, tests])}
    process = subprocess.Popen(
        [sys.executable, "-c", SERVED, str(tmp_path / "log.npz")], stdout=subprocess.PIPE, env=environment, text=True
    )
    try:
        # what is imported may print too
        port = next(line.split()[1] for line in process.stdout if line.startswith("port"))
        with socket.create_connection(("127.0.0.1", int(port)), timeout=60) as robot, robot.makefile("rb") as lines:
            harness = Harness()
            for k in range(3):
                robot.sendall(robot_soak.observation_line(harness.seen(0.1 * k)))
                assert json.loads(lines.readline())["status"] == "resting"
            process.send_signal(number)
            process.wait(timeout=60)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    assert process.returncode == code, "the interrupt goes on to whoever started the server"
    assert read_gap_log(tmp_path / "log.npz").episode_length.tolist() == [3]


def test_grippers_that_point_backwards_are_found_before_anything_moves(tmp_path):
    run, harness = run_to(tmp_path / "log.npz"), Harness()
    harness.pose[:, 2] += np.pi
    for k in range(12):
        reply = run.exchange(0.1 * k, [harness.seen(0.1 * k)])
        assert not reply.twist.any()
    assert reply.status == "stopped" and "tangent" in reply.reason
    assert run.result().stopped == reply.reason
    assert not np.nan_to_num(run.result().twist).any(), "a command that was never sent"


ARCH = np.array([[-0.4, 0.0, 0.7], [0.4, 0.0, -0.7]])
BENT = elastica(ARCH, CABLE.length, CABLE.keypoint_arclength)


@pytest.mark.parametrize(
    ("points", "pose", "reason"),
    [
        (BENT, ARCH * [1, 1, 180 / np.pi], "in degrees: expected radians"),
        (BENT, ARCH * [1, 1, np.pi / 180], "it was converted from degrees"),
        (BENT, ARCH * [1, 1, -1], "mirrored. Negate the angle"),
        (BENT, ARCH + np.array([0, 0, np.pi / 2]), "quarter turn"),
        (BENT, ARCH[::-1], "exchange the grippers"),
        (BENT + np.array([0.0, 0.45]), ARCH, "in one frame"),
        (np.random.default_rng(0).permutation(BENT[1:-1]), ARCH, "times as far apart"),
        (0.7 * BENT, ARCH * [0.7, 0.7, 1], "times as far apart"),
    ],
    ids=["degrees", "not degrees", "mirrored", "quarter", "exchanged", "elsewhere", "shuffled", "shrunk"],
)
def test_a_cable_that_the_grippers_do_not_hold_is_not_moved(tmp_path, points, pose, reason):
    run, rng = run_to(tmp_path / "log.npz"), np.random.default_rng(1)
    if len(points) < len(BENT):
        points = np.concatenate([BENT[:1], points, BENT[-1:]])
    for k in range(15):
        seen = Observation(points + 1e-4 * rng.normal(size=points.shape), pose, 0.1 * k)
        reply = run.exchange(0.1 * k, [seen])
        assert not reply.twist.any()
    # an exchange may be put right: it waits for that
    assert reply.status == ("waiting" if "exchange" in reason else "stopped") and reason in reply.reason


def test_a_cable_that_they_hold_is_moved(tmp_path):
    run, rng = run_to(tmp_path / "log.npz"), np.random.default_rng(1)
    for k in range(15):
        reply = run.exchange(0.1 * k, [Observation(BENT + 1e-4 * rng.normal(size=BENT.shape), ARCH, 0.1 * k)])
    assert reply.status == "shaping" and reply.twist.any()


def test_the_path_of_a_log_is_checked_before_the_run(tmp_path):
    with pytest.raises(ValueError, match=r"ends in \.npz"):
        run_to(tmp_path / "log")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError, match="file"):
        run_to(tmp_path / "file" / "log.npz")


def test_a_recording_is_kept_where_its_name_was_taken_or_it_is_no_log(tmp_path):
    run, harness = run_to(tmp_path / "log.npz"), Harness()
    run.exchange(0.0, [harness.seen(0.0)])
    (tmp_path / "log.npz").write_bytes(b"taken")
    assert run.finish() == tmp_path / "log_2.npz"
    run = run_to(tmp_path / "burst.npz")
    for stamp in [*np.arange(0.0, 0.02, 0.001), 0.95]:  # a pause that is unusual for such a rate
        run.exchange(stamp, [harness.seen(stamp)])
    with pytest.raises(GapLogError, match=r"pause.* samples are kept in .*burst\.raw\.npz"):
        run.finish()
    with np.load(tmp_path / "burst.raw.npz") as kept:
        assert kept["keypoints_0"].shape == (21, CABLE.n_keypoints, 2)
    with pytest.raises(GapLogError, match=r"pause.* samples are kept in .*burst_2\.raw\.npz"):
        run.finish()


def test_a_log_is_not_overwritten(tmp_path):
    (tmp_path / "log.npz").write_bytes(b"")
    with pytest.raises(FileExistsError, match="another name"):
        run_to(tmp_path / "log.npz")


BASES = {"float64": (float, 0.0), "string": (str, ""), "int32": (int, 0), "uint32": (int, 0)}
"""Python type and default of ROS's basic types that the node's messages have."""


@functools.cache
def typestore():
    typesys = pytest.importorskip("rosbags.typesys")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


@functools.cache
def message_type(name: str) -> type:
    """A message class of ROS 2 Humble from its definition, as strict as those that rosidl generates.

    Its fields have defaults and are given by keyword; a field of another name or type is an error.
    """
    fields = dict(typestore().fielddefs[name][1])

    def default(kind, of):
        if kind.name == "BASE":
            return BASES[of[0]][1]
        return [] if kind.name == "SEQUENCE" else message_type(of)()

    def expected(kind, of):
        return BASES[of[0]][0] if kind.name == "BASE" else message_type(of)

    class Message:
        __slots__ = tuple(fields)

        def __init__(self, **given):
            assert set(given) <= set(fields), f"{name} has no field {set(given) - set(fields)}"
            for field, definition in fields.items():
                setattr(self, field, given[field] if field in given else default(*definition))

        def __setattr__(self, field, value):
            if field not in fields:
                raise AttributeError(f"{name} has no field {field!r}")
            kind, of = fields[field]
            values, wanted = (value, expected(*of[0])) if kind.name == "SEQUENCE" else ([value], expected(kind, of))
            assert all(isinstance(one, wanted) for one in values), f"{name}.{field} is {value!r}, expected {wanted}"
            object.__setattr__(self, field, value)

    Message.__name__ = name
    return Message


def sent(message, name):
    """What a subscriber gets: the message through the middleware's encoding and back."""
    store = typestore()

    def stored(value):
        if isinstance(value, list):
            return [stored(one) for one in value]
        if not hasattr(value, "__slots__"):
            return value
        return store.types[type(value).__name__](**{field: stored(getattr(value, field)) for field in value.__slots__})

    return store.deserialize_cdr(store.serialize_cdr(stored(message), name), name)


class Node:
    """Stands in for `rclpy.node.Node`: topics are lists of what is received, and time is set by hand."""

    usable = False
    """Between `rclpy.init` and `rclpy.shutdown`."""

    def __init__(self, name):
        assert Node.usable
        self.name, self.topics, self.callbacks, self.timers, self.now, self.warnings = name, {}, {}, [], 0.0, []

    def create_publisher(self, kind, topic, depth):
        received = self.topics.setdefault(topic, [])

        def publish(message):
            assert type(message) is kind and Node.usable
            received.append(sent(message, kind.__name__))

        return types.SimpleNamespace(publish=publish)

    def create_subscription(self, kind, topic, callback, depth):
        self.callbacks[topic] = lambda message: callback(sent(message, kind.__name__))

    def create_timer(self, period, callback):
        self.timers.append((period, callback))

    def get_clock(self):
        stamp = types.SimpleNamespace(nanoseconds=round(1e9 * self.now), to_msg=lambda: time_of(self.now))
        return types.SimpleNamespace(now=lambda: stamp)

    def get_logger(self):
        return types.SimpleNamespace(warning=self.warnings.append)

    def destroy_node(self):
        self.timers.clear()

    def sent(self):
        """The twists received last."""
        twists = [self.topics[f"~/gripper_{q}/twist"][-1].twist for q in (0, 1)]
        return np.array([[t.linear.x, t.linear.y, t.angular.z] for t in twists])


@pytest.fixture
def ros(monkeypatch):
    """The stub of rclpy, whose `spin` a test replaces by what happens to the node."""

    def init(signal_handler_options):
        assert signal_handler_options == "none", "its handler of Ctrl-C shuts publishers down at once"
        Node.usable = True

    for name, contents in {
        "rclpy": {"init": init, "shutdown": lambda: setattr(Node, "usable", False)},
        "rclpy.signals": {"SignalHandlerOptions": types.SimpleNamespace(NO="none")},
        "rclpy.node": {"Node": Node},
        "geometry_msgs": {},
        "geometry_msgs.msg": {
            name: message_type(f"geometry_msgs/msg/{name}") for name in ("PoseArray", "TwistStamped")
        },
        "std_msgs": {},
        "std_msgs.msg": {"String": message_type("std_msgs/msg/String")},
    }.items():
        module = types.ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    return sys.modules["rclpy"]


def time_of(seconds):
    whole, rest = divmod(round(1e9 * seconds), 10**9)
    return message_type("builtin_interfaces/msg/Time")(sec=whole, nanosec=rest)


def pose_array(stamp, places, angles=None, frame="world"):
    point, quaternion, pose, array = (
        message_type(f"geometry_msgs/msg/{name}") for name in ("Point", "Quaternion", "Pose", "PoseArray")
    )
    angles = np.zeros(len(places)) if angles is None else angles
    poses = [
        pose(position=point(x=x, y=y), orientation=quaternion(w=np.cos(a / 2), z=np.sin(a / 2)))
        for (x, y), a in zip(np.asarray(places, float), angles, strict=True)
    ]
    return array(header=message_type("std_msgs/msg/Header")(frame_id=frame, stamp=time_of(stamp)), poses=poses)


def test_the_messages_are_as_strict_as_rosidls(ros):
    from geometry_msgs.msg import TwistStamped

    message = TwistStamped()
    for change in (
        lambda: setattr(message, "twists", None),
        lambda: setattr(message.twist.linear, "x", 1),
        lambda: setattr(message.header, "stamp", 1.5),
        lambda: TwistStamped(1.0),
        lambda: TwistStamped(frame="world"),
    ):
        with pytest.raises((AttributeError, AssertionError, TypeError)):
            change()
    message.twist.linear.x = np.float64(0.5)
    assert sent(message, "geometry_msgs/msg/TwistStamped").twist.linear.x == 0.5


def test_a_ros_node_drives_the_same_run(tmp_path, ros):
    run, harness = run_to(tmp_path / "log.npz", steps=2), Harness()
    nodes = []

    def two_commands(node):
        nodes.append(node)
        [(period, timer)] = node.timers
        assert period == 0.05
        for k in range(200):
            node.now = 1.7e9 + 0.05 * k
            if k % 2 == 0:
                seen = harness.seen(node.now)
                node.callbacks["~/grippers"](pose_array(node.now, seen.gripper_pose[:, :2], seen.gripper_pose[:, 2]))
                node.callbacks["~/keypoints"](pose_array(node.now, seen.keypoints))
            timer()
            harness.pose = harness.pose + 0.05 * node.sent()

    ros.spin = two_commands
    log = read_gap_log(spin(run))
    [node] = nodes
    last = node.topics["~/gripper_0/twist"][-1].header
    assert last.frame_id == "world" and last.stamp.sec + 1e-9 * last.stamp.nanosec == pytest.approx(node.now)
    statuses = list(dict.fromkeys(message.data for message in node.topics["~/status"]))
    assert statuses == ["resting", "shaping", "done: All 2 commands were sent."] and not node.warnings
    np.testing.assert_allclose(harness.pose[:, 0] - START[:, 0], [0.02, -0.02], atol=2e-3)
    assert log.episode_length.tolist() == [31] and run.result().stopped is None
    np.testing.assert_allclose(log.gripper_pose[0, 0], straight_start(CABLE), atol=1e-6)
    assert not Node.usable and not node.timers and not node.sent().any()


class Failing(Inwards):
    def step(self, state, measurement):
        if state == 1:
            raise RuntimeError("out of memory")
        return super().step(state, measurement)


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, RuntimeError])
def test_a_ros_node_that_is_interrupted_stops_the_arms_and_keeps_the_log(tmp_path, ros, error):
    run = RobotRun(RobotLink(Failing(), TARGET, LinkConfig()), CABLE, tmp_path / "log.npz")
    harness, nodes, before = Harness(), [], []

    def interrupted(node):
        nodes.append(node)
        for k in range(60):
            node.now = 100.0 + 0.05 * k
            seen = harness.seen(node.now)
            node.callbacks["~/grippers"](pose_array(node.now, seen.gripper_pose[:, :2], seen.gripper_pose[:, 2]))
            node.callbacks["~/keypoints"](pose_array(node.now, seen.keypoints))
            if k == 35 and error is KeyboardInterrupt:
                raise KeyboardInterrupt
            if k == 35 and error is SystemExit:
                signal.raise_signal(signal.SIGTERM)
            node.timers[0][1]()
            before[:] = [node.sent()]

    ros.spin = interrupted
    with pytest.raises(error):
        spin(run)
    assert before[0].any() and not nodes[0].sent().any() and not Node.usable
    assert read_gap_log(tmp_path / "log.npz").episode_length[0] > 30


@pytest.mark.parametrize("rate", [10, 30])
def test_a_ros_node_takes_poses_that_come_after_the_keypoints(tmp_path, ros, rate):
    """Those of the same moment, which topics deliver in any order."""
    run, harness = run_to(tmp_path / "log.npz", steps=4), Harness()
    nodes, moved = [], {}
    events = sorted([*((k / rate, 0) for k in range(6 * rate)), *((0.05 * k + 0.001, 1) for k in range(120))])

    def poses_last(node):
        nodes.append(node)
        [(_, timer)] = node.timers
        last, twist = 0.0, np.zeros((2, 3))
        for moment, is_tick in events:
            harness.pose, last, node.now = harness.pose + (moment - last) * twist, moment, 100.0 + moment
            if is_tick:
                timer()
                twist = node.sent()
                continue
            seen = harness.seen(node.now)
            moved[round(node.now, 6)] = harness.pose[0, 0]
            node.callbacks["~/keypoints"](pose_array(node.now, seen.keypoints))
            node.callbacks["~/grippers"](pose_array(node.now, seen.gripper_pose[:, :2], seen.gripper_pose[:, 2]))

    ros.spin = poses_last
    log = read_gap_log(spin(run))
    statuses = [message.data.split(":")[0] for message in nodes[0].topics["~/status"]]
    assert "paused" not in statuses and statuses[-1] == "done"
    stamps = log.meta["robot_link"]["starts_s"][0] + log.time[0]
    expected = [moved[round(stamp, 6)] for stamp in stamps]
    assert len(stamps) > 4 * rate and np.ptp(expected) > 0.02
    np.testing.assert_allclose(log.gripper_pose[0, :, 0, 0], expected, atol=1e-6)


def test_a_ros_node_without_fresh_poses_pauses(tmp_path, ros):
    run, harness = run_to(tmp_path / "log.npz"), Harness()

    def no_poses_after_a_while(node):
        for k in range(60):
            node.now = 100.0 + 0.05 * k
            seen = harness.seen(node.now)
            if k < 30:
                node.callbacks["~/grippers"](pose_array(node.now, seen.gripper_pose[:, :2], seen.gripper_pose[:, 2]))
            node.callbacks["~/grippers"](pose_array(node.now, START[:, :2], frame="camera"))
            node.callbacks["~/keypoints"](pose_array(node.now, seen.keypoints))
            node.timers[0][1]()
        assert node.topics["~/status"][-1].data.startswith("paused")
        assert not node.sent().any()
        assert any("camera" in warning for warning in node.warnings)

    ros.spin = no_poses_after_a_while
    spin(run)
