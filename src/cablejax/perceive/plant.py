"""The plant seen through a camera: the same two calls, but its keypoints come from clouds."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from cablejax.cable import Cable
from cablejax.effects.given import TIMED, check_hooks
from cablejax.perceive.camera import CameraConfig, DepthCamera
from cablejax.perceive.frame import Status, Track, TrackerConfig, TrackState
from cablejax.perceive.registration import RegistrationConfig
from cablejax.perceive.tracker import Tracker
from cablejax.simulate.plant import HOOKS, Plant, PlantConfig
from cablejax.simulate.table_plant import Observation


class CloudPlant(Plant):
    """A plant whose keypoints a tracker estimates from a depth camera's clouds.

    `reset` and `record` are those of `Plant`; every observation is one frame of the camera. Where a frame is lost, its
    inner keypoints are NaN: a controller then uses its own prediction. The true keypoints are returned as well.

    Attributes:
        camera: the camera.
        tracker: what follows the cable.
        track: what came of the last frame, None before the first.
        cloud: the last frame's points [m], shape [S, 3].
        lost: frames lost since the last reset.
    """

    def __init__(
        self,
        config: PlantConfig | None = None,
        *,
        camera: CameraConfig | None = None,
        tracker: TrackerConfig | None = None,
    ):
        super().__init__(config)
        # its keypoints come from a cloud, not from what a camera reports
        check_hooks(self.config.effects, HOOKS - {"observation"}, "CloudPlant", {"Plant": HOOKS}, TIMED)
        if ignored := [name for name in ("keypoint_noise", "keypoint_dropout") if getattr(self.config, name)]:
            raise ValueError(
                f"CloudPlant has no use for {' and '.join(ignored)}: its keypoints are estimated from clouds, whose "
                "noise and gaps are the camera's, `CameraConfig`."
            )
        cable = self.config.cable
        self.camera = DepthCamera(CameraConfig() if camera is None else camera, self.config.discretisation)
        self.tracker = Tracker(tracker_for(cable) if tracker is None else tracker)
        wanted = self.tracker.config.registration
        if wanted.n_keypoints != cable.n_keypoints or abs(wanted.length - cable.length) > 1e-9:
            raise ValueError(
                f"The tracker looks for {wanted.n_keypoints} keypoints on {wanted.length} m of cable, but the plant "
                f"has {cable.n_keypoints} on {cable.length} m: give both the same, for example by tracker_for(cable)."
            )
        self._lose_track()

    def _lose_track(self) -> None:
        self._state: TrackState | None = None
        self.track: Track | None = None
        self.cloud: Float[np.ndarray, "S 3"] = np.zeros((0, 3))
        self.lost = 0

    def reset(
        self, gripper_pose: Float[np.ndarray, "Q 3"], *, guess: Float[np.ndarray, "S 2"] | None = None
    ) -> Observation:
        """As `Plant.reset`; the tracker finds the new cable without a prior, and the camera's noise starts again."""
        self._lose_track()
        self.camera.reset()
        return super().reset(gripper_pose, guess=guess)

    def observe(self) -> Observation:
        """Observes one frame: the tracker's keypoints from the camera's cloud."""
        truth = super().observe()
        nodes, directions = self.nodes()
        self.cloud = self.camera.look(nodes, directions, truth.gripper_pose)
        if self._state is None:
            self._state, self.track = self.tracker.init(self.cloud, truth.gripper_pose)
        else:
            self._state, self.track = self.tracker.step(self._state, self.cloud, truth.gripper_pose)
        self.lost += int(self.track.status != Status.TRACKED)
        return dataclasses.replace(truth, keypoints=self.track.observed(truth.gripper_pose))


def tracker_for(cable: Cable) -> TrackerConfig:
    """A tracker's settings for a cable: the defaults, so that cables of one shape and any length are found alike.

    What depends on the cable's length L is in proportion to a power of it: the search, the bending weight and the area
    of outliers as L, L and L^2, the curvature as 1 / L, the weights of motion and structure as 1 / L^2. The scatter of
    the points and the distance at which one supports the fit are the camera's, and stay as they are.

    Raises:
        ValueError: the cable's keypoints are not evenly spaced.
    """
    if not np.allclose(cable.keypoint_arclength, np.linspace(0.0, cable.length, cable.n_keypoints)):
        raise ValueError(
            "The cable has keypoints at given arc lengths (marks), and a tracker finds evenly spaced ones. Give it a "
            "cable with marks=None and interpolate between them."
        )
    ratio = cable.length / RegistrationConfig.length
    return TrackerConfig(
        registration=RegistrationConfig(
            length=cable.length,
            n_keypoints=cable.n_keypoints,
            area=ratio**2 * RegistrationConfig.area,
            coherence=RegistrationConfig.coherence / ratio**2,
            structure=RegistrationConfig.structure / ratio**2,
            bending=ratio * RegistrationConfig.bending,
        ),
        max_curvature=TrackerConfig.max_curvature / ratio,
        max_search=ratio * TrackerConfig.max_search,
    )
