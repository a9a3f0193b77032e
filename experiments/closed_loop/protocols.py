"""Starts and targets of the trials: the scenarios of Wang et al., RA-L 2022, and of Liang et al., 2026.

Neither paper gives its starts and targets as numbers. What is chosen here:

- **U, S, Z from straight** (`letter_task`). The targets are those of `targets.make_target`. The start is a cable that
  is straight but for a slack of 0.5 to 2 % of its length on a random side, its heading within 30 degrees of +x and its
  middle within 5 cm of the origin in x and in y. It depends on the seed alone: all methods and all three letters of one
  seed start alike, so they can be compared in pairs.
- **Random start to random target** (`random_task`). A target is a shape in which the cable rests between two grippers
  at random poses: distance, angles against the chord and curvature within what `MotionConfig` admits, any orientation,
  its middle within 20 cm of the origin in x and in y. A "straight" start is that of the letters; since the target's
  orientation is uniform over the whole circle, so is the angle between start and target. A "diverse" start is another
  random shape. Both kinds share the target of a seed.

Random shapes are kept if they are stable with a margin and do not cross themselves; 98 % of the draws are. They can be
reached, in principle, by construction: the first part of a stable elastica is a stable elastica, and, enlarged to the
cable's length, it leads through stable shapes from the straight cable, where that part is short, to the target, where
it is the whole (Borum and Bretl, ICRA 2015). Between any two of them leads the way over straight. Whether a controller
finds such a way is what is measured.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, Protocol

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cablejax.cable import Discretisation
from cablejax.control.targets import START_LEAN, Shape, Target, make_target
from cablejax.mpc import MPCConfig
from cablejax.mpc.target_pose import continued, target_pose, way_to
from cablejax.simulate.elastica import Elastica, ElasticaError, elastica, solve_elastica
from cablejax.simulate.equilibrium import arch_angles, chain_nodes, find_equilibrium
from cablejax.simulate.motions import MotionConfig, admissible
from cablejax.simulate.table_plant import Observation

StartKind = Literal["straight", "diverse"]

MAX_DRAWS = 1000
"""Shapes drawn for one task before giving up: the limits then exclude (almost) all."""

# Nodes for a shape's stability: it is within 1 % of that on a fine grid, and a draw takes milliseconds.
_NODES = 61
# Independent streams of one seed.
_STRAIGHT, _TARGET, _START = range(3)


@dataclasses.dataclass(frozen=True)
class StartConfig:
    """How straight starts vary.

    Attributes:
        heading: largest angle to +x [rad].
        position: largest distance of the middle from the origin, in x and in y [m].
        slack: least and greatest, relative to the length.
    """

    heading: float = np.pi / 6
    position: float = 0.05
    slack: tuple[float, float] = (0.005, 0.02)


@dataclasses.dataclass(frozen=True)
class ShapeConfig:
    """What random shapes are like.

    Attributes:
        motion: limits of the grippers' poses; the slack keeps targets within the controller's bound on their distance.
        position: largest distance of the chord's middle from the origin, in x and in y [m].
        min_stability: least eigenvalue of the bending energy's second derivative in units of EI / L: 0 on the verge of
            snapping through, 39.5 for a straight cable. Just above 0 a shape is stable only on paper.
    """

    motion: MotionConfig = MotionConfig(straight_slack=0.02)
    position: float = 0.2
    min_stability: float = 1.0


@dataclasses.dataclass(frozen=True)
class Task:
    """A start and a target.

    Attributes:
        name: scenario and seed, for tables.
        start_pose: (x, y, theta) of both grippers at the start [m, rad], shape [Q, 3].
        start_shape: points of the cable at the start [m], uniform in arc length, shape [S, 2]: several shapes may fit
            between the grippers, and this is the one. Give it to the plant as a guess, see `LaidOut`.
        target: the wanted shape.
        reachable_cm: how near a cable at rest can come to it [cm].
    """

    name: str
    start_pose: Float[np.ndarray, "Q 3"]
    start_shape: Float[np.ndarray, "S 2"]
    target: Target
    reachable_cm: float = 0.0


def least_time(task: Task, config: MPCConfig) -> float:
    """Seconds in which the grippers can get to where the target's ends are held, straight and at the motion bound.

    No controller that keeps the bound arrives sooner, whatever it knows of the cable.
    """
    pose = continued(jnp.asarray(task.start_pose), jnp.asarray(task.start_shape))
    way = way_to(pose, target_pose(jnp.asarray(task.target.keypoints)), config.objective.rotation_weight)
    return config.objective.interval * float(jnp.linalg.norm(way, axis=1).max()) / config.radius_max


class GuessingCable(Protocol):
    """A plant whose `reset` takes a guess of the shape, as `Plant` does."""

    def reset(
        self, gripper_pose: Float[np.ndarray, "Q 3"], *, guess: Float[np.ndarray, "S 2"] | None = None
    ) -> Observation: ...

    def record(self, twist: Float[np.ndarray, "Q 3"], interval: float, *, samples: int) -> list[Observation]: ...


@dataclasses.dataclass(frozen=True)
class LaidOut:
    """A plant that lays its cable out in a task's start shape; for `control.loop.run_closed_loop`.

    Attributes:
        plant: what is laid out and shaped.
        shape: points uniform in arc length [m], shape [S, 2].
    """

    plant: GuessingCable
    shape: Float[np.ndarray, "S 2"]

    def reset(self, gripper_pose: Float[np.ndarray, "Q 3"]) -> Observation:
        """A new cable, in the given shape."""
        return self.plant.reset(gripper_pose, guess=self.shape)

    def record(self, twist: Float[np.ndarray, "Q 3"], interval: float, *, samples: int) -> list[Observation]:
        """As the plant."""
        return self.plant.record(twist, interval, samples=samples)


def letter_task(
    shape: Shape, seed: int, config: Discretisation = Discretisation(), start: StartConfig = StartConfig()
) -> Task:
    """A letter from a straight start that depends on the seed.

    Raises:
        ValueError: another letter.
    """
    return straight_task(f"{shape} {seed}", make_target(shape, config.cable), seed, config, start)


def random_task(
    kind: StartKind,
    seed: int,
    config: Discretisation = Discretisation(),
    start: StartConfig = StartConfig(),
    shapes: ShapeConfig = ShapeConfig(),
) -> Task:
    """A random target from a straight or from another random shape; see the module for the choices.

    Raises:
        ValueError: another kind of start, or no shape meets the limits.
    """
    name = f"{kind} {seed}"
    target, _ = random_shape(_stream(seed, _TARGET), name, config, shapes)
    if kind == "straight":
        return straight_task(name, target, seed, config, start)
    if kind != "diverse":
        raise ValueError(f'The start is {kind!r}, expected "straight" or "diverse".')
    first, rest = random_shape(_stream(seed, _START), name, config, shapes)
    return Task(name, first.gripper_pose, rest.position, target)


def random_straight_start(
    seed: int, config: Discretisation = Discretisation(), start: StartConfig = StartConfig()
) -> Float[np.ndarray, "2 3"]:
    """Gripper poses (x, y, theta) [m, rad] of an almost straight cable; see `StartConfig`."""
    rng = _stream(seed, _STRAIGHT)
    heading = rng.uniform(-start.heading, start.heading)
    middle = rng.uniform(-start.position, start.position, 2)
    half = 0.5 * config.cable.length * (1.0 - rng.uniform(*start.slack)) * np.array([np.cos(heading), np.sin(heading)])
    lean = START_LEAN * rng.choice([-1.0, 1.0])
    return np.array([[*(middle - half), heading + lean], [*(middle + half), heading - lean]])


def random_shape(
    rng: np.random.Generator, name: str, config: Discretisation = Discretisation(), shapes: ShapeConfig = ShapeConfig()
) -> tuple[Target, Elastica]:
    """A random shape in which the cable rests stably, as a target and as a curve.

    Raises:
        ValueError: `MAX_DRAWS` draws did not meet the limits.
    """
    for _ in range(MAX_DRAWS):
        pose = _random_pose(rng, config, shapes)
        if (rest := _resting_shape(config, pose, shapes.min_stability)) is not None:
            points = [np.interp(config.cable.keypoint_arclength, rest.arclength, rest.position[:, i]) for i in range(2)]
            return Target(name, np.stack(points, axis=1), pose), rest
    raise ValueError(f"None of {MAX_DRAWS} random shapes met {shapes}: widen the limits.")


def straight_task(
    name: str, target: Target, seed: int, config: Discretisation = Discretisation(), start: StartConfig = StartConfig()
) -> Task:
    """A target from the straight start of a seed."""
    pose = random_straight_start(seed, config, start)
    return Task(name, pose, elastica(pose, config.cable.length, np.linspace(0.0, config.cable.length, 101)), target)


def _random_pose(rng: np.random.Generator, config: Discretisation, shapes: ShapeConfig) -> Float[np.ndarray, "2 3"]:
    """Two grippers at a random distance, angles and place."""
    limits = shapes.motion
    while True:
        half = 0.5 * config.cable.length * rng.uniform(limits.min_distance, 1.0)
        heading = rng.uniform(-np.pi, np.pi)
        offset = half * np.array([np.cos(heading), np.sin(heading)])
        angles = heading + rng.uniform(-limits.max_angle, limits.max_angle, 2)
        middle = rng.uniform(-shapes.position, shapes.position, 2)
        pose = np.array([[*(middle - offset), angles[0]], [*(middle + offset), angles[1]]])
        if admissible(config, limits, pose):
            return pose


def _resting_shape(config: Discretisation, pose: Float[np.ndarray, "2 3"], min_stability: float) -> Elastica | None:
    """The elastica near the chain's equilibrium that grows out of one gentle arch, if it is stable and uncrossed."""
    try:
        angles = find_equilibrium(config, pose, arch_angles(config, pose)).angles
        nodes = np.concatenate([pose[:1, :2], chain_nodes(config, pose, angles), pose[1:, :2]])
        # The held links are half as long as the others.
        s = np.concatenate([[0.0], (np.arange(config.n_joints) + 0.5) * config.link_length, [config.cable.length]])
        even = np.linspace(0.0, config.cable.length, 101)
        guess = np.stack([np.interp(even, s, nodes[:, i]) for i in range(2)], axis=1)
        rest = solve_elastica(pose, config.cable.length, guess=guess)
    except (ElasticaError, ValueError):
        return None
    same = np.abs(np.interp(even, rest.arclength, rest.position[:, 1]) - guess[:, 1]).max() < 0.02 * config.cable.length
    stable = rest.stability(_NODES) * config.cable.length**2 >= min_stability
    return rest if same and stable and not _crosses_itself(rest.position[::4]) else None


def _crosses_itself(points: Float[np.ndarray, "S 2"]) -> bool:
    """Whether two edges of a polyline that are not neighbours cross."""

    def side(a, b, c):
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])

    a, b = points[:-1], points[1:]
    i, j = np.triu_indices(len(a), 2)
    apart = side(a[i], b[i], a[j]) * side(a[i], b[i], b[j]) < 0
    return bool((apart & (side(a[j], b[j], a[i]) * side(a[j], b[j], b[i]) < 0)).any())


def _stream(seed: int, purpose: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(purpose,)))
