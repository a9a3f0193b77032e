"""An hour of a robot at 10 Hz over a bad connection: the contact plant in one process, the controller in another.

python benchmarks/robot_soak.py --out docs/results/robot_soak.md
"""

from __future__ import annotations

import argparse
import dataclasses
import heapq
import json
import multiprocessing
import os
import pathlib
import select
import socket
import sys
import tempfile
import time
from typing import Any, get_args

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "experiments"))

import numpy as np

from cablejax.cable import Cable, Discretisation
from cablejax.control.command_limits import CommandLimits
from cablejax.control.controller import Controller
from cablejax.control.link import RobotLink
from cablejax.control.link_state import LinkConfig
from cablejax.control.targets import Shape, make_target, straight_start
from cablejax.effects.given import parse_effect
from cablejax.gaplog import read_gap_log
from cablejax.robot.server import TICK, serve
from cablejax.robot.session import RobotRun
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.simulate.table_plant import Observation

PERIOD = 0.1
FAULTS = {"dropped": 0.05, "late": 0.05, "nan": 0.01, "doubled": 0.01}
"""Shares of the messages."""
OUTAGE = (0.4, 3.0)
"""Shortest and longest time in which nothing comes at all [s]."""
LIMITS = CommandLimits(workspace=((-1.5, -1.5), (1.5, 1.5)))
LINK = LinkConfig(limits=LIMITS)


def observation_line(observation: Observation) -> bytes:
    """An observation as the server receives it: "time", "keypoints" and "gripper_pose", null where unknown."""
    rows = {
        name: [row if np.isfinite(row).all() else None for row in getattr(observation, name).tolist()]
        for name in ("keypoints", "gripper_pose")
    }
    return json.dumps({"time": observation.time, **rows}, allow_nan=False).encode() + b"\n"


@dataclasses.dataclass(frozen=True)
class Soak:
    """What is run.

    Attributes:
        steps: observations at 10 Hz.
        links: of the plant's cable.
        real_time: else the simulated clock runs as fast as both processes can.
        seed: of the faults.
        outage_every: time from outage to outage [s]; without them the watchdog has little to do.
    """

    steps: int = 36_000
    links: int = 24
    real_time: bool = False
    seed: int = 0
    outage_every: float = 300.0


@dataclasses.dataclass(frozen=True)
class Tour:
    """A controller that goes from one target to the next, so that the cable never comes to rest.

    Attributes:
        controllers: one for each target.
        commands: for each target.
        cpu_ms: processor time of every call, of all threads: what a call takes at most where nothing else runs.
    """

    controllers: tuple[Controller, ...]
    commands: int = 40
    cpu_ms: list[float] = dataclasses.field(default_factory=list)

    def init(self, history):
        return 0, self.controllers[0].init(history)

    def step(self, state, measurement):
        count, inner = state
        controller = self.controllers[count // self.commands % len(self.controllers)]
        if count and count % self.commands == 0 and hasattr(inner, "history"):
            inner = controller.init(inner.history)
        began = time.process_time()
        inner, twist, info = controller.step(inner, measurement)
        twist = np.asarray(twist)
        self.cpu_ms.append(1e3 * (time.process_time() - began))
        return (count + 1, inner), twist, info


class Robot:
    """The plant behind a socket, and the referee: it believes nothing but what it has sent and received."""

    def __init__(self, soak: Soak, cable: Cable, port: int):
        discretisation = Discretisation(cable=cable, n_links=soak.links, dimension=3, timestep=0.005)
        effects = (parse_effect("bending_stiffness:ratio=2"),)
        self.plant = Plant(PlantConfig(discretisation=discretisation, effects=effects, keypoint_noise=5e-4))
        self.soak, self.random = soak, np.random.default_rng(soak.seed)
        self.socket = socket.create_connection(("127.0.0.1", port))
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.unread = b""
        self.reply: dict[str, Any] = {"twist": np.zeros((2, 3)).tolist(), "until": None, "status": "waiting"}
        self.on_the_way: list[tuple[float, int, bytes, tuple | None]] = []
        self.delivered: list[tuple] = []
        self.sent = dict.fromkeys([*FAULTS, "without a time stamp", "in outages"], 0)
        self.calls, self.ages, self.statuses, self.distances = [], [], [], []
        self.missed, self.outside, self.newest = 0, 0, -np.inf
        self.silent_until = 0.0

    def run(self) -> dict[str, Any]:
        """All steps; the record that the page is made of."""
        observation = self.plant.reset(straight_start(self.plant.config.cable))
        began = time.monotonic()
        for step in range(self.soak.steps):
            now = PERIOD * step
            if step % 1000 == 0:
                print(
                    f"{step} of {self.soak.steps} steps, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True
                )
            self.send(observation, now, step)
            self.exchange(now, began)
            twist = self.judged(now)
            [observation] = self.plant.record(twist, PERIOD, samples=1)
        self.socket.close()
        names = ("sent", "calls", "ages", "statuses", "distances", "missed", "outside", "delivered")
        return {name: getattr(self, name) for name in names} | {"wall_s": time.monotonic() - began}

    def send(self, observation: Observation, now: float, step: int) -> None:
        """Puts an observation on its way, with the faults of the connection."""
        if now > 5.0 and step % round(self.soak.outage_every / PERIOD) == 0:
            self.silent_until = now + self.random.uniform(*OUTAGE)
        fate, arrival = self.random.random(4), now
        if now < self.silent_until or fate[0] < FAULTS["dropped"]:
            self.sent["in outages" if now < self.silent_until else "dropped"] += 1
            return
        keypoints, pose, stamp = observation.keypoints.copy(), observation.gripper_pose.copy(), now
        if fate[1] < FAULTS["nan"]:
            self.sent["nan"] += 1
            part = self.random.integers(4)
            if part in (0, 3):
                keypoints[self.random.random(len(keypoints)) < 0.8] = np.nan
            if part in (1, 3):
                pose[self.random.integers(2)] = np.nan
            stamp = np.nan if part == 2 else now
        if fate[2] < FAULTS["late"]:
            self.sent["late"] += 1
            arrival = now + self.random.uniform(0.1, 0.6)
        line = observation_line(Observation(keypoints, pose, stamp)) if np.isfinite(stamp) else b'{"time": null}\n'
        content = (stamp, keypoints, pose) if np.isfinite(stamp) else None
        for copy in range(2 if fate[3] < FAULTS["doubled"] else 1):
            self.sent["doubled"] += copy
            heapq.heappush(self.on_the_way, (arrival + 0.15 * copy, 2 * step + copy, line, content))

    def exchange(self, now: float, began: float) -> None:
        """Delivers what arrives by now, and reads the answers."""
        lines = b""
        while self.on_the_way and self.on_the_way[0][0] <= now + 1e-9:
            *_, line, content = heapq.heappop(self.on_the_way)
            lines += line
            self.sent["without a time stamp"] += content is None
            if content is not None:
                self.delivered.append(content)
                stamp, keypoints, pose = content
                if np.isfinite(keypoints).all(axis=1).mean() >= LINK.min_seen and np.isfinite(pose).all():
                    self.newest = max(self.newest, stamp)
        sent = time.perf_counter()
        if not self.soak.real_time:
            self.socket.sendall(lines + json.dumps({"now": now}).encode() + b"\n")
            self.read(None)
            self.calls.append(1e3 * (time.perf_counter() - sent))
            return
        if lines:
            self.socket.sendall(lines)
        answered = not lines
        while (left := began + now + PERIOD - time.monotonic()) > 0:
            if self.read(left) and not answered:
                self.calls.append(1e3 * (time.perf_counter() - sent))
                answered = True

    def read(self, timeout: float | None) -> bool:
        """Whether a reply has come in time."""
        while b"\n" not in self.unread:
            if not select.select([self.socket], [], [], timeout)[0]:
                return False
            received = self.socket.recv(2**16)
            if not received:
                raise ConnectionError("The server has gone.")
            self.unread += received
        line, _, self.unread = self.unread.partition(b"\n")
        self.reply = json.loads(line)
        return True

    def judged(self, now: float) -> np.ndarray:
        """The twist that the robot executes until the next step; counts what must not be."""
        twist = np.array(self.reply["twist"], float)
        self.statuses.append(self.reply["status"])
        self.ages.append(now - self.newest)
        # in real time the watchdog looks every TICK, and the robot every PERIOD
        patience = LINK.watchdog + (PERIOD + TICK if self.soak.real_time else 1e-6)
        self.missed += bool(now - self.newest > patience and twist.any())
        pose = self.plant.observe().gripper_pose
        distance = float(np.linalg.norm(pose[1, :2] - pose[0, :2]))
        self.distances.append(distance)
        self.outside += bool(
            not np.isfinite(twist).all()
            or (np.linalg.norm(twist[:, :2], axis=1) > LIMITS.speed + 1e-9).any()
            or (np.abs(twist[:, 2]) > LIMITS.turn_rate + 1e-9).any()
            or (twist.any() and not LIMITS.min_distance - 1e-6 <= distance <= LIMITS.max_distance + 1e-6)
            or (np.abs(pose[:, :2]) > 1.5 + 1e-6).any()
        )
        until = self.reply["until"]
        return twist if until is None or now < until else np.zeros_like(twist)


def _robot(soak: Soak, cable: Cable, port, results) -> None:
    try:
        results.put(Robot(soak, cable, port.get()).run())
    except Exception as error:
        results.put({"error": repr(error)})


def lost(record: dict[str, Any], log_path: pathlib.Path) -> tuple[int, int]:
    """Delivered observations that are not in the log as they were sent, and those that are."""
    log = read_gap_log(log_path)
    logged = {}
    for episode, start in enumerate(log.meta["robot_link"]["starts_s"]):
        for sample in range(log.episode_length[episode]):
            stamp = round(float(start + log.time[episode, sample]) / PERIOD)
            logged[stamp] = (log.keypoints[episode, sample], log.gripper_pose[episode, sample])
    missing, first = 0, None
    for stamp, keypoints, pose in record["delivered"]:
        usable = np.isfinite(keypoints).all(axis=1).mean() >= LINK.min_seen and np.isfinite(pose).all()
        first = stamp if first is None and usable else first
        if first is None:
            continue
        seen = logged.get(round(stamp / PERIOD))
        intact = seen is not None and np.array_equal(seen[0], keypoints.astype(np.float32), equal_nan=True)
        if seen is not None and np.isfinite(pose).all():
            intact = intact and np.allclose(seen[1], pose, atol=1e-5)
        missing += not intact
    return missing, len(logged)


def soak_once(soak: Soak, controller: Tour, cable: Cable, log_path: pathlib.Path) -> dict[str, Any]:
    """One run; what it measured."""
    context = multiprocessing.get_context("spawn")
    port, results = context.Queue(), context.Queue()
    process = context.Process(target=_robot, args=(soak, cable, port, results))
    run = RobotRun(RobotLink(controller, make_target("U", cable), LINK), cable, log_path, "robot soak")
    process.start()
    serve(run, port=0, simulated_clock=not soak.real_time, ready=port.put)
    record = results.get(timeout=60)
    process.join()
    if "error" in record:
        raise RuntimeError(record["error"])
    missing, logged = lost(record, log_path)
    calls = np.array(record["calls"])
    controls = np.array([instant.mpc_ms for instant in run.log.instants])
    controls = controls[np.isfinite(controls)]
    pauses = sum(event[1] == "paused" for event in run.log.events)
    return record | {
        "steps": soak.steps,
        "lost_in_log": missing,
        "logged": logged,
        "counts": run.log.counts,
        "pauses": pauses,
        "commands": len(controls),
        "call_ms": {f"p{q}": float(np.percentile(calls, q)) for q in (50, 90, 99, 100)},
        "control_ms": {f"p{q}": float(np.percentile(controls, q)) for q in (50, 90, 99, 100)},
        "cpu_ms": {f"p{q}": float(np.percentile(controller.cpu_ms[1:], q)) for q in (50, 90, 99, 100)},
        "controls": controls,
    }


def draw(record: dict[str, Any], path: pathlib.Path) -> None:
    """Calls, ages of the newest usable observation, and the grippers' distance."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7), layout="constrained")
    times, ages, distance = figure.subplots(3, 1)
    for values, label in ((record["calls"], "all calls"), (record["controls"], "calls of the controller")):
        values = np.sort(values)
        times.plot(values, 100 * np.arange(1, len(values) + 1) / len(values), label=label)
    times.axvline(100, color="0.6", linestyle=":", label="100 ms")
    times.set(xscale="log", xlabel="time of a call [ms]", ylabel="calls up to this [%]")
    times.legend(loc="upper left")
    minutes = PERIOD * np.arange(len(record["ages"])) / 60
    moving = np.array(record["statuses"]) == "shaping"
    age = np.minimum(record["ages"], 3.5)
    ages.plot(minutes[moving], age[moving], ".", markersize=2, label="grippers move")
    ages.plot(minutes[~moving], age[~moving], ".", markersize=3, label="grippers hold")
    ages.axhline(LINK.watchdog, color="0.6", linestyle=":", label="watchdog")
    ages.set(ylabel="age of the newest\nusable observation [s]")
    ages.legend(loc="upper right")
    distance.plot(minutes, record["distances"], linewidth=0.6)
    for bound in (LIMITS.min_distance, LIMITS.max_distance):
        distance.axhline(bound, color="0.6", linestyle=":")
    distance.set(xlabel="time [min]", ylabel="distance of\nthe grippers [m]")
    figure.savefig(path, dpi=110)


def page(soak: Soak, record: dict[str, Any], what: str, image: str, command: str) -> str:
    from pages import markdown_table, page_of_results

    sent, counts, call, control = record["sent"], record["counts"], record["call_ms"], record["control_ms"]
    load = " / ".join(f"{value:.1f}" for value in os.getloadavg())

    clock = "in real time" if soak.real_time else "with a simulated clock"

    def times(of: dict[str, float]) -> str:
        return f"{of['p50']:.1f}; {of['p99']:.1f}; {of['p100']:.1f} ms"

    rows = [
        ["what", "measured"],
        ["messages lost on the way; late; not finite; doubled; in outages",
         f"{sent['dropped']}; {sent['late']}; {sent['nan']}; {sent['doubled']}; {sent['in outages']}"],
        ["messages that reached the link", f"{counts['received']}"],
        ["missed watchdogs", f"{record['missed']}"],
        ["pauses by the watchdog", f"{record['pauses']}"],
        ["commands; shortened by the link's limits; outside of them",
         f"{record['commands']}; {counts['limited']}; {record['outside']}"],
        ["observations lost in the log", f"{record['lost_in_log']} of {record['logged']}"],
        ["messages without a time stamp: delivered; refused",
         f"{sent['without a time stamp']}; {counts['refused']}"],
        ["one call, with the socket: median; 99 %; longest", times(call)],
        ["the controller's calls alone: median; 99 %; longest", times(control)],
        ["processor time of these: median; 99 %; largest", times(record["cpu_ms"])],
        ["wall time", f"{record['wall_s'] / 60:.1f} min"],
    ]  # fmt: skip
    return page_of_results(
        "A robot over a bad connection",
        f"`{command}`",
        [
            f"{soak.steps} observations at 10 Hz, {clock}; {what}.",
            f"The contact plant ({soak.links} links, twice as stiff as the model believes, 0.5 mm noise) is the "
            "robot in another process, over TCP. It counts for itself: what it has sent, how old the newest usable "
            "observation is while the grippers move, and whether a command or a pose is outside of the limits. "
            f"Load of the machine over 1 / 5 / 15 minutes, this program included: {load}.",
            "",
            *markdown_table(rows),
            "",
            f"![Times of calls, ages of observations, distance of the grippers]({image})",
        ],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=Soak.steps)
    parser.add_argument("--real-time", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--weights", default="gns-reference")
    parser.add_argument("--solver", default="two-trials")
    parser.add_argument(
        "--out", type=pathlib.Path, default=None, help="the page; without it, figures go to stdout alone"
    )
    options = parser.parse_args()
    from cablejax.compiled_programs import keep_compiled_programs
    from cablejax.control.shaping import load_model, make_controller

    keep_compiled_programs()
    model = load_model(options.weights)
    targets = [make_target(shape, model.cable) for shape in get_args(Shape)]
    controllers = [make_controller(model, target, method="residual", solver=options.solver) for target in targets]
    what = f"{options.weights} with the residual and the solver {options.solver} commands each second"
    soak = Soak(steps=options.steps, real_time=options.real_time, seed=options.seed)
    with tempfile.TemporaryDirectory() as folder:
        record = soak_once(soak, Tour(tuple(controllers)), model.cable, pathlib.Path(folder) / "soak.npz")
    shown = {
        k: v for k, v in record.items() if k not in ("calls", "ages", "statuses", "distances", "delivered", "controls")
    }
    print(json.dumps(shown, indent=2))
    if options.out is not None:
        image = options.out.with_suffix(".png")
        draw(record, image)
        command = "python " + " ".join([os.path.relpath(sys.argv[0]), *sys.argv[1:]])
        options.out.write_text(page(soak, record, what, image.name, command))


if __name__ == "__main__":
    main()
