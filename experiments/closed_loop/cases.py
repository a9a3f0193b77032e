"""The cases of every table: which cables, which tasks, which seeds."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import get_args

from cablejax.cable import Discretisation
from cablejax.control.targets import Shape
from cablejax.effects.given import GivenEffect
from cablejax.simulate.plant import Plant, PlantConfig
from closed_loop.protocols import StartKind, letter_task, random_task
from closed_loop.suite import Case
from closed_loop.trials import LIANG_TABLE

STIFFNESS_RATIOS = (0.1, 0.5, 1.0, 2.0, 3.0)
"""Wang et al., RA-L 2022: the cable's stiffness over the reference cable's."""
NEARBY = "nearby"
"""Table of plants that differ by less than anybody knows a cable's stiffness."""
NEARBY_RATIOS = (1.9, 1.925, 1.95, 1.975, 2.0, 2.02, 2.04, 2.06, 2.08, 2.1)
"""Their stiffness over the reference cable's."""
RANDOM_TASK_STIFFNESS = 2.0
"""The same in the tasks of Liang et al., who do not vary it."""
PLANT_CHAIN = Discretisation(n_links=24, dimension=3, timestep=0.005)
"""The plant's cable in every table that has the MuJoCo plant."""


def nearby_cases(seeds: Sequence[int]) -> list[Case]:
    """Z by ten plants next to one another, from one start: what a run owes to luck."""
    return stiffness_cases(("Z",), NEARBY_RATIOS, seeds[:1], table=NEARBY)


def stiffness_cases(
    shapes: Sequence[Shape], ratios: Sequence[float], seeds: Sequence[int], steps: int = 60, table: str = "III"
) -> list[Case]:
    """Letters from straight starts, by cables of other stiffness; Table III of the paper."""
    return [
        Case(
            table=table,
            scenario=shape,
            stiffness=ratio,
            seed=seed,
            task=functools.partial(letter_task, shape, seed, PLANT_CHAIN),
            plant=functools.partial(mujoco_plant, ratio),
            cable=f"stiffness-{ratio:g}",
            steps=steps,
        )
        for seed in seeds
        for ratio in ratios
        for shape in shapes
    ]


def real_cable_cases(
    shapes: Sequence[Shape], seeds: Sequence[int], steps: int = 120, tables: Sequence[str] = ("IV", "V")
) -> list[Case]:
    """Tables IV and V: letters by two cables of another simulator family.

    Raises:
        ImportError: PyElastica is not installed; the message says how to install it.
    """
    from closed_loop.rod_plant import ETHERNET, USB, RodPlant

    return [
        Case(
            table=table,
            scenario=shape,
            stiffness=1.0,
            seed=seed,
            task=functools.partial(letter_task, shape, seed, config.discretisation),
            plant=functools.partial(RodPlant, config),
            cable=name,
            steps=steps,
        )
        for seed in seeds
        for table, name, config in (("IV", "ethernet", ETHERNET), ("V", "usb", USB))
        if table in tables
        for shape in shapes
    ]


def random_cases(seeds: Sequence[int], steps: int = 250) -> list[Case]:
    """The protocol of Liang et al. 2026: random targets from straight and from diverse starts."""
    return [
        Case(
            table=LIANG_TABLE,
            scenario=kind,
            stiffness=RANDOM_TASK_STIFFNESS,
            seed=seed,
            task=functools.partial(random_task, kind, seed, PLANT_CHAIN),
            plant=functools.partial(mujoco_plant, RANDOM_TASK_STIFFNESS),
            cable=f"stiffness-{RANDOM_TASK_STIFFNESS:g}",
            steps=steps,
        )
        for seed in seeds
        for kind in get_args(StartKind)
    ]


@functools.lru_cache(maxsize=8)
def mujoco_plant(stiffness_ratio: float) -> Plant:
    """The plant with a cable of another stiffness; `reset` makes it new."""
    return Plant(
        PlantConfig(
            discretisation=PLANT_CHAIN, effects=(GivenEffect("bending_stiffness", (("ratio", stiffness_ratio),)),)
        )
    )
