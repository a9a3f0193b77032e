"""Every effect of the library, large enough to matter to a cable of the reference kind on a plant of its own."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np

from cablejax.types import GapLog

EFFECTS = (
    "bending_stiffness:ratio=0.4",
    "stiffness_profile:centre_m=0.3,width_m=0.25,ratio=0.3",
    "intrinsic_curvature:centre_m=0.6,width_m=0.3,curvature_per_m=2",
    "plasticity:yield_curvature_per_m=4,hardening=0.3",
    "bending_hysteresis:moment_n_m=0.02,transition_curvature_per_m=0.5",
    "bending_damping:time_s=2",
    "axial_stretch:stiffness_n=5",
    "table_friction:coefficient=0.3",
    "friction_patch:x_m=0.4,y_m=0.2,radius_m=0.12,coefficient=0.5",
    "viscous_drag:coefficient_n_s_per_m2=5",
    "gravity_tilt:angle_rad=0.1,direction_rad=1",
    "linear_density:ratio=3",
    "lumped_mass:centre_m=0.4,mass_kg=0.06",
    "gripper_slip:gripper=1,time_s=6,distance_m=0.02",
    "gripper_rotation_offset:gripper=0,angle_rad=0.15",
    "gripper_compliance:gripper=1,stiffness_n_m_per_rad=0.15",
    "actuation_gain:gain=0.93",
    "actuation_lag:time_s=0.5,delay_s=0.2",
    "camera_similarity:scale=1.02,angle_rad=0.02,x_m=0.01,y_m=-0.005",
    "keypoint_bias:index=5,offset_m=0.015",
    "camera_lag:time_s=0.4",
    "obstacle:x_m=0.45,y_m=0.33,radius_m=0.03",
)


def similar(log: GapLog, size: float) -> GapLog:
    """The same motion of a cable of `size` times the length, in the same time.

    Its friction is `size` times and its EI `size^4` times as large. So is the sine of a tilt `size` times, and an axial
    stiffness `size^2` times.
    """
    meta = copy.deepcopy(log.meta)
    for name, power in {"length_m": 1, "diameter_m": 1, "bending_stiffness_n_m2": 4}.items():
        meta["cable"][name] *= size**power
    meta["table"]["friction_coefficient"] *= size
    meta["keypoint_arclength_m"] = [size * mark for mark in meta["keypoint_arclength_m"]]
    return dataclasses.replace(
        log,
        keypoints=size * log.keypoints,
        gripper_pose=log.gripper_pose * np.array([size, size, 1.0], np.float32),
        gripper_command=log.gripper_command * np.array([size, size, 1.0], np.float32),
        meta=meta,
    )
