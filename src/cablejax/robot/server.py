"""Serves a controller to a robot over TCP: a JSON object on each line, in both directions."""

from __future__ import annotations

import contextlib
import json
import math
import pathlib
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from cablejax.control.link_state import Reply, Status
from cablejax.limits import require
from cablejax.robot.session import RobotRun
from cablejax.simulate.table_plant import Observation
from cablejax.text_file import parse_json

LONGEST_LINE = 2**20
"""Bytes of one message; a longer line ends the run."""
TICK = 0.05
"""Time between two looks of the watchdog while nothing comes [s]."""


def serve(
    run: RobotRun,
    *,
    host: str = "127.0.0.1",
    port: int = 5555,
    simulated_clock: bool = False,
    ready: Callable[[int], None] = lambda port: None,
) -> pathlib.Path:
    """Waits for one robot, answers it until it leaves or the run ends, and writes the log.

    Every batch of lines that has come is answered by one line, see `reply_line`; while nothing comes, the watchdog's
    pause is sent unasked. There is no authentication: keep to the loopback address or a network of the robot's own.

    Args:
        run: the run, compiled.
        host: address to listen at.
        port: 0 for any free one.
        simulated_clock: time passes only by lines {"now": seconds}, each of which is answered; else it is real.
        ready: called with the port once robots can connect.

    Returns:
        The path of the log, which is also written after Ctrl-C, SIGTERM and errors.

    Raises:
        OSError: the address is taken.
        GapLogError: nothing usable was observed.
        ValueError: the robot sent a line that is too long.
    """

    def drive() -> None:
        with socket.create_server((host, port)) as listening:
            ready(listening.getsockname()[1])
            connection, _ = listening.accept()
        # a robot that has gone, or does not read what is sent, stops by itself
        with connection, contextlib.suppress(ConnectionError, TimeoutError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.settimeout(None if simulated_clock else TICK)
            _converse(run, connection, simulated_clock)

    return run.recorded(drive)


def _converse(run: RobotRun, connection: socket.socket, simulated_clock: bool) -> None:
    """Answers until the robot leaves or the run ends."""
    waiting, refused, sent = [], [], (-math.inf, Status.WAITING)
    for lines in _lines(connection):
        # the robot's simulated clock stands among its lines, ours at their end
        for line in lines if simulated_clock else [*lines, None]:
            try:
                message = time.monotonic() if line is None else _message(line, simulated_clock)
            except ValueError as error:
                refused.append(str(error))
                continue
            if isinstance(message, Observation):
                waiting.append(message)
                continue
            reply = run.exchange(message, waiting, None if simulated_clock else time.monotonic)
            if lines or (reply.since, reply.status) != sent:
                connection.sendall(reply_line(reply, refused))
            run.log.refuse(refused)
            waiting, refused, sent = [], [], (reply.since, reply.status)
            if reply.status.ended:
                return


def _lines(connection: socket.socket) -> Iterator[list[bytes]]:
    """Complete lines as they come, none of them at each tick; ends when the robot has left.

    Raises:
        ValueError: a line is too long.
    """
    rest = b""
    while True:
        try:
            received = connection.recv(2**16)
        except TimeoutError:
            yield []
            continue
        if not received:
            return
        *lines, rest = (rest + received).split(b"\n")
        if len(rest) > LONGEST_LINE:
            raise ValueError(f"The robot sent a line longer than {LONGEST_LINE} bytes: expected one message on each.")
        yield lines


def _message(line: bytes, simulated_clock: bool) -> Observation | float:
    """An observation, or the time; raises ValueError."""
    try:
        content: Any = parse_json(line)
    except ValueError as error:
        raise ValueError(f"A message {error}") from error
    if simulated_clock and isinstance(content, dict) and set(content) == {"now"}:
        require(content["now"], "stamp", '"now"')
        return float(content["now"])
    if not isinstance(content, dict) or not {"time", "keypoints", "gripper_pose"} <= set(content):
        raise ValueError('A message is not an object with "time", "keypoints" and "gripper_pose".')
    require(content["time"], "stamp", '"time"', "Is it in seconds?")
    try:
        keypoints, pose = (
            np.array([[np.nan] * width if row is None else [_number(v) for v in row] for row in content[name]], float)
            for name, width in (("keypoints", 2), ("gripper_pose", 3))
        )
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            'Expected "keypoints" as rows [x, y] and "gripper_pose" as rows [x, y, theta], null where unknown.'
        ) from None
    return Observation(keypoints, pose, float(content["time"]))


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError("no number")
    return float(value)


def reply_line(reply: Reply, refused: Sequence[str] = ()) -> bytes:
    """A reply as the robot receives it: "twist", "since", "until", "status", "reason" and "refused".

    "since" and "until" are time stamps of the robot's clock, null for at once and for good.
    """
    message = {
        "twist": reply.twist.tolist(),
        "since": reply.since if math.isfinite(reply.since) else None,
        "until": reply.until if math.isfinite(reply.until) else None,
        "status": reply.status,
        "reason": reply.reason or (refused[-1] if refused and reply.status == Status.WAITING else ""),
        "refused": [*refused, *reply.refused],
    }
    return json.dumps(message, allow_nan=False).encode() + b"\n"
