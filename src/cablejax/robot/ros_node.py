"""A ROS 2 node around a run on a robot; needs rclpy, which comes with ROS and not from PyPI."""

from __future__ import annotations

import collections
import math
import pathlib
from typing import Any

import numpy as np

from cablejax.robot.session import RobotRun
from cablejax.simulate.table_plant import Observation

RATE_HZ = 20.0
"""Rate at which the watchdog looks and the command is published."""

_UNKNOWN, _STILL = np.full((2, 3), np.nan), np.zeros((2, 3))
_KEPT = 500
"""Messages of the grippers that wait and are looked through: half a second at the rate of an arm's controller, longer
than a command takes to compute."""


def spin(run: RobotRun, *, name: str = "cablejax", frame: str = "world") -> pathlib.Path:
    """Starts rclpy, spins a node until the run has ended, and writes the log.

    The node subscribes to `~/keypoints` (geometry_msgs/PoseArray, the positions of all N in their order, NaN where not
    observed) and `~/grippers` (geometry_msgs/PoseArray, both poses; the rotation about z is theta). Each message with
    keypoints is one observation, with its own time stamp and the poses nearest to it, if they are less than one tick
    older or newer; it waits a tick for them, since topics come in any order. It publishes `~/gripper_0/twist` and
    `~/gripper_1/twist` (geometry_msgs/TwistStamped) at 20 Hz, zero when a command has ended and at last, also after
    Ctrl-C, SIGTERM and errors, and `~/status` (std_msgs/String). The controller computes between two ticks, so arms
    need a timeout of their own.

    Args:
        run: the run.
        name: of the node.
        frame: of all messages; others are refused.

    Returns:
        The path of the log, which is also written after Ctrl-C, SIGTERM and errors.

    Raises:
        GapLogError: nothing usable was observed.
    """
    import rclpy  # pyright: ignore[reportMissingImports]
    from rclpy.signals import SignalHandlerOptions  # pyright: ignore[reportMissingImports]

    def drive() -> None:
        # rclpy's own handler of Ctrl-C shuts the publishers down before the arms could be stopped
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        try:
            node = _make_node(run, name, frame)
            try:
                rclpy.spin(node)
            except _Ended:
                pass
            finally:
                node.publish(_STILL)
                node.destroy_node()
        finally:
            rclpy.shutdown()

    return run.recorded(drive)


class _Ended(Exception):
    """The run has ended, which an executor does not look for."""


def _make_node(run: RobotRun, name: str, frame: str) -> Any:
    """See `spin`."""
    from geometry_msgs.msg import PoseArray, TwistStamped  # pyright: ignore[reportMissingImports]
    from rclpy.node import Node  # pyright: ignore[reportMissingImports]
    from std_msgs.msg import String  # pyright: ignore[reportMissingImports]

    class ShapeCable(Node):
        """See `spin`."""

        def __init__(self):
            super().__init__(name)
            self._new: list[tuple[float, np.ndarray]] = []
            self._waiting: list[tuple[float, np.ndarray]] = []
            self._grippers = collections.deque([(-math.inf, _UNKNOWN)], maxlen=_KEPT)
            self._twists = [self.create_publisher(TwistStamped, f"~/gripper_{q}/twist", 1) for q in (0, 1)]
            self._status = self.create_publisher(String, "~/status", 1)
            self.create_subscription(PoseArray, "~/keypoints", self.on_keypoints, 10)
            self.create_subscription(PoseArray, "~/grippers", self.on_grippers, _KEPT)
            self.create_timer(1.0 / RATE_HZ, self.on_timer)

        def on_grippers(self, message: Any) -> None:
            if self._in_frame(message):
                self._grippers.append((_stamp(message), np.array([_planar(pose) for pose in message.poses])))

        def on_keypoints(self, message: Any) -> None:
            if self._in_frame(message):
                keypoints = np.array([[pose.position.x, pose.position.y] for pose in message.poses])
                self._new.append((_stamp(message), keypoints))

        def _observations(self) -> list[Observation]:
            """In their order, up to the first that came in this tick and whose poses may still come."""
            ready, stamps = self._waiting, [stamp for stamp, _ in self._grippers]
            while self._new and self._new[0][0] in stamps:
                ready.append(self._new.pop(0))
            self._waiting, self._new = self._new, []
            observations = []
            for stamp, keypoints in ready:
                measured, pose = min(self._grippers, key=lambda one: abs(one[0] - stamp))
                near = abs(measured - stamp) <= 1.0 / RATE_HZ
                observations.append(Observation(keypoints, pose if near else _UNKNOWN, stamp))
            return observations

        def _in_frame(self, message: Any) -> bool:
            if message.header.frame_id != frame:
                self.get_logger().warning(f"Poses in frame {message.header.frame_id!r}, expected {frame!r}.")
            return message.header.frame_id == frame

        def on_timer(self) -> None:
            reply = run.exchange(self._seconds(), self._observations(), self._seconds)
            self.publish(reply.twist)
            self._status.publish(String(data=f"{reply.status}: {reply.reason}" if reply.reason else str(reply.status)))
            for reason in reply.refused:
                self.get_logger().warning(reason)
            if reply.status.ended:
                raise _Ended

        def _seconds(self) -> float:
            return 1e-9 * self.get_clock().now().nanoseconds

        def publish(self, twist: np.ndarray) -> None:
            """Commands both grippers."""
            now = self.get_clock().now().to_msg()
            for publisher, (vx, vy, omega) in zip(self._twists, twist.tolist(), strict=True):
                message = TwistStamped()
                message.header.stamp, message.header.frame_id = now, frame
                message.twist.linear.x, message.twist.linear.y, message.twist.angular.z = vx, vy, omega
                publisher.publish(message)

    return ShapeCable()


def _stamp(message: Any) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def _planar(pose: Any) -> tuple[float, float, float]:
    q = pose.orientation
    theta = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
    return pose.position.x, pose.position.y, theta
