"""From point clouds to keypoints: registration, first frame, tracking, a depth camera and recorded sequences."""

from cablejax.perceive.registration import CurveFit, RegistrationConfig, register
from cablejax.perceive.tracker import Status, Track, Tracker, TrackerConfig, TrackState, track

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
