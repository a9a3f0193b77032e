"""From point clouds to keypoints: registration, first frame, tracking, a depth camera and recorded sequences."""

from cablejax.perceive.frame import Status, Track, TrackerConfig, TrackState, track
from cablejax.perceive.registration import CurveFit, RegistrationConfig, register
from cablejax.perceive.tracker import Tracker

__all__ = [
    "CurveFit",
    "RegistrationConfig",
    "Status",
    "Track",
    "TrackState",
    "Tracker",
    "TrackerConfig",
    "register",
    "track",
]
