"""The contact plant: a cable in C MuJoCo that represents reality, with any effect of the library staged in it."""

from cablejax.simulate.plant.config import HOOKS, PlantConfig
from cablejax.simulate.plant.model import plant_model
from cablejax.simulate.plant.plant import Plant

__all__ = ["HOOKS", "Plant", "PlantConfig", "plant_model"]
