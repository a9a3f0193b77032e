"""The effects that a diagnosis knows, by the names of the gap log's format."""

from cablejax.diagnose.effects.base import Context, Effect, Parameter
from cablejax.diagnose.effects.camera import CameraLag, CameraSimilarity, KeypointBias
from cablejax.diagnose.effects.grasp import GripperCompliance, GripperRotationOffset, GripperSlip
from cablejax.diagnose.effects.material import (
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
from cablejax.diagnose.effects.table import FrictionPatch, GravityTilt, Obstacle, TableFriction, ViscousDrag

LIBRARY: tuple[Effect, ...] = (
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

__all__ = ["LIBRARY", "Context", "Effect", "Parameter"]
