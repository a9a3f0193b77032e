"""`cablejax bench simulate`: measures speed and accuracy of the simulators, and how fast they fill a store."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from typing import TYPE_CHECKING, Any

from cablejax.commands.cable import find_cable
from cablejax.commands.options import SeededCommand, require_counts, say, text_table
from cablejax.limits import require

if TYPE_CHECKING:
    from cablejax.cable import Cable
    from cablejax.simulate import Engine

PAPER = 2_000_000
"""Transitions that Wang et al., RA-L 2022, train on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchSimulate(SeededCommand):
    """Time the simulators, each at the time step at which it makes data: chain and MJX in a batch, C MuJoCo in threads.

    The engines take turns, and the median of the rounds counts. Accuracy is the distance of the keypoints from a
    simulation at 2 ms, over random motions like those of data sets.

    Attributes:
        batch: Cables that chain and MJX simulate at once; C MuJoCo simulates the same number one by one.
        seconds: Simulated seconds per round.
        rounds: How often each engine takes its turn.
        threads: Threads of C MuJoCo to compare with one.
        trajectories: Motions to compare with finer ones, and to draw, simulate and store with each engine; 0 leaves
            this out.
        steps: Commands of such a motion, one second each.
        links: Links of the cable; by default the package's.
        cable: A cable file, or a data set, weights or a log that holds a cable. By default the reference cable.
    """

    batch: int = 256
    seconds: int = 1
    rounds: int = 5
    threads: int = 2
    trajectories: int = 64
    steps: int = 200
    links: int | None = None
    cable: pathlib.Path | None = None

    def execute(self):
        """Times the engines in turns and returns microseconds, distances and transitions per second."""
        from cablejax.commands.workloads import setting
        from cablejax.simulate import ENGINES

        require_counts(self, "batch", "seconds", "rounds", "threads", "steps")
        require(self.trajectories, "count_from_zero", "--trajectories")
        cable = find_cable(self.cable)
        engines: dict[str, Engine] = {name: kind(self.chain(cable, name)) for name, kind in ENGINES.items()}  # pyright: ignore[reportCallIssue]
        result = {
            "links": engines["chain"].config.n_links,
            "batch": self.batch,
            "threads": self.threads,
            "timestep_s": {name: engine.config.timestep for name, engine in engines.items()},
            **self.speed(engines),
            **setting(),
        }
        text = self.speed_text(result)
        if self.trajectories:
            result |= self.data(cable)
            text += "\n\n" + self.data_text(result)
        return result, text

    def chain(self, cable: Cable, engine: str):
        """The cable's discretisation at the time step of an engine's data."""
        from cablejax.cable import Discretisation
        from cablejax.simulate import ENGINES

        n_links = Discretisation.n_links if self.links is None else self.links
        return Discretisation(cable, n_links=n_links, timestep=ENGINES[engine].data_timestep)

    def speed(self, engines: dict[str, Any]) -> dict[str, Any]:
        """Rollouts of slowly moved arches."""
        import jax
        import numpy as np

        from cablejax.commands.workloads import moving_arches, program_bytes, seconds_in_turns
        from cablejax.simulate import ThreadedEngine
        from cablejax.simulate.engine import compiled_rollout

        chain, mjx, config = engines["chain"], engines["mjx"], engines["threaded"].config
        one, many = ThreadedEngine(config, 1), ThreadedEngine(config, self.threads)
        params, states, twist = moving_arches(config, self.batch, self.seconds, self.seed)
        say(f"compiling the MJX engine for {self.batch} cables of {config.n_links} links ...")
        begin = time.perf_counter()
        compiled = compiled_rollout(mjx, params, 1, 1.0).lower(params, states, twist).compile()
        compile_s = time.perf_counter() - begin
        contestants = {
            "chain": lambda: jax.block_until_ready(chain.rollout(params, states, twist, 1.0)),
            "mjx": lambda: jax.block_until_ready(compiled(params, states, twist)),
            "c_one": lambda: one.rollout(params, states, twist, 1.0),
            "c_many": lambda: many.rollout(params, states, twist, 1.0),
        }
        seconds = seconds_in_turns(contestants, self.rounds)
        micros = {name: 1e6 * float(np.median(values)) / self.batch / self.seconds for name, values in seconds.items()}
        return {
            "us_per_simulated_second": micros,
            "us_per_env_step": {
                name: value / (chain if name == "chain" else mjx).substeps(1.0) for name, value in micros.items()
            },
            "relative_to_c": {name: value / micros["c_one"] for name, value in micros.items()},
            "mjx_memory_per_env_bytes": program_bytes(compiled) / self.batch,
            "mjx_compile_s": compile_s,
        }

    def speed_text(self, result: dict[str, Any]) -> str:
        """The table of `speed`."""
        labels = {
            "chain": ("chain", f"chain, batch {self.batch}"),
            "mjx": ("mjx", f"MJX, batch {self.batch}"),
            "c_one": ("threaded", "C MuJoCo, one core"),
            "c_many": ("threaded", f"C MuJoCo, {self.threads} threads"),
        }
        rows = [
            [
                label,
                f"{1e3 * result['timestep_s'][engine]:g}",
                f"{result['us_per_env_step'][name]:.2f}",
                f"{result['us_per_simulated_second'][name]:.0f}",
                f"{result['relative_to_c'][name]:.3f}",
            ]
            for name, (engine, label) in labels.items()
        ]
        header = ["engine", "time step [ms]", "us per environment-step", "us per simulated second", "relative to C"]
        return (
            f"{text_table(header, rows)}\n\nMJX: {result['mjx_memory_per_env_bytes'] / 1024:.0f} KiB per environment, "
            f"compiled in {result['mjx_compile_s']:.1f} s, on {result['device']}."
        )

    def data(self, cable: Cable) -> dict[str, Any]:
        """Accuracy over random motions, and median times of each part of making a store, once compiled."""
        import numpy as np

        from cablejax.commands.workloads import data_stages, distance_from_fine, seconds_in_turns
        from cablejax.dataset.schema import DatasetConfig
        from cablejax.simulate import ENGINES
        from cablejax.simulate.motions import MotionConfig

        accuracy, parts = {}, {}
        for name in ENGINES:
            config = DatasetConfig(
                n_trajectories=self.trajectories,
                n_steps=self.steps,
                seed=self.seed,
                motion=MotionConfig.for_length(cable.length),
                discretisation=self.chain(cable, name),
                engine=name,  # pyright: ignore[reportArgumentType]
            )
            say(f"drawing, simulating and storing {self.trajectories} motions with {name} ...")
            away = 1e3 * distance_from_fine(config)
            values = (np.median(away), np.percentile(away, 99), away.max())
            accuracy[name] = dict(zip(("median_mm", "p99_mm", "largest_mm"), map(float, values), strict=True))
            turns = seconds_in_turns(data_stages(config), self.rounds)
            # the checks and the store are what the whole takes beyond the others
            drawn, both, whole = (1e6 / (self.trajectories * self.steps) * np.median(s) for s in turns.values())
            parts[name] = {"drawing": drawn, "simulation": both - drawn, "store": max(whole - both, 0.0)}
        total = {name: sum(of.values()) for name, of in parts.items()}
        return {
            "accuracy": accuracy,
            "us_per_transition": parts,
            "transitions_per_second": {name: 1e6 / value for name, value in total.items()},
            "two_million_transitions_min": {name: PAPER * value / 6e7 for name, value in total.items()},
        }

    def data_text(self, result: dict[str, Any]) -> str:
        """The tables of `data`."""
        accuracy = [[name, *(f"{value:.4f}" for value in row.values())] for name, row in result["accuracy"].items()]
        stored = [
            [
                name,
                *(f"{value:.0f}" for value in row.values()),
                f"{result['transitions_per_second'][name]:.0f}",
                f"{result['two_million_transitions_min'][name]:.1f}",
            ]
            for name, row in result["us_per_transition"].items()
        ]
        parts = next(iter(result["us_per_transition"].values()))
        header = ["us per transition", *parts, "transitions per second", f"minutes for {PAPER / 1e6:g} million"]
        return "\n\n".join(
            [
                text_table(["distance from 2 ms [mm]", "median", "99 %", "largest"], accuracy),
                text_table(header, stored),
            ]
        )
