"""Feasible sets: bounds on elements, lengths and affine functions, and their intersection."""

from cablejax.bounded.sets.affine_balls import AffineBalls
from cablejax.bounded.sets.balls import Balls, project_ball
from cablejax.bounded.sets.base import AbstractSet, ConvexSet
from cablejax.bounded.sets.box import Box
from cablejax.bounded.sets.halfspaces import Halfspaces
from cablejax.bounded.sets.intersection import Intersection

__all__ = [
    "AbstractSet",
    "AffineBalls",
    "Balls",
    "Box",
    "ConvexSet",
    "Halfspaces",
    "Intersection",
    "project_ball",
]
