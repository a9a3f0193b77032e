"""Replays of one log under many physics at once."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from cablejax.cable import Cable, Discretisation
from cablejax.cores import available_cores
from cablejax.effects.camera import seen_by_camera
from cablejax.effects.physics import Physics, nominal_physics
from cablejax.simulate.chain.replay import LARGEST_STEP, SETTLING, Chain
from cablejax.simulate.chain.state import chain_nodes
from cablejax.simulate.compile import compiler_options
from cablejax.simulate.equilibrium import angles_of_keypoints, equilibrium_state
from cablejax.simulate.keypoints import marked_keypoints

# Cables that one compiled call replays at once, at most.
_ROWS = 24
# Each time a chain is turned towards keypoints it leaves at most half of what is between them.
_TURNS = 4
# Half waves along the cable of which its first shape may differ from that at rest.
_WAVES = 7


@dataclasses.dataclass(frozen=True)
class Playback:
    """A log's gripper motions, ready to be replayed.

    Attributes:
        config: nominal cable and resolution.
        gripper_pose: measured, theta continuous, the last one held over the padding, shape [E, T, 2, 3].
        angles: of the cable at the first pose, from which a replay lets it settle [rad], shape [E, n].
        interval: between samples [s], shape [E].
        believed: physics of the cable without any effect.
        largest_step: longest time step [s].
        length: samples of each episode without the padding, over which the last keypoints are repeated, shape [E];
            None = there is no padding.
        rows: cables that one compiled call replays at once; fewer for few replays by a program of their own.
        settling: for how long the cable settles before the first pose [s]; 0 = it begins as it was first seen.
    """

    config: Discretisation
    gripper_pose: Float[np.ndarray, "E T 2 3"]
    angles: Float[np.ndarray, "E n"]
    interval: Float[np.ndarray, "E"]
    believed: Physics
    largest_step: float = LARGEST_STEP
    length: Int[np.ndarray, "E"] | None = None
    rows: int = _ROWS
    settling: float = SETTLING

    @property
    def arclength(self) -> Float[np.ndarray, "N"]:
        """Of the keypoints, from gripper 0 [m]."""
        return self.config.cable.keypoint_arclength + np.asarray(self.believed.bias_along, float)

    @classmethod
    def of_motion(
        cls,
        config: Discretisation,
        gripper_pose: Float[np.ndarray, "E T 2 3"],
        first_keypoints: Sequence[Float[np.ndarray, "N 2"] | None] | None,
        interval: Float[np.ndarray, "E"],
        largest_step: float = LARGEST_STEP,
        *,
        believed: Physics | None = None,
    ) -> Playback:
        """Begins every episode near how its first keypoints were seen, or with a gentle arch where there are none.

        A cable whose damping is as usual has settled before the replay begins; one that takes long to settle, as by the
        effect `bending_damping`, may not have done so before it was first seen.

        Without `believed` the cable is that of `config` on a level table, keypoints uniform along it.
        """
        shapes = [None] * len(gripper_pose) if first_keypoints is None else first_keypoints
        poses = np.asarray(gripper_pose, np.float64)[:, 0]
        angles = [_first_angles(config, pose, shape) for pose, shape in zip(poses, shapes, strict=True)]
        return cls(
            config=config,
            gripper_pose=np.asarray(gripper_pose, np.float32),
            angles=np.asarray(angles, np.float32),
            interval=np.asarray(interval, np.float32),
            believed=nominal_physics(config) if believed is None else believed,
            largest_step=largest_step,
        )

    def keypoints(
        self, physics: Sequence[Physics], episodes: Sequence[int] | np.ndarray | None = None
    ) -> Float[np.ndarray, "P E T N 2"]:
        """Keypoints as the camera would have seen them under each physics [m]; NaN where a simulation diverged.

        Args:
            physics: of one cable each.
            episodes: to replay; None = all.
        """
        chosen = np.arange(len(self.gripper_pose)) if episodes is None else np.asarray(episodes, int)
        n_physics, n_samples = len(physics), self.gripper_pose.shape[1]
        length = np.full(len(self.gripper_pose), n_samples) if self.length is None else self.length
        stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf, np.float32) for leaf in leaves]), *physics)
        substeps = max(1, math.ceil(float(self.interval.max()) / self.largest_step - 1e-6))
        geometry = Discretisation(
            Cable(
                length=self.config.cable.length,
                diameter=self.config.cable.diameter,
                n_keypoints=self.config.cable.n_keypoints,
            ),
            n_links=self.config.n_links,
            friction_speed=self.config.friction_speed,
        )
        points = np.empty((n_physics, len(chosen), n_samples, self.config.cable.n_keypoints, 2), np.float32)

        def one_chunk(rows: np.ndarray, with_contact: bool) -> None:
            full = np.concatenate([rows, np.broadcast_to(rows[:1], (self.rows - len(rows), 2))])
            p, e = full[:, 0], chosen[full[:, 1]]
            batch = jax.tree.map(lambda leaf: leaf[p], stacked)
            replay = _compiled(Chain(geometry, with_contact), substeps)
            settling = np.float32(self.settling)
            result = replay(batch, self.angles[e], self.gripper_pose[e], self.interval[e], length[e].max(), settling)
            points[rows[:, 0], rows[:, 1]] = np.asarray(result)[: len(rows)]

        touching, longest_first = stacked.obstacle_radius > 0, np.argsort(-length[chosen], kind="stable")
        with concurrent.futures.ThreadPoolExecutor(available_cores()) as pool:
            tasks = []
            for with_contact in (False, True):
                which = np.flatnonzero(touching == with_contact)
                # episodes of one length together: a call takes as long as its longest
                rows = np.stack(np.meshgrid(longest_first, which, indexing="ij")[::-1], axis=-1).reshape(-1, 2)
                tasks += [
                    pool.submit(one_chunk, rows[begin : begin + self.rows], with_contact)
                    for begin in range(0, len(rows), self.rows)
                ]
            for task in tasks:
                task.result()
        return points


def _first_angles(
    config: Discretisation, pose: Float[np.ndarray, "2 3"], keypoints: Float[np.ndarray, "N 2"] | None
) -> Float[np.ndarray, "n"]:
    """Theta of the first link and joint angles [rad] of the cable through keypoints at uniform marks.

    They are those of the resting cable, turned until its keypoints lie as these do: what keypoints do not tell of a
    bend between them stays as it is at rest. What is left of an earlier motion is smooth along the cable: only that of
    the difference to rest is believed, for a cable that hardly settles would keep every error of the first keypoints.
    """
    angles = np.array(equilibrium_state(config, pose, guess=keypoints).qpos[2:], np.float64)
    if keypoints is None:
        return angles
    config = dataclasses.replace(config, cable=dataclasses.replace(config.cable, marks=None))
    physics = nominal_physics(config)

    def points() -> Float[np.ndarray, "N 2"]:
        nodes, unit = map(np.asarray, chain_nodes(config, jnp.asarray(angles, jnp.float32), jnp.zeros(())))
        return np.asarray(marked_keypoints(config, physics, pose[0, :2] + nodes, unit))

    rest = points()
    waves = np.sin(np.pi * np.outer(np.linspace(0.0, 1.0, len(rest)), np.arange(1, _WAVES + 1)))
    smooth = rest + waves @ np.linalg.lstsq(waves, keypoints - rest)[0]
    seen = angles_of_keypoints(config, pose, smooth)
    for _ in range(_TURNS):
        angles[1:] += seen - angles_of_keypoints(config, pose, points())
    return angles


@functools.lru_cache(maxsize=16)
def _compiled(chain: Chain, n_substeps: int):
    def one(physics, angles, pose, interval, n_samples, settling):
        points = chain.rollout(
            physics, angles, pose, interval, n_substeps=n_substeps, n_samples=n_samples, settling=settling
        )
        return seen_by_camera(physics, points, interval)

    # runs far longer than it compiles: worth LLVM's optimisations where XLA_FLAGS go without them
    optimised = {"xla_backend_optimization_level": 3}
    return jax.jit(jax.vmap(one, in_axes=(0, 0, 0, 0, None, None)), compiler_options=compiler_options() | optimised)
