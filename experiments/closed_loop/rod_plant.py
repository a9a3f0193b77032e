"""A plant of another simulator family: a Cosserat rod of PyElastica on a table with Stribeck friction.

`Plant` shares MuJoCo's link chain with the simulator that yields training data, and its Coulomb friction law. This one
shares neither. PyElastica discretises the rod as nodes and directed elements that stretch, shear and bend (Gazzola et
al., Royal Society Open Science 2018) and steps it explicitly; the table holds a node at rest by static friction and
rubs on a sliding one by

    |f| = w (mu_k + (mu_s - mu_k) exp(-(|v| / v_s)^2)),

Stribeck's law, which falls with the speed, so that the cable may move by jerks where a slow gripper drags it. Friction
acts as an impulse at the end of every time step (Moreau's time stepping): it takes away speed, at most all of it, and
needs no regularisation. A node within the friction cone does not creep.

What makes it fast enough for a closed loop:

- Explicit steps are as short as axial and shear waves need per element. Stretch and shear are much stiffer than
  bending in any cable and invisible in its motion, so they are only as stiff as `axial_ratio` says, and the elements'
  inertia of rotation, invisible too, is that of a ball as large as the element.
- Bending damping (Kelvin-Voigt) would need far shorter explicit steps; it is a tridiagonal implicit step of its own.
- The loop over time steps is compiled and calls PyElastica's compiled kernels, without Python in between.

The rod lies in the table's plane. Its end elements are held rigidly and are half as long as the others, as in
`Discretisation`, so that the middles of the elements have the arc lengths of the chain's nodes.
"""

from __future__ import annotations

import dataclasses
import importlib

import numpy as np
from jaxtyping import Float

from cablejax.cable import GRAVITY, Cable, Discretisation
from cablejax.effects import Hook
from cablejax.simulate.composite import link_lengths
from cablejax.simulate.elastica import solve_elastica
from cablejax.simulate.plant.config import HOOKS as CONTACT_PLANT_HOOKS
from cablejax.simulate.plant_config import ObservedConfig, check_camera, check_effects
from cablejax.simulate.table_plant import Observation, TablePlant

HOOKS: frozenset[Hook] = frozenset({"bending", "mass", "input", "observation"})
"""Hooks of the effects that the rod can stage."""
SETTLE_DAMPING = 10.0
"""Rate [1/s] at which all motion is damped while a new cable settles."""
LARGEST_STRETCH = 0.1
"""Relative change of an element's length beyond which the simulation counts as unstable."""


@dataclasses.dataclass(frozen=True)
class RodPlantConfig(ObservedConfig):
    """What the rod is made of; the defaults are the reference cable.

    Attributes:
        discretisation: the cable, its elements (`n_links`) and time step. The cable's `friction_coefficient` is the
            kinetic one, mu_k; `friction_speed` has no meaning here, and `dimension` must be 2.
        effects: see `HOOKS` for those that the rod knows.
        static_ratio: mu_s / mu_k >= 1.
        stribeck_speed: v_s [m/s], the speed at which sliding has taken away most of the difference.
        axial_ratio: EA / EI [1/m^2], EI that of the stiffest joint; `4 / r^2` for a solid rod of radius r. The stretch
            is the internal force over EI, at most about 100 / m^2 in the shapes of interest, over this.
        settle_time: simulated time [s] given to a new cable to settle without friction.
    """

    discretisation: Discretisation = Discretisation(n_links=27, timestep=2e-4)
    static_ratio: float = 1.3
    stribeck_speed: float = 0.005
    axial_ratio: float = 1e5
    settle_time: float = 1.0

    @property
    def axial_stiffness(self) -> float:
        """EA [N]."""
        return self.axial_ratio * max(self.cable.bending_stiffness, float(np.max(self.physics.stiffness)))

    def __post_init__(self):
        if self.discretisation.dimension != 2:
            raise ValueError(
                f"RodPlantConfig.discretisation.dimension is {self.discretisation.dimension}, expected 2: the rod lies "
                "in a plane."
            )
        for name in ("stribeck_speed", "axial_ratio", "settle_time"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"RodPlantConfig.{name} is {value}, expected a positive finite number.")
        if not (np.isfinite(self.static_ratio) and self.static_ratio >= 1):
            raise ValueError(f"RodPlantConfig.static_ratio is {self.static_ratio}, expected a finite number >= 1.")
        check_camera(self)
        object.__setattr__(self, "effects", tuple(self.effects))
        check_effects(self, HOOKS, {"Plant": CONTACT_PLANT_HOOKS})
        if self.discretisation.timestep > self.longest_timestep:
            raise ValueError(
                f"RodPlantConfig.discretisation.timestep is {self.discretisation.timestep} s, but this rod is "
                f"stable only up to {self.longest_timestep:.2g} s: use a shorter time step, fewer links or a lower "
                "axial_ratio."
            )

    @property
    def longest_timestep(self) -> float:
        """Longest stable time step [s]: an axial wave crosses an element in it, and a tenth less for safety."""
        speed = np.sqrt(self.axial_stiffness / self.physics.density)
        return float(0.9 * self.discretisation.link_length / speed)


ETHERNET = RodPlantConfig(
    discretisation=Discretisation(
        Cable(diameter=0.008, bending_stiffness=0.044, damping_time=0.1, linear_density=0.06, friction_coefficient=0.2),
        n_links=27,
        timestep=1e-4,
    ),
)
"""A shielded installation cable (Cat 7 S/FTP), stiffer than the reference: see docs/concepts/plants.md."""

USB = RodPlantConfig(
    discretisation=Discretisation(
        Cable(
            diameter=0.0045, bending_stiffness=0.008, damping_time=0.3, linear_density=0.035, friction_coefficient=0.15
        ),
        n_links=27,
        timestep=2e-4,
    ),
)
"""A USB 2.0 cable, softer and lighter than the reference: see docs/concepts/plants.md."""


class RodPlant(TablePlant):
    """A Cosserat rod, with the calls of every `TablePlant`.

    Raises:
        ImportError: PyElastica is not installed.
    """

    config: RodPlantConfig

    def __init__(self, config: RodPlantConfig | None = None):
        super().__init__(RodPlantConfig() if config is None else config)
        self._rod = self._straight_rod()

    def reset(
        self, gripper_pose: Float[np.ndarray, "Q 3"], *, guess: Float[np.ndarray, "S 2"] | None = None
    ) -> Observation:
        """See `TablePlant.reset`."""
        pose = self._checked_start(gripper_pose)
        shape = solve_elastica(
            pose, self.config.cable.length, guess=guess, n_samples=2 * self.config.discretisation.n_joints + 1
        )
        self._rod = rod = self._straight_rod()
        nodes = np.concatenate([shape.position[:1], shape.position[1:-1:2], shape.position[-1:]])
        _rod_loop().lay(rod, nodes, np.concatenate([pose[:1, 2], shape.angle[2:-1:2], pose[1:, 2]]))
        self._restart(pose)
        self._advance(np.zeros((2, 3)), self.config.discretisation.steps_in(self.config.settle_time), settling=True)
        rod.velocity_collection[:], rod.omega_collection[:] = 0.0, 0.0
        self._steps_done = 0
        return self.observe()

    def nodes(self) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """Middle of every element, for the two held ones the grasped end [m], and the elements' unit directions."""
        position = self._rod.position_collection[:2].T
        middle = 0.5 * (position[1:] + position[:-1])
        middle[0], middle[-1] = position[0], position[-1]
        return middle, self._rod.director_collection[2, :2].T.copy()

    def stretch(self) -> float:
        """Largest relative change of an element's length: small against one, or `axial_ratio` is too low."""
        return float(np.abs(self._rod.dilatation - 1.0).max())

    def _advance(self, twist: np.ndarray, steps: int, *, settling: bool = False) -> None:
        """`steps` time steps under one twist; settling is without friction and with all motion damped."""
        config, rod = self.config, self._rod
        cable, physics, h = config.cable, config.physics, config.discretisation.link_length
        friction = 0.0 if settling else cable.friction_coefficient
        loop = _rod_loop()
        loop.advance(
            *loop.arrays(rod),
            self._pose,
            twist,
            steps,
            config.discretisation.timestep,
            np.asarray(physics.stiffness * physics.damping_time) / h,
            GRAVITY * friction,
            config.static_ratio,
            config.stribeck_speed,
            SETTLE_DAMPING if settling else 0.0,
        )
        stable = np.isfinite(rod.position_collection).all() and self.stretch() < LARGEST_STRETCH
        self._moved(twist, steps, stable=bool(stable))

    def _straight_rod(self):
        """A rod along x, at rest, with the stiffness, inertia and unstressed shape of the configuration."""
        config, physics = self.config, self.config.physics
        cable, h = config.cable, config.discretisation.link_length
        lengths = link_lengths(config.discretisation)
        rod = _rod_loop().straight_rod(
            cable.length, cable.diameter, float(physics.density), lengths, config.axial_stiffness
        )
        # All joints bend alike, EI / h, those next to the half-length elements too: h is the cable's length per joint.
        rod.bend_matrix[:] = np.eye(3)[:, :, None] * (physics.stiffness * rod.rest_voronoi_lengths / h)
        rod.rest_kappa[0] = physics.rest_curvature * h / rod.rest_voronoi_lengths
        # the chain's nodes are the middles of the elements, and the ends
        rod.mass[:-1] += 0.5 * physics.extra_mass
        rod.mass[1:] += 0.5 * physics.extra_mass
        return rod


def _rod_loop():
    """The module that needs PyElastica."""
    try:
        return importlib.import_module("closed_loop.rod_loop")
    except ImportError as error:
        raise ImportError(
            "The plant made of a Cosserat rod needs PyElastica, which is not installed: pip install pyelastica==1.0.0"
        ) from error
