"""Tasks that need a model: shapes of other cables given as keypoints only, and runs that are disturbed in the middle.

- **Keypoints only** (`recorded_task`). Another cable, of random stiffness, friction and bend at rest, is moved on the
  contact plant and lies as friction leaves it. Its keypoints are the target: nobody says where the grippers are to be,
  and our cable cannot take the shape exactly. How near it can come at rest is found by `nearest_rest`, which looks
  through all gripper poses that are allowed, without friction.
- **Disturbed** (`disturbed_task`). A letter, and half-way through the run something happens: a push, a slip through one
  gripper, friction or stiffness that change; or the keypoints are noisy, or come from clouds with gaps, all the time.

Seeds from `HELD_OUT` on are those of the tables; nothing is chosen on them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from cablejax.cable import Cable
from cablejax.control.targets import Shape, target_from_keypoints
from cablejax.effects.given import GivenEffect, parse_effect
from cablejax.mpc.config import MPCConfig
from cablejax.mpc.target_pose import target_pose
from cablejax.perceive.camera import CameraConfig
from cablejax.perceive.plant import CloudPlant
from cablejax.simulate.chain.statics import resting_shapes
from cablejax.simulate.plant import Plant, PlantConfig
from closed_loop.cases import PLANT_CHAIN
from closed_loop.protocols import Task, letter_task, random_shape, straight_task
from closed_loop.suite import Case

RECORDED, DISTURBED = "keypoints only", "disturbed"
"""Names of the tables."""
MARGIN_CM = {RECORDED: 0.2, DISTURBED: 0.3}
"""How far a run may end above the best that a cable at rest can do, to have reached its target [cm]."""
HELD_OUT = 1000
"""First seed of the tables."""
STEPS = {RECORDED: 90, DISTURBED: 60}
"""Commands of a run: where the cable comes to lie in another shape first, it takes a minute to straighten and shape it
again. Runs are disturbed half-way, after 30 s."""
_TOWARDS = 6
"""Commands by which another cable is brought to the shape that is recorded."""
_PASSES = 6
"""How often the branch that `nearest_rest` follows is taken up from where it has come."""
_TURNED = (0.0, 0.3, -0.3)
"""Angles by which the grippers are turned where it begins [rad]: a shape that friction held may leave its branch."""

FRICTION = Cable().friction_coefficient

DISTURBANCES: dict[str, tuple[str, ...]] = {
    "push": ("gravity_tilt:angle_rad=0.6,direction_rad={angle},from_s=30,until_s=31.5",),
    "slip": ("gripper_slip:gripper={gripper},time_s=30,distance_m=0.005",),
    "friction rises": (f"table_friction:coefficient={3 * FRICTION:g},from_s=30",),
    "stiffness falls": ("bending_stiffness:ratio=0.3,from_s=30",),
    "2 mm noise": (),
    "clouds": (),
}
"""What happens, as effects of the plant."""


@functools.lru_cache(maxsize=2)
def recorded_task(seed: int) -> Task:
    """A straight start and the recorded shape of another cable; the same for all who ask."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(7,)))
    while True:
        effects = (
            f"bending_stiffness:ratio={np.exp(rng.uniform(-1.2, 1.2)):.4f}",
            f"table_friction:coefficient={FRICTION * np.exp(rng.uniform(-0.7, 0.7)):.4f}",
            f"intrinsic_curvature:centre_m=0.5,width_m=0.4,curvature_per_m={rng.uniform(-2.0, 2.0):.4f}",
        )
        other = Plant(PlantConfig(discretisation=PLANT_CHAIN, effects=tuple(map(parse_effect, effects))))
        _, rest = random_shape(rng, "", PLANT_CHAIN)
        twist = rng.uniform(-1.0, 1.0, (2, 3)) * np.array([0.03, 0.03, 0.2])
        pose = np.array([[*rest.position[0], rest.angle[0]], [*rest.position[-1], rest.angle[-1]]])
        try:
            other.reset(pose, guess=rest.position)
            keypoints = np.asarray(other.step(twist, float(_TOWARDS)).true_keypoints)
            target = target_from_keypoints(f"{RECORDED} {seed}", keypoints)
        except ValueError:
            continue  # pulled taut, no rest with these effects, or bent too sharply for its keypoints: another draw
        task = straight_task(target.name, target, seed, PLANT_CHAIN)
        return dataclasses.replace(task, reachable_cm=nearest_rest(keypoints))


def nearest_rest(keypoints: Float[np.ndarray, "N 2"]) -> float:
    """How near a frictionless cable at rest comes to these keypoints [cm], at the best gripper poses that are allowed.

    The distance of the grippers stays within the controller's bounds.
    """
    length, free = PLANT_CHAIN.cable.length, (-np.inf, np.inf)
    distance = MPCConfig.min_distance * length, MPCConfig.max_distance * length
    bounds = np.array([free, free, free, distance, free, free]).T
    start = np.clip(_held_as(np.asarray(target_pose(jnp.asarray(keypoints)), float)), *bounds)
    turn = np.array([0.0, 0.0, 0.0, 0.0, 1.0, -1.0])
    return min(_nearest_from(start + angle * turn, keypoints, bounds) for angle in _TURNED)


def _nearest_from(values: Float[np.ndarray, "6"], keypoints: Float[np.ndarray, "N 2"], bounds) -> float:
    """The same from one place on, see `_held_as`, along the branch of shapes that the keypoints are on."""
    wanted = branch = jnp.asarray(keypoints)
    error = np.inf
    for _ in range(_PASSES):
        values = least_squares(
            # where a cable finds no rest it is as good as a metre off
            lambda values, branch=branch: np.nan_to_num(_away(values, branch, wanted), nan=1.0),
            values,
            jac=lambda values, branch=branch: np.nan_to_num(_slope(values, branch, wanted)),  # pyright: ignore[reportArgumentType]
            bounds=bounds,
        ).x
        branch, before = _at_rest(_poses(jnp.asarray(values)), branch), error
        error = 100 * float(np.sqrt(np.mean(np.sum((np.asarray(branch) - keypoints) ** 2, axis=1))))
        if before - error < 1e-3:
            break
    return error


def _held_as(pose: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "6"]:
    """Middle of the grippers, direction and length of the way from one to the other, and both angles."""
    way = pose[1, :2] - pose[0, :2]
    return np.array([*pose[:, :2].mean(axis=0), np.arctan2(way[1], way[0]), np.hypot(*way), *pose[:, 2]])


def _poses(values: Float[jax.Array, "6"]) -> Float[jax.Array, "2 3"]:
    """The inverse of `_held_as`."""
    half = 0.5 * values[3] * jnp.stack([jnp.cos(values[2]), jnp.sin(values[2])])
    return jnp.concatenate([jnp.stack([values[:2] - half, values[:2] + half]), values[4:, None]], axis=1)


@jax.jit
def _at_rest(pose: Float[jax.Array, "2 3"], branch: Float[jax.Array, "N 2"]) -> Float[jax.Array, "N 2"]:
    for _ in range(3):
        branch = resting_shapes(branch, pose, pose, length=PLANT_CHAIN.cable.length)[1]
    return branch


@jax.jit
def _away(values: Float[jax.Array, "6"], branch: Float[jax.Array, "N 2"], wanted: Float[jax.Array, "N 2"]):
    return (_at_rest(_poses(values), branch) - wanted).ravel()


_slope = jax.jit(jax.jacfwd(_away))


def disturbed_task(seed: int) -> Task:
    """A letter; the disturbance is the plant's, see `disturbed_plant`."""
    shapes = get_args(Shape)
    return letter_task(shapes[(seed // len(DISTURBANCES)) % len(shapes)], seed, PLANT_CHAIN)


def disturbance_of(seed: int) -> str:
    """A key of `DISTURBANCES`."""
    return list(DISTURBANCES)[seed % len(DISTURBANCES)]


def disturbed_plant(seed: int) -> Plant:
    """The plant in which it happens; the cable is half, once or twice as stiff as the reference cable."""
    rng, name = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(8,))), disturbance_of(seed)
    stiffness = GivenEffect("bending_stiffness", (("ratio", float(rng.choice([0.5, 1.0, 2.0]))),))
    random = {"angle": f"{rng.uniform(0.0, 2 * np.pi):.3f}", "gripper": rng.integers(2)}
    effects = (stiffness, *(parse_effect(text.format(**random)) for text in DISTURBANCES[name]))
    noise = 2e-3 if name == "2 mm noise" else 0.0
    config = PlantConfig(discretisation=PLANT_CHAIN, effects=effects, keypoint_noise=noise, seed=seed)
    return CloudPlant(config, camera=CameraConfig(seed=seed)) if name == "clouds" else Plant(config)


def recorded_plant() -> Plant:
    """Our cable, twice as stiff as the reference cable."""
    return Plant(
        PlantConfig(discretisation=PLANT_CHAIN, effects=(GivenEffect("bending_stiffness", (("ratio", 2.0),)),))
    )


def harder_cases(seeds: Sequence[int]) -> list[Case]:
    """Both tables, one case of each for a seed."""

    def case(table: str, scenario: str, seed: int, task: Callable[[], Task], plant: Callable[[], Plant]) -> Case:
        return Case(table, scenario, 1.0, seed, task, plant, f"{table} {seed}", STEPS[table], patience=None)

    return [
        made
        for seed in seeds
        for made in (
            case(RECORDED, RECORDED, seed, functools.partial(recorded_task, seed), recorded_plant),
            case(
                DISTURBED, disturbance_of(seed), seed, functools.partial(disturbed_task, seed),
                functools.partial(disturbed_plant, seed),
            ),
        )
    ]  # fmt: skip
