"""Family C: a chain of capsules in C MuJoCo on a table with contacts, `cablejax.simulate.plant`.

Only a cousin of the simulator that diagnoses: it shares MuJoCo's links and the package's code, but has contacts, ball
joints, another resolution and another time step. Logs of this family are scored apart. A log of 6 episodes costs about
half a minute of one core.
"""

from __future__ import annotations

import numpy as np

from cablejax.cable import Cable, Discretisation
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.simulate.table_plant import PlantError

from .rod import Motion, arch
from .world import GRAVITY, World

LINKS = 28
UNDERSTOOD = {"static_excess", "stribeck_speed", "tilt", "tilt_direction"}
"""MuJoCo's friction is Coulomb's: what a world says of its decrease with the speed is left out."""


def simulate(world: World, pose: np.ndarray, frame: float) -> Motion:
    """One episode; see `rod.simulate`.

    Raises:
        ValueError: the world has something this family has no law for, or no rest was found.
        FloatingPointError: the chain became unstable.
    """
    unknown = world.unlike_nominal() - UNDERSTOOD
    if unknown:
        raise ValueError(f"Family C has no law for {sorted(unknown)}.")
    cable = Discretisation(
        Cable(
            length=world.length,
            diameter=world.diameter,
            bending_stiffness=world.stiffness,
            damping_time=world.damping_time,
            linear_density=world.linear_density,
            friction_coefficient=world.friction,
        ),
        n_links=LINKS,
        dimension=3,
        timestep=0.005,
    )
    plant = Plant(PlantConfig(discretisation=cable))
    plant.model.opt.gravity[:] = GRAVITY * np.array([
        np.sin(world.tilt) * np.cos(world.tilt_direction), np.sin(world.tilt) * np.sin(world.tilt_direction),
        -np.cos(world.tilt),
    ])  # fmt: skip
    points = np.empty((len(pose), LINKS, 2))
    try:
        plant.reset(pose[0], guess=arch(pose[0], world.length, 2 * LINKS))
        points[0] = plant.nodes()[0][:, :2]
        for f in range(len(pose) - 1):
            plant.step((pose[f + 1] - pose[f]) / frame, frame)
            points[f + 1] = plant.nodes()[0][:, :2]
    except PlantError as error:
        raise FloatingPointError(str(error)) from error
    return Motion(points, np.repeat(np.linspace(0.0, world.length, LINKS)[None], len(pose), axis=0))
