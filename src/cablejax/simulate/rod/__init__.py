"""A cable in space between two moving clamps: an inextensible rod in node coordinates."""

from cablejax.simulate.rod.physics import RodPhysics
from cablejax.simulate.rod.rod import Rod, RodResult, Rollout

__all__ = ["Rod", "RodPhysics", "RodResult", "Rollout"]
