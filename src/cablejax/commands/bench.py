"""`cablejax bench simulate | mpc | loop | perception | start`: times the package on this machine."""

from __future__ import annotations

import dataclasses
import functools
import time
from typing import Annotated, get_args

from tyro.conf import subcommand

from cablejax.commands.bench_simulate import BenchSimulate
from cablejax.commands.bench_start import BenchStart
from cablejax.commands.options import Command, SeededCommand, UsageError, require_counts, say, text_table
from cablejax.limits import require
from cablejax.solver_names import SolverName


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchMpc(Command):
    """Time the controller's call (observe, fit the residual, plan, command) with every solver, and in batches.

    Attributes:
        weights: Released model by name, or the folder of a training by `cablejax train`.
        solvers: How plans are found; the first one is also timed in batches.
        horizon: Steps that a plan looks ahead, beyond the next one.
        repeats: Calls to time, after the first one, which compiles.
        batches: Cables to control at once; by default 1 and 16 on a processor, and 1, 64 and 1024 on an accelerator.
    """

    weights: str = "gns-reference"
    solvers: tuple[SolverName, ...] = get_args(SolverName)
    horizon: int = 5
    repeats: int = 60
    batches: tuple[int, ...] = ()

    def execute(self):
        """Times single and batched control calls and returns milliseconds."""
        import jax
        import numpy as np

        from cablejax.commands.workloads import (
            batched_control,
            control_calls,
            controller_to_s,
            cores_as_devices,
            seconds_in_turns,
            seconds_of_calls,
            setting,
        )
        from cablejax.control.shaping import initial_history, load_model

        cores_as_devices()
        require_counts(self, "repeats", "batches")
        require(self.horizon, "count_from_zero", "--horizon")
        if not self.solvers:
            raise UsageError("--solvers is empty, expected at least one solver.")
        on_processor = jax.devices()[0].platform == "cpu"
        batches = self.batches or ((1, 16) if on_processor else (1, 64, 1024))
        model = load_model(self.weights)
        history = initial_history(model.cable, model.config)
        solvers = {}
        for name in self.solvers:
            say(f"compiling the control step with {name} ...")
            call = control_calls(controller_to_s(model, name, self.horizon), history)
            compiling, *calls = seconds_of_calls(call, self.repeats + 1)
            p50, p95 = 1e3 * np.percentile(calls, [50, 95])
            solvers[name] = {"p50_ms": float(p50), "p95_ms": float(p95), "first_call_s": compiling}
        first, batched = controller_to_s(model, self.solvers[0], self.horizon), {}
        for size in map(str, batches):
            say(f"compiling the control step for {size} cables ...")
            call, _ = batched_control(first, history, int(size))
            batched[size] = 1e3 * float(np.median(seconds_in_turns({size: call}, min(self.repeats, 10))[size]))
        result = {
            "solver": self.solvers[0],
            "horizon": first.config.horizon,
            "repeats": self.repeats,
            **solvers[self.solvers[0]],
            "solvers": solvers,
            "batched": {k: {"ms": v, "plans_per_second": 1e3 * int(k) / v} for k, v in batched.items()},
            **setting(),
        }
        rows = [
            [name, f"{s['p50_ms']:.1f}", f"{s['p95_ms']:.1f}", f"{s['first_call_s']:.1f}"]
            for name, s in solvers.items()
        ]
        text = [
            f"one control call, horizon {first.config.horizon}",
            text_table(["solver", "median [ms]", "95th percentile [ms]", "first call, compiled [s]"], rows),
            text_table(
                [f"cables at once, {self.solvers[0]}", "ms", "plans per second"],
                [[k, f"{v:.1f}", f"{1e3 * int(k) / v:.1f}"] for k, v in batched.items()],
            ),
        ]
        return result, "\n\n".join(text)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchPerception(SeededCommand):
    """Time the tracker: one frame of a moving cable, and a first frame without a prior.

    Attributes:
        points: Points in the cloud.
        repeats: Frames to time, after the first ones, which compile.
    """

    points: int = 2000
    repeats: int = 200

    def execute(self):
        """Times frames of the tracker and returns frames per second."""
        import numpy as np

        from cablejax.commands.workloads import clouds_of_an_arch, seconds_of_calls, setting
        from cablejax.perceive import Status, Tracker, TrackerConfig

        require_counts(self, "points", "repeats")
        tracker = Tracker(dataclasses.replace(TrackerConfig(), capacity=self.points))
        clouds, poses = clouds_of_an_arch(self.repeats + 2, self.points, tracker.config.registration.length, self.seed)
        say("compiling the tracker ...")
        state, seen = tracker.init(clouds[0], poses[0])
        first = seconds_of_calls(lambda: tracker.init(clouds[0], poses[0])[1].keypoints.block_until_ready(), 5)
        frame = []
        for cloud, now in zip(clouds, poses, strict=True):
            begin = time.perf_counter()
            state, seen = tracker.step(state, cloud, now)
            seen.keypoints.block_until_ready()
            frame.append(1e3 * (time.perf_counter() - begin))
            if seen.status != Status.TRACKED:
                raise UsageError(
                    f"{self.points} points are too few to follow a cable: {tracker.explain(seen, cloud, now)}"
                )
        p50, p95 = np.percentile(frame[2:], [50, 95])
        result = {
            "points": self.points,
            "keypoints": tracker.config.registration.n_keypoints,
            "repeats": self.repeats,
            "p50_ms": float(p50),
            "p95_ms": float(p95),
            "frames_per_second": float(1e3 / p50),
            "first_frame_ms": 1e3 * float(np.median(first)),
            **setting(),
        }
        return result, (
            f"one frame of {self.points} points: median {p50:.1f} ms, 95th percentile {p95:.1f} ms, "
            f"{1e3 / p50:.0f} frames per second; a first frame without a prior {result['first_frame_ms']:.0f} ms"
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchLoop(Command):
    """Time the closed loop in batches: simulated plant, residual, plan and command of many cables in one call.

    Attributes:
        weights: Released model by name, or the folder of a training by `cablejax train`.
        solver: How the plan is found.
        batches: Numbers of cables to shape at once.
        steps: Control steps per round.
        rounds: How often each batch takes its turn.
    """

    weights: str = "gns-reference"
    solver: SolverName = "levenberg-marquardt"
    batches: tuple[int, ...] = (1, 8)
    steps: int = 5
    rounds: int = 3

    def execute(self):
        """Times the batched closed loop and returns steps per second."""
        import numpy as np

        from cablejax.cable import Discretisation
        from cablejax.commands.workloads import (
            closed_loop,
            controller_to_s,
            cores_as_devices,
            seconds_in_turns,
            setting,
        )
        from cablejax.control.shaping import load_model

        cores_as_devices()
        require_counts(self, "batches", "steps", "rounds")
        if not self.batches:
            raise UsageError("--batches is empty, expected at least one size.")
        model = load_model(self.weights)
        controller = controller_to_s(model, self.solver)
        run = closed_loop(controller, self.steps, Discretisation(model.cable))
        say(f"compiling the closed loop for batches of {', '.join(map(str, self.batches))} ...")
        contestants = {str(size): functools.partial(run, size) for size in self.batches}
        seconds = seconds_in_turns(contestants, self.rounds)
        rates = {size: int(size) * self.steps / float(np.median(seconds[size])) for size in contestants}
        result = {
            "solver": self.solver,
            "horizon": controller.config.horizon,
            "steps": self.steps,
            "control_steps_per_second": rates,
            **setting(),
        }
        rows = [[size, f"{rate:.2f}", f"{1e3 / rate:.1f}"] for size, rate in rates.items()]
        return result, text_table(["cables at once", "control steps per second", "ms per control step"], rows)


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure speed on this machine.

    Attributes:
        what: What is measured.
    """

    what: (
        Annotated[BenchSimulate, subcommand("simulate")]
        | Annotated[BenchMpc, subcommand("mpc")]
        | Annotated[BenchLoop, subcommand("loop")]
        | Annotated[BenchPerception, subcommand("perception")]
        | Annotated[BenchStart, subcommand("start")]
    )
