"""What to record next: motions that a cable bears, and the one that tells two explanations apart."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.diagnose import LIBRARY, explanation
from cablejax.diagnose.next_motion import next_motion
from cablejax.diagnose.planar import physics_of
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.safe_motions import INTERVAL, safe_motions, starting_pose

CONFIG = Discretisation(n_links=9)
EFFECTS = {effect.name: effect for effect in LIBRARY}
ARCH = np.array([[0.0, 0.0, 0.4], [0.85, 0.0, -0.4]])
NAMES = {"mirror", "translation", "ramp_hold", "overload_return", "taut", "shifted_repeat"}
NOISE = np.full(CONFIG.cable.n_keypoints, 1e-3)


@functools.cache
def log_motion() -> Playback:
    """One episode: the grippers close in by a tenth of the cable's length."""
    poses = np.repeat(ARCH[None], 300, axis=0)
    poses[:, 1, 0] -= 0.1 * np.linspace(0, 1, 300)
    return Playback.of_motion(CONFIG, poses[None], None, np.full(1, INTERVAL))


def one(name, *values, variant=0):
    return explanation((EFFECTS[name], variant, values))


@pytest.mark.parametrize(
    "first",
    [
        ARCH,
        ARCH + np.array([2.0, -1.0, 0.0]),
        np.array([[0.0, 0.0, np.pi / 2 - 0.2], [0.0, 0.97, np.pi / 2 + 0.1]]),
        np.array([[0.0, 0.0, 0.0], [0.999, 0.0, 0.0]]),
        np.array([[0.0, 0.0, 1.2], [0.4, 0.0, 1.2]]),
    ],
    ids=["arch", "elsewhere", "turned and leaning right", "beyond the limit of taut", "both grippers turned one way"],
)
@pytest.mark.parametrize("length", [1.0, 0.6])
def test_motions_keep_to_their_limits(first, length):
    config = Discretisation(Cable(length=length), n_links=9)
    first = first * [length, length, 1.0]
    motions = safe_motions(config, first)
    assert {"translation", "ramp_hold", "overload_return"} <= set(motions) <= NAMES
    for poses in motions.values():
        distance = np.linalg.norm(poses[:, 1, :2] - poses[:, 0, :2], axis=-1) / length
        assert distance.min() >= 0.15 and distance.max() <= 0.995
        twist = np.diff(poses, axis=0) / INTERVAL * [1.0, 1.0, 0.15]
        assert np.linalg.norm(twist, axis=-1).max() <= 0.05 * (1 + 1e-6)
        assert np.abs(np.diff(poses[-10:], axis=0)).max() == 0.0


def test_motions_start_where_the_log_did():
    motions = safe_motions(CONFIG, ARCH)
    assert set(motions) == NAMES
    for name, poses in motions.items():
        turned = ARCH * [1, 1, -1] if name == "mirror" else ARCH
        np.testing.assert_allclose(poses[0], turned, atol=1e-12)


def test_order_of_the_episodes_does_not_choose_the_start():
    near, far = np.repeat(ARCH[None], 5, axis=0) * [0.8, 1, 1], np.repeat(ARCH[None], 5, axis=0)
    for order in ([near, far], [far, near]):
        np.testing.assert_array_equal(starting_pose(np.stack(order)), ARCH)


def test_yield_shows_where_the_cable_is_bent_most():
    following = next_motion(log_motion(), [one("plasticity", 7.0, 0.3), explanation()], NOISE)
    assert following.motion == "overload_return"
    assert following.separates == ("plasticity", "nominal")
    assert following.separation == max(following.alternatives.values()) > 1.0


def test_obstacle_shows_where_the_cable_has_not_been():
    beyond = one("obstacle", 0.42, 0.49, 0.03)
    following = next_motion(log_motion(), [explanation(), beyond], NOISE)
    assert following.motion in ("shifted_repeat", "translation")
    still = [size for name, size in following.alternatives.items() if name in ("mirror", "taut")]
    assert max(still) < 0.1 * following.separation


def test_separation_is_the_difference_in_noise_units():
    stiff, curved = one("stiffness_profile", 0.3, 0.3, 0.4), one("intrinsic_curvature", 0.3, 0.3, 1.0)
    quiet = next_motion(log_motion(), [stiff, curved], NOISE)
    loud = next_motion(log_motion(), [curved, stiff], 2 * NOISE)
    for name, value in quiet.alternatives.items():
        assert loud.alternatives[name] == pytest.approx(0.5 * value, rel=1e-3)
    poses = safe_motions(CONFIG, log_motion().gripper_pose[0, 0], 300)[quiet.motion]
    motion = Playback.of_motion(CONFIG, poses[None], None, np.full(1, INTERVAL))
    a, b = motion.keypoints([physics_of(c, motion.believed, CONFIG) for c in (stiff, curved)])
    assert quiet.separation == pytest.approx(np.sqrt(np.mean((a - b) ** 2)) / 1e-3, rel=1e-2)


def test_single_explanation_is_sharpened_where_it_is_seen_best():
    slack = one("axial_stretch", 20.0)
    following = next_motion(log_motion(), [slack], NOISE)
    assert following.separates == ()
    assert following.motion == "taut"


def test_no_explanation_is_refused():
    with pytest.raises(ValueError, match="at least one fitted explanation"):
        next_motion(log_motion(), [], NOISE)


def test_first_pose_has_to_be_two_poses():
    with pytest.raises(ValueError, match="expected two finite poses"):
        safe_motions(CONFIG, np.zeros((3, 2)))
