"""Compares how each effect of the library changes the keypoints in the contact plant and in the planar chain.

    python experiments/14_staged_effects.py --out docs/results/staged_effects.md      # two minutes or three
    python experiments/14_staged_effects.py --only obstacle

The plant is C MuJoCo in space with contacts, the chain is the simulator by which a diagnosis explains logs. They differ
without any effect too, so each is compared with itself: the keypoints of one motion with the effect less those without.
The table has the sizes of both changes (root mean square over all samples and keypoints), the plant's size over the
chain's, and the cosine of the angle between them as vectors.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.cable import Discretisation
from cablejax.diagnose.playback import Playback
from cablejax.effects.arms import executed
from cablejax.effects.given import GivenEffect, parse_effect, with_effects
from cablejax.simulate.plant import Plant, PlantConfig
from pages import markdown_table, page_of_results, publish

LINKS = 24
START = np.array([[-0.38, 0.0, 0.5], [0.38, 0.0, -0.5]])
TWISTS = np.array(
    [
        [[0.04, 0.02, -0.15], [-0.04, 0.03, 0.15]],
        [[-0.03, 0.04, 0.2], [0.0, 0.04, 0.1]],
        [[0.02, -0.05, 0.1], [0.03, -0.05, -0.2]],
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    ]
)
"""Commands [m/s, rad/s], each held for `INTERVAL`."""
INTERVAL, SAMPLES = 1.5, 10
"""Duration of a command [s], and observations during it."""
SLOW = np.repeat(0.08 * TWISTS[:1], 3, axis=0)
"""Commands that drag the cable so slowly that it sticks and slips."""
EFFECTS = (
    "bending_stiffness:ratio=4",
    "stiffness_profile:centre_m=0.3,width_m=0.2,ratio=0.3",
    "intrinsic_curvature:centre_m=0.6,width_m=0.3,curvature_per_m=2",
    "plasticity:yield_curvature_per_m=3,hardening=0.3",
    "bending_hysteresis:moment_n_m=0.02,transition_curvature_per_m=0.5",
    "bending_damping:time_s=1",
    "axial_stretch:stiffness_n=20",
    "table_friction:coefficient=0.3",
    "table_friction:coefficient=0.5,static_excess=1",
    "friction_patch:x_m=0,y_m=0.3,radius_m=0.15,coefficient=0.5",
    "viscous_drag:coefficient_n_s_per_m2=5",
    "gravity_tilt:angle_rad=0.1,direction_rad=1",
    "linear_density:ratio=3",
    "lumped_mass:centre_m=0.4,mass_kg=0.05",
    "gripper_slip:gripper=0,time_s=3,distance_m=-0.02",
    "gripper_slip:gripper=1,time_s=3,distance_m=0.02",
    "gripper_rotation_offset:gripper=1,angle_rad=0.15",
    "gripper_compliance:gripper=0,stiffness_n_m_per_rad=0.3",
    "actuation_gain:gain=0.9",
    "actuation_lag:time_s=0.4,delay_s=0.15",
    "camera_similarity:scale=1.02,angle_rad=0.02,x_m=0.01,y_m=-0.01",
    "keypoint_bias:index=4,offset_m=0.01",
    "keypoint_bias:index=4,across=1,offset_m=0.01",
    "camera_lag:time_s=0.3",
    "obstacle:x_m=0,y_m=0.4,radius_m=0.03",
)


@dataclasses.dataclass(frozen=True)
class Change:
    """What an effect does to the keypoints of one motion.

    Attributes:
        effect: its name and parameters.
        plant, chain: with the effect less without it [m], shape [T, N, 2].
    """

    effect: GivenEffect
    plant: Float[np.ndarray, "T N 2"]
    chain: Float[np.ndarray, "T N 2"]

    @property
    def sizes(self) -> tuple[float, float]:
        """Root mean square of the plant's and the chain's change [mm]."""
        return _size(self.plant), _size(self.chain)

    @property
    def similarity(self) -> float:
        """Cosine of the angle between both changes."""
        return float((self.plant * self.chain).sum() / np.sqrt((self.plant**2).sum() * (self.chain**2).sum()))

    @property
    def ratio(self) -> float:
        """The plant's size over the chain's."""
        return self.sizes[0] / self.sizes[1]


def changes(
    effects: tuple[GivenEffect, ...],
    twists: Float[np.ndarray, "C 2 3"] = TWISTS,
    without: tuple[GivenEffect, ...] = (),
) -> list[Change]:
    """Each effect in both simulators, one at a time, against what is there `without` it."""
    every: list[tuple[GivenEffect, ...]] = [without, *((effect,) for effect in effects)]
    plant = np.stack([_in_plant(given, twists) for given in every])
    chain = np.stack(_in_chain(every, twists))
    return [Change(effect, plant[i + 1] - plant[0], chain[i + 1] - chain[0]) for i, effect in enumerate(effects)]


def _in_plant(effects: tuple[GivenEffect, ...], twists: Float[np.ndarray, "C 2 3"]) -> Float[np.ndarray, "T N 2"]:
    chain = Discretisation(n_links=LINKS, dimension=3, timestep=0.005)
    plant = Plant(PlantConfig(discretisation=chain, effects=effects))
    observations = [plant.reset(START)]
    for twist in twists:
        observations += plant.record(twist, INTERVAL, samples=SAMPLES)
    return np.stack([observation.keypoints for observation in observations])


def _in_chain(
    every: list[tuple[GivenEffect, ...]], twists: Float[np.ndarray, "C 2 3"]
) -> list[Float[np.ndarray, "T N 2"]]:
    chain, dt = Discretisation(n_links=LINKS), INTERVAL / SAMPLES
    moves = np.repeat(twists, SAMPLES, axis=0) * dt
    commanded = np.concatenate([START[None], START + np.cumsum(moves, axis=0)])
    motion = Playback.of_motion(chain, commanded[None], None, np.array([dt]), largest_step=0.01)
    physics = [with_effects(motion.believed, effects, chain) for effects in every]
    poses = [np.asarray(executed(p, commanded, dt)) for p in physics]
    # the arms' effects move the grippers; all others are replayed at once
    exact = [np.allclose(pose, commanded) for pose in poses]
    together = iter(motion.keypoints([p for p, same in zip(physics, exact, strict=True) if same])[:, 0])
    return [
        next(together)
        if same
        else Playback.of_motion(chain, pose[None], None, np.array([dt]), largest_step=0.01).keypoints([p])[0, 0]
        for p, pose, same in zip(physics, poses, exact, strict=True)
    ]


def _size(change: Float[np.ndarray, "T N 2"]) -> float:
    return float(1e3 * np.sqrt((change**2).sum(axis=-1).mean()))


def page(table: Sequence[Change]) -> str:
    """The page: the table, and two cases of friction that it does not show."""
    excess = parse_effect("table_friction:coefficient=0.3,static_excess=1")
    (slow,) = changes((excess,), SLOW, (parse_effect("table_friction:coefficient=0.3"),))
    (rough,) = changes((parse_effect("table_friction:coefficient=5"),))
    return page_of_results(
        "Every effect in the plant and in the chain",
        "`python experiments/14_staged_effects.py --out docs/results/staged_effects.md`",
        [
            "The table compares plant and chain by the root mean square change of 13 keypoints that the effect causes "
            f"in one motion of {len(TWISTS) * INTERVAL:g} s ({LINKS} links; one run per row, without noise). "
            "Similarity is the cosine of the angle between both changes. A slow test requires a similarity of 0.95 and "
            "sizes within 20 % in every row.",
            "",
            *markdown_table(rows_of(table)),
            "",
            "This motion is too fast for the cable to stick, so the static excess hardly shows. Dragged at "
            f"{1e3 * SLOW[..., :2].max():.0f} mm/s, the excess alone moves the keypoints by {slow.sizes[0]:.2g} mm in "
            f"the plant and by {slow.sizes[1]:.2g} mm in the chain, at a similarity of {slow.similarity:.3f}. Plant "
            "and chain disagree at friction coefficients far above 1: at 5, changes are "
            f"{rough.sizes[0]:.0f} mm in the plant and {rough.sizes[1]:.0f} mm in the chain, at a similarity of "
            f"{rough.similarity:.2f}.",
        ],
    )


def rows_of(table: Sequence[Change]) -> list[list[str]]:
    """Cells by effect, below their head."""
    head = ["effect", "plant, mm", "chain, mm", "plant over chain", "similarity"]
    return [
        head,
        *(
            [f"`{one.effect}`", *(f"{size:.2f}" for size in one.sizes), f"{one.ratio:.2f}", f"{one.similarity:.3f}"]
            for one in table
        ),
    ]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names of effects; all by default")
    parser.add_argument("--out", type=pathlib.Path, help="write the page there")
    options = parser.parse_args(arguments)
    effects = tuple(parse_effect(text) for text in EFFECTS)
    if options.only:
        effects = tuple(effect for effect in effects if effect.name in options.only)
    table = changes(effects)
    if options.out is None:
        print("\n".join(markdown_table(rows_of(table))))
    else:
        publish(page(table), options.out)


if __name__ == "__main__":
    main()
