"""Planning problems to judge solvers on: those that closed loops met, and ones from random shapes to random targets.

A problem is kept as plain arrays, so that a thousand of them are one small file and the same for every solver. Those of
closed loops are what the controller asked its solver for, to the digit: history, fitted residual, radius and first
guess, taken down by a solver that does so before it solves.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from against_ipopt.referee import Limits
from against_ipopt.rounded import CORNER, smoothed
from cablejax.control.loop import run_closed_loop
from cablejax.control.shaping import Model, NetworkDynamics
from cablejax.control.targets import Shape
from cablejax.mpc import MPC, MPCConfig, ObjectiveConfig, Plan, ShapingProblem, Solver
from cablejax.mpc.feasible import feasible_from
from cablejax.mpc.problem import Rollout
from cablejax.npz import read_npz
from cablejax.residual.jacobian import Corrected
from cablejax.residual.ridge import ResidualModel, zero_residual
from cablejax.types import History
from closed_loop.cases import PLANT_CHAIN, mujoco_plant
from closed_loop.protocols import LaidOut, letter_task, random_task

CONFIG = MPCConfig(objective=ObjectiveConfig(arrival_weight=0.0))
"""The controller whose problems these are: with the paper's objective, in which the keypoints alone decide where to
go, as the problems that docs/results/against_ipopt.md is about."""


@dataclasses.dataclass(frozen=True)
class PlanningCase:
    """One planning problem as arrays.

    Attributes:
        name: unique, says where it is from.
        keypoints: history [m], shape [H, N, 2].
        gripper_pose: (x, y, theta) now [m, rad], shape [Q, 3].
        gain: the fitted residual's, zero without one, shape [3Q, 2N].
        bias: likewise [m], shape [2N].
        target: wanted keypoints [m], shape [N, 2].
        radius: bound on the norm of each gripper's motion in each step [m].
        guess: where solvers start [m], shape [T, Q, 3].
    """

    name: str
    keypoints: Float[np.ndarray, "H N 2"]
    gripper_pose: Float[np.ndarray, "Q 3"]
    gain: Float[np.ndarray, "R C"]
    bias: Float[np.ndarray, " C"]
    target: Float[np.ndarray, "N 2"]
    radius: float
    guess: Float[np.ndarray, "T Q 3"]

    def limits(self) -> Limits:
        """The bounds, as the referee takes them."""
        length = CONFIG.cable_length
        pose = np.asarray(self.gripper_pose, float)
        return Limits(
            separation=pose[1, :2] - pose[0, :2],
            radius=float(self.radius),
            min_distance=CONFIG.min_distance * length,
            max_distance=CONFIG.max_distance * length,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class ProblemMaker:
    """Turns cases into problems of one model in one precision; all of them compile alike.

    Attributes:
        model: what the plans are judged by.
        precision: of every array.
    """

    model: Model
    precision: type = np.float64

    def __post_init__(self):
        object.__setattr__(self, "_dynamics", Corrected(self.model.dynamics))
        object.__setattr__(self, "_weights", jax.tree.map(self._cast, self.model.weights))

    def __call__(self, case: PlanningCase) -> ShapingProblem:
        """The problem."""
        pose = self._cast(case.gripper_pose)
        residual = ResidualModel(self._cast(case.gain), self._cast(case.bias))
        limits = CONFIG.min_distance * CONFIG.cable_length, CONFIG.max_distance * CONFIG.cable_length
        return ShapingProblem(
            dynamics=self._dynamics,  # pyright: ignore[reportAttributeAccessIssue]
            weights=(self._weights, residual),  # pyright: ignore[reportAttributeAccessIssue]
            history=History(keypoints=self._cast(case.keypoints), gripper_pose=pose),
            target=self._cast(case.target),
            feasible=feasible_from(pose, self._cast(case.radius), limits),
            objective=CONFIG.objective,
        )

    def _cast(self, leaf) -> Array:
        leaf = jnp.asarray(leaf)
        return leaf.astype(self.precision) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def smooth_model(model: Model, corner: float = CORNER) -> Model:
    """The model with its activations' corners rounded, so that its planning problems have stationary points."""
    if not isinstance(model.dynamics, NetworkDynamics):
        raise ValueError(f"Model {model.name!r} is no network as `load_model` gives it: there is nothing to round.")
    graphdef = smoothed(model.dynamics.graphdef, model.weights, corner)
    return dataclasses.replace(model, dynamics=NetworkDynamics(graphdef))


def closed_loop_cases(
    model: Model, shapes: Sequence[Shape], ratios: Sequence[float], seeds: Sequence[int], steps: int
) -> list[PlanningCase]:
    """What the controller with online residual is asked on the way to the letters, by cables of other stiffness."""
    cases, log = [], RecordingSolver(CONFIG.solver)  # one for all runs: they share what is compiled
    config = dataclasses.replace(CONFIG, solver=log)
    for seed in seeds:
        for shape in shapes:
            task = letter_task(shape, seed, PLANT_CHAIN)
            for ratio in ratios:
                log.met.clear()
                controller = MPC(config, model.dynamics, model.weights, task.target.keypoints)
                plant = LaidOut(mujoco_plant(ratio), task.start_shape)
                run_closed_loop(plant, controller, task.target, steps, start=task.start_pose, record_hz=1.0)
                jax.effects_barrier()
                # the first call only compiles
                for step, case in enumerate(log.met[1:]):
                    name = f"{shape}, stiffness {ratio:g}, seed {seed}, step {step}"
                    cases.append(dataclasses.replace(case, name=name))
    return cases


def random_cases(model: Model, seeds: Sequence[int]) -> list[PlanningCase]:
    """A cable at rest in a random shape, a random target, a random radius, and a random guess or none."""
    cases = []
    for seed in seeds:
        task = random_task("diverse", seed, PLANT_CHAIN)
        rng = np.random.default_rng([seed, 10])
        index = np.linspace(0.0, len(task.start_shape) - 1.0, model.config.n_keypoints)
        rest = [np.interp(index, np.arange(len(task.start_shape)), task.start_shape[:, i]) for i in range(2)]
        none = zero_residual(model.config.n_keypoints)
        radius = float(np.exp(rng.uniform(np.log(CONFIG.radius_min), np.log(CONFIG.radius_max))))
        size = rng.choice([0.0, 0.5])
        cases.append(
            PlanningCase(
                name=f"random {seed}",
                keypoints=np.repeat(np.stack(rest, axis=1)[None], model.config.history, axis=0),
                gripper_pose=np.asarray(task.start_pose, float),
                gain=np.asarray(none.gain, float),
                bias=np.asarray(none.bias, float),
                target=task.target.keypoints,
                radius=radius,
                guess=size * radius / 3**0.5 * rng.uniform(-1.0, 1.0, (CONFIG.n_commands, 2, 3)),
            )
        )
    return cases


def other_radii(cases: Sequence[PlanningCase], seed: int) -> list[PlanningCase]:
    """The same cases with random radii, between the controller's least and greatest: log-uniform."""
    rng = np.random.default_rng([seed, 11])
    radii = np.exp(rng.uniform(np.log(CONFIG.radius_min), np.log(CONFIG.radius_max), len(cases)))
    return [
        dataclasses.replace(case, name=f"{case.name}, another radius", radius=float(radius))
        for case, radius in zip(cases, radii, strict=True)
    ]


def save_cases(path: pathlib.Path, cases: Sequence[PlanningCase]) -> None:
    """Writes cases to one npz file."""
    fields = [field.name for field in dataclasses.fields(PlanningCase)]
    path.parent.mkdir(parents=True, exist_ok=True)
    columns: dict[str, Any] = {name: np.stack([getattr(case, name) for case in cases]) for name in fields}
    np.savez_compressed(path, **columns)


def load_cases(path: pathlib.Path) -> list[PlanningCase]:
    """Reads what `save_cases` wrote."""
    columns = read_npz(path, [field.name for field in dataclasses.fields(PlanningCase)], text=["name"])
    rows = zip(*columns.values(), strict=True)
    cases = [dict(zip(columns, row, strict=True)) for row in rows]
    return [PlanningCase(**(case | {"name": str(case["name"]), "radius": float(case["radius"])})) for case in cases]


@dataclasses.dataclass(frozen=True, eq=False)
class RecordingSolver:
    """A solver that takes down what it is asked for.

    Attributes:
        solver: that solves.
        met: the problems in the order of the calls, without names.
    """

    solver: Solver
    met: list[PlanningCase] = dataclasses.field(default_factory=list)

    def __call__(self, problem: ShapingProblem, guess: Rollout) -> Plan:
        residual = problem.weights[1]
        jax.debug.callback(
            self._take_down,
            problem.history.keypoints,
            problem.history.gripper_pose,
            residual.gain,
            residual.bias,
            problem.target,
            problem.feasible.radius,
            guess.motion,
            ordered=True,
        )
        return self.solver(problem, guess)

    def _take_down(self, keypoints, gripper_pose, gain, bias, target, radius, guess) -> None:
        arrays = (np.array(leaf, float) for leaf in (keypoints, gripper_pose, gain, bias, target))
        self.met.append(PlanningCase("", *arrays, radius=float(radius), guess=np.array(guess, float)))
