"""The effects that a diagnosis knows, by the names of the gap log's format."""

from cablejax.effects.base import CableEffect, Context
from cablejax.effects.camera import CameraLag, CameraSimilarity, KeypointBias
from cablejax.effects.effect import Effect, Parameter
from cablejax.effects.grasp import GripperCompliance, GripperRotationOffset, GripperSlip
from cablejax.effects.material import (
    AxialStretch,
    BendingDamping,
    BendingHysteresis,
    BendingStiffness,
    IntrinsicCurvature,
    LinearDensity,
    LumpedMass,
    Plasticity,
    StiffnessProfile,
)
from cablejax.effects.table import FrictionPatch, GravityTilt, Obstacle, TableFriction, ViscousDrag

LIBRARY: tuple[CableEffect, ...] = (
    BendingStiffness(),
    StiffnessProfile(),
    IntrinsicCurvature(),
    Plasticity(),
    BendingHysteresis(),
    BendingDamping(),
    AxialStretch(),
    TableFriction(),
    FrictionPatch(),
    ViscousDrag(),
    GravityTilt(),
    LinearDensity(),
    LumpedMass(),
    GripperSlip(),
    GripperRotationOffset(),
    GripperCompliance(),
    CameraSimilarity(),
    KeypointBias(),
    CameraLag(),
    Obstacle(),
)
"""Every effect of the cable and the camera. Those of the arms are found from the encoders, see `actuation`."""

__all__ = ["LIBRARY", "CableEffect", "Context", "Effect", "Parameter"]
