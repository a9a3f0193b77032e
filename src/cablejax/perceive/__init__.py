"""From point clouds to keypoints: registration, first frame, tracking, a depth camera and recorded sequences."""

from cablejax.perceive.frame import Status, Track, TrackerConfig, track
from cablejax.perceive.registration import RegistrationConfig, register
from cablejax.perceive.tracker import Tracker

__all__ = [
    "RegistrationConfig",
    "Status",
    "Track",
    "Tracker",
    "TrackerConfig",
    "register",
    "track",
]
