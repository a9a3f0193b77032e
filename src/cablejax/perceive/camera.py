"""A depth camera that looks at a simulated cable on its table, by MuJoCo's ray casting, without a graphics library."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.ndimage import convolve

from cablejax.cable import Discretisation
from cablejax.limits import check, require, shown
from cablejax.simulate.composite import link_lengths, node_offsets

CENTRE_DEPTH = np.pi / 4
"""How far behind its visible surface the axis of a cylinder lies on average, seen from the side, in radii."""
_CLEAR, _LEAST, _VISIBLE = 2.5, 0.5, 0.75
"""Standard deviations of the range above the table at which heights that are taken for cable begin, and the parts of
the cable's diameter at which they begin at the earliest and at the latest."""
MARGIN = 0.01
"""Width [m] around the cable's outline in which rays are cast. All others meet the table, which has a formula."""


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """A camera over the table, its noise, and the threshold that separates the cable from the table.

    Attributes:
        centre: point of the table in the middle of the image (x, y) [m].
        distance: from there to the camera [m].
        tilt: angle between the line of sight and the vertical [rad].
        azimuth: direction in which the camera is displaced by the tilt [rad]; -pi/2 is towards -y.
        resolution: pixels (across, down). The default gives about 2,000 points of the reference cable.
        field_of_view: vertical opening angle [rad].
        range_noise: standard deviation of the measured range [m].
        dropout: probability that a pixel has no range.
        outliers: probability that a pixel has a range that is uniformly random in the last 5 % before the table.
        min_neighbours: of the eight pixels around it, how many must be taken for cable too; stray pixels have few.
        gripper_size: box at each gripper (along the cable, across, up) [m], which hides what is behind it. Its own
            points are left out, as a robot does that knows where its arms are.
        gripper_overlap: how far the boxes cover the ends of the cable [m].
        occluders: further boxes, each (x, y, z, half x, half y, half z) [m], which hide the cable.
        seed: of noise, dropout and outliers.
    """

    centre: tuple[float, float] = (0.0, 0.0)
    distance: float = 1.4
    tilt: float = 0.35
    azimuth: float = -np.pi / 2
    resolution: tuple[int, int] = (640, 480)
    field_of_view: float = 0.75
    range_noise: float = 0.002
    dropout: float = 0.05
    outliers: float = 0.001
    min_neighbours: int = 3
    gripper_size: tuple[float, float, float] = (0.05, 0.04, 0.08)
    gripper_overlap: float = 0.01
    occluders: tuple[tuple[float, float, float, float, float, float], ...] = ()
    seed: int = 0

    def __post_init__(self):
        check(
            self,
            distance="positive",
            field_of_view="angle",
            range_noise="noise",
            dropout="probability",
            outliers="probability",
            azimuth="finite",
            gripper_overlap="not_negative",
        )
        for x in self.centre:
            require(x, "origin", "CameraConfig.centre")
        for box in self.occluders:
            if len(box) != 6 or not np.isfinite(box).all() or min(box[3:]) <= 0:
                raise ValueError(
                    f"CameraConfig.occluders has {shown(box)}, expected (x, y, z, half x, half y, half z), finite and "
                    "with positive halves, in metres."
                )
        if not 0 <= self.min_neighbours <= 8:
            raise ValueError(
                f"CameraConfig.min_neighbours is {self.min_neighbours}, expected 0 to 8, a pixel's neighbours."
            )
        if not 0 <= self.tilt <= 1.2:
            raise ValueError(
                f"CameraConfig.tilt is {self.tilt} rad, expected 0 (straight above) to 1.2: a flatter view cannot show "
                "the table."
            )
        if min(self.resolution) < 2 or min(self.gripper_size) <= 0:
            raise ValueError(
                f"CameraConfig has resolution {self.resolution} and gripper_size {self.gripper_size}, expected at "
                "least 2 x 2 pixels and positive sizes."
            )


class DepthCamera:
    """The camera in front of one cable. `look` gives clouds; every call draws new noise.

    The scene is a model of its own with nothing but what can be seen, so that any simulated cable may be put into it.
    """

    def __init__(self, config: CameraConfig, chain: Discretisation):
        if config.range_noise > 0.5 * chain.cable.diameter:
            raise ValueError(
                f"A range noise of {1e3 * config.range_noise:g} mm hides a cable of {1e3 * chain.cable.diameter:g} mm "
                "on the table: expected at most half of that (CameraConfig.range_noise, --noise-mm)."
            )
        self.config, self.chain = config, chain
        self._axes, self._focal = _axes(config), 0.5 * config.resolution[1] / np.tan(0.5 * config.field_of_view)
        self.position = np.array([*config.centre, 0.0]) - config.distance * self._axes[0]
        self._rays = _rays(config, self._axes, self._focal)
        self.model = _scene(config, chain)
        self._data = mujoco.MjData(self.model)
        bodies = [self.model.body(i).name for i in range(self.model.nbody)]
        self._links = np.array([i for i, name in enumerate(bodies) if name.startswith("link")])
        self._on_cable = np.isin(self.model.geom_bodyid, self._links)
        self._to_middle = (0.5 * link_lengths(chain) - node_offsets(chain))[:, None]
        self.reset()

    def reset(self) -> None:
        """Starts the noise again from the seed."""
        self._random = np.random.default_rng(self.config.seed)

    def look(
        self,
        nodes: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        gripper_pose: Float[np.ndarray, "Q 3"],
    ) -> Float[np.ndarray, "S 3"]:
        """The cloud of all points classified as cable, shifted to the cable's axis [m], shape [S, 3]; S varies.

        Each point is moved on along its ray by the mean depth of a cylinder's axis behind its visible side, seen at a
        right angle. At other angles a mean error across the cable remains, a part of its radius: a ray that is oblique
        to the cable meets the axis deeper, and the part of the visible side that is near the table has no points. A
        shift along the cable is one that no registration can see.

        Args:
            nodes: middle of every link, for the two held ones the grasped end [m], as `Plant.nodes` gives them.
            directions: unit vectors along the links.
            gripper_pose: (x, y, theta) of both grippers.
        """
        config, random = self.config, self._random
        self._place(nodes, directions, gripper_pose)
        diameter, radius = self.chain.cable.diameter, 0.5 * self.chain.cable.diameter
        # what lies between these heights is taken for cable
        low = max(_LEAST * diameter, min(_CLEAR * config.range_noise, _VISIBLE * diameter))
        high = diameter + 3.0 * radius
        # Where there is only table the range has a formula; noise and outliers make cable out of few of its pixels.
        rays = self._rays
        to_table = -self.position[2] / rays[:, 2]
        error = config.range_noise * random.standard_normal(len(rays))
        strange = random.random(len(rays)) < config.outliers
        error[strange] -= to_table[strange] * 0.05 * random.random(int(strange.sum()))
        height = error * rays[:, 2]
        cast = np.flatnonzero(
            (self._near_cable(nodes) | ((height > low) & (height < high)))
            & (random.random(len(rays)) >= config.dropout)
        )
        geom, distance = self._cast(rays[cast])
        seen = (geom == 0) | self._on_cable[geom]
        cast, distance = cast[seen], distance[seen] + error[cast[seen]]
        points = self.position + distance[:, None] * rays[cast]
        between = (points[:, 2] > low) & (points[:, 2] < high)
        points = points[between][self._in_company(cast[between])]
        return points + CENTRE_DEPTH * radius * _unit(points - self.position)

    def _place(self, nodes: np.ndarray, directions: np.ndarray, pose: np.ndarray) -> None:
        """Puts cable and grippers where they are. Capsules lie along their z axes."""
        data, model, config = self._data, self.model, self.config
        middle = nodes + self._to_middle * directions
        for body, centre, direction in zip(self._links, middle, directions, strict=True):
            slot = model.body_mocapid[body]
            data.mocap_pos[slot] = centre
            mujoco.mju_quatZ2Vec(data.mocap_quat[slot], direction)
        length, _, height = config.gripper_size
        for index, outward in ((0, -1.0), (1, 1.0)):
            slot = model.body(f"gripper_{index}").mocapid[0]
            x, y, theta = pose[index]
            shift = outward * (0.5 * length - config.gripper_overlap)
            data.mocap_pos[slot] = [x + shift * np.cos(theta), y + shift * np.sin(theta), 0.5 * height]
            data.mocap_quat[slot] = [np.cos(theta / 2), 0.0, 0.0, np.sin(theta / 2)]
        mujoco.mj_kinematics(model, data)

    def _near_cable(self, nodes: np.ndarray) -> np.ndarray:
        """Pixels that may see the cable: those around its projection."""
        (across, down), (sight, right, below), focal = self.config.resolution, self._axes, self._focal
        steps = np.linspace(0.0, 1.0, 4, endpoint=False)[:, None, None]
        points = ((1.0 - steps) * nodes[:-1] + steps * nodes[1:]).reshape(-1, 3)
        offset = np.concatenate([points, nodes[-1:]]) - self.position
        depth = offset @ sight
        column = np.round(focal * (offset @ right) / depth + 0.5 * (across - 1)).astype(int)
        row = np.round(focal * (offset @ below) / depth + 0.5 * (down - 1)).astype(int)
        spacing = self.chain.link_length / 8.0
        reach = int(np.ceil(focal * (0.5 * self.chain.cable.diameter + MARGIN + spacing) / depth.min()))
        near = np.zeros((down, across), bool)
        for i, j in zip(row, column, strict=True):
            near[max(i - reach, 0) : max(i + reach + 1, 0), max(j - reach, 0) : max(j + reach + 1, 0)] = True
        return near.ravel()

    def _in_company(self, pixels: np.ndarray) -> np.ndarray:
        """Mask of the pixels with enough neighbours."""
        across, down = self.config.resolution
        image = np.zeros((down, across), np.int32)
        image.ravel()[pixels] = 1
        return convolve(image, np.ones((3, 3), np.int32), mode="constant").ravel()[pixels] > self.config.min_neighbours

    def _cast(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Geom that each ray meets first (the table is geom 0) and the distance [m]."""
        count = len(rays)
        geom, distance = np.zeros(count, np.int32), np.zeros(count)
        if count:
            mujoco.mj_multiRay(
                self.model, self._data, self.position, rays.ravel(), None, True, -1, geom, distance, None, count, 1e3
            )
        return geom, distance


def _axes(config: CameraConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors of the camera: line of sight, right and down in the image."""
    away = np.array(
        [
            np.sin(config.tilt) * np.cos(config.azimuth),
            np.sin(config.tilt) * np.sin(config.azimuth),
            np.cos(config.tilt),
        ]
    )
    right = np.array([-np.sin(config.azimuth), np.cos(config.azimuth), 0.0])
    return -away, right, np.cross(-away, right)


def _rays(config: CameraConfig, axes: tuple[np.ndarray, ...], focal: float) -> Float[np.ndarray, "pixels 3"]:
    """Unit direction of every pixel's ray, rows first; `focal` is the focal length [pixels]."""
    (across, down), (sight, right, below) = config.resolution, axes
    u = (np.arange(across) - 0.5 * (across - 1)) / focal
    v = (np.arange(down) - 0.5 * (down - 1)) / focal
    rays = sight + u[None, :, None] * right + v[:, None, None] * below
    rays = _unit(rays.reshape(-1, 3))
    if rays[:, 2].max() > -0.05:
        raise ValueError(
            f"A camera tilted by {config.tilt:.2f} rad with a field of view of {config.field_of_view:.2f} rad looks "
            "over the table's horizon: tilt it less or narrow its field of view."
        )
    return rays


def _scene(config: CameraConfig, chain: Discretisation) -> mujoco.MjModel:
    """Table, one capsule per link, a box per gripper, and occluders; bodies that move are mocap bodies."""
    spec = mujoco.MjSpec()
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1])
    for index, length in enumerate(link_lengths(chain)):
        body = spec.worldbody.add_body(name=f"link_{index}", mocap=True)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[chain.cable.diameter / 2, length / 2, 0])
    for index in range(2):
        body = spec.worldbody.add_body(name=f"gripper_{index}", mocap=True)
        body.add_geom(type=box, size=[0.5 * side for side in config.gripper_size])
    for x, y, z, *half in config.occluders:
        spec.worldbody.add_geom(type=box, pos=[x, y, z], size=half)
    return spec.compile()


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
