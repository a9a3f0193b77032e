"""Configuration of a learned model: its graph, the sizes of its networks, and the scales of its features."""

from __future__ import annotations

import dataclasses
from typing import Literal

from cablejax.limits import check
from cablejax.simulate.chain.statics import Statics

RECORDED = {"network": "gns", "frame": "grippers"}
"""What files record of a model beyond its `ModelConfig`: its kind, and the axes that it sees the cable in. Networks of
other kinds and in the world's axes are in experiments/rivals.py."""


@dataclasses.dataclass(frozen=True)
class Normalisation:
    """Typical sizes that features and output are divided by. `fit_normalisation` measures them on training data.

    Only scales, no offsets: every feature lives in a frame fixed to the grippers, where zero has a meaning.

    Attributes:
        position: keypoint positions in the grippers' frame [m].
        displacement: movement of a keypoint over one interval [m].
        linear_speed: gripper speed [m/s].
        angular_speed: gripper turning rate [rad/s].
        shortening: how much shorter a chord between connected keypoints is than the cable between them [m].
        residual: displacement beyond the prior's [m]: the unit of output and loss.
    """

    position: float = 0.25
    displacement: float = 0.02
    linear_speed: float = 0.02
    angular_speed: float = 0.1
    shortening: float = 0.003
    residual: float = 0.005

    def __post_init__(self):
        check(self, **{field.name: "positive" for field in dataclasses.fields(self)})


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """Static description of a learned model of one cable. The defaults are those of Wang et al., RA-L 2022.

    Attributes:
        n_keypoints: observed keypoints N, uniform in arc length, both ends held by grippers.
        length: free length of the cable [m].
        radius: connective radius [m], measured along the cable at rest.
        history: samples seen H = m + 1.
        conditioned: whether the cable's descriptor, `History.cable`, is an input of the network.
        interval: duration of one step [s].
        latent: size of latent node and edge vectors.
        hidden: width of the hidden layers of every network.
        hidden_layers: hidden layers of every network.
        message_passing: message-passing steps, each with weights of its own.
        prior: movement that the network corrects: "static", towards the frictionless resting shape after the command,
            see `cablejax.simulate.chain.statics`; "rigid", the interpolation of the grippers' motion; or "none".
        symmetric: whether the graph network's weights are tied so that mirrored or reversed cables move alike, see
            `cablejax.dynamics.symmetry`.
        normalisation: scales of features and output.
        statics: parameters of the static prior beyond the cable's length.
    """

    n_keypoints: int = 13
    length: float = 1.0
    radius: float = 0.2
    history: int = 6
    conditioned: bool = False
    interval: float = 1.0
    latent: int = 128
    hidden: int = 128
    hidden_layers: int = 2
    message_passing: int = 10
    prior: Literal["static", "rigid", "none"] = "static"
    symmetric: bool = False
    normalisation: Normalisation = Normalisation()
    statics: Statics = Statics()

    def __post_init__(self):
        check(
            self,
            "length",
            "history",
            "interval",
            n_keypoints="at_least_three",
            radius="length_scale",
            latent="width",
            hidden="width",
            hidden_layers="layers",
            message_passing="layers",
        )
        if self.prior not in (known := ("static", "rigid", "none")):
            raise ValueError(f"ModelConfig.prior is {self.prior!r}, expected one of {known}.")
        for name in ("conditioned", "symmetric"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"ModelConfig.{name} is {getattr(self, name)!r}, expected True or False.")
        if self.symmetric and (self.latent % 4 or self.hidden % 4):
            raise ValueError(
                f"ModelConfig.latent is {self.latent} and hidden {self.hidden}, expected multiples of 4: a symmetric "
                "network has as many channels for each of the group's four elements."
            )
        if self.radius < self.spacing:
            raise ValueError(
                f"ModelConfig.radius is {self.radius} m but keypoints are {self.spacing:.4g} m apart: no two would be "
                "connected. Use a larger radius or more keypoints."
            )

    @property
    def spacing(self) -> float:
        """Arc length between neighbouring keypoints [m]."""
        return self.length / (self.n_keypoints - 1)

    @property
    def node_features(self) -> int:
        """Number of features of a node.

        Position, past displacements, arc length, control input and grasp, prior displacement, distance from rest, and
        the cable's descriptor where the network is conditioned on it.
        """
        return 2 + 2 * (self.history - 1) + 2 + 7 + 2 + 2 + (2 if self.conditioned else 0)

    @property
    def edge_features(self) -> int:
        """Relative position, its length, signed arc length."""
        return 4
