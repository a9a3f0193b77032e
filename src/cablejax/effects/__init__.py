"""The library of effects that a simulator may lack, by the names of the gap log's format."""

from cablejax.effects.arms import ActuationGain, ActuationLag
from cablejax.effects.base import CableEffect, Context, Hook
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
"""Every effect of the cable and the camera."""

ARMS: tuple[CableEffect, ...] = (ActuationGain(), ActuationLag())
"""Effects of the arms. A diagnosis finds them from commands and encoders, see `cablejax.diagnose.actuation`."""

OUTSIDE = frozenset({CameraSimilarity.name, CameraLag.name, *(effect.name for effect in ARMS)})
"""Names of those outside of the cable: of the camera, with which keypoints are not where the cable is, and of the arms,
with which commands are not executed exactly. No model is trained on them, or informed of them."""

__all__ = ["ARMS", "LIBRARY", "OUTSIDE", "CableEffect", "Context", "Effect", "Hook", "Parameter"]
