"""How a replay begins: at rest, or, where the cable takes long to settle, as it was first seen."""

import dataclasses

import numpy as np
import pytest

from cablejax.diagnose import diagnose
from cablejax.diagnose.playback import Playback
from diagnose_cases import CABLE, arrived, clean, log_of, noise, playback

SLOW_S = 10.0
SLOW = ("bending_damping", (SLOW_S / CABLE.damping_time,))
LINKS = 33
CURVED = ("intrinsic_curvature", (0.6, 0.3, 2.0))


def first(damping_s: float, shapes: list[np.ndarray] | None) -> np.ndarray:
    """Keypoints [m] of the first sample of each motion, of a cable that was first seen in these shapes."""
    still = playback(LINKS)
    seen = Playback.of_motion(still.config, still.gripper_pose[:, :2], shapes, still.interval, still.largest_step)
    physics = dataclasses.replace(seen.believed, damping_time=np.float32(damping_s))
    return seen.keypoints([physics])[0, :, 0]


def test_a_cable_that_settles_soon_begins_at_rest():
    rest = first(CABLE.damping_time, None)
    np.testing.assert_allclose(first(CABLE.damping_time, list(clean(CURVED, n_links=LINKS)[:, 0])), rest, atol=1e-5)


def test_a_cable_that_settles_slowly_begins_as_it_was_seen():
    rest = first(CABLE.damping_time, None)
    # at rest it stays, however slow it is
    np.testing.assert_allclose(first(SLOW_S, list(rest)), rest, atol=1e-5)
    bent = clean(CURVED, n_links=LINKS)[:, 0]
    assert np.abs(bent - rest).max() > 0.01
    np.testing.assert_allclose(first(SLOW_S, list(bent)), bent, atol=6e-4)


def test_a_keypoint_off_its_place_is_not_how_a_slow_cable_lies():
    # a cable that hardly settles would keep the error, and explain it in all later samples
    rest = first(CABLE.damping_time, None)
    wrong = rest.copy()
    wrong[:, [3, 9], 1] += 0.006
    assert np.abs(first(SLOW_S, list(wrong)) - rest).max() < 0.5 * 0.006


def unsettled_log(seed: int = 0):
    points = arrived(SLOW, n_links=LINKS)
    return log_of(points + noise(points.shape, 0.5, seed))


@pytest.mark.slow
def test_slow_damping_is_named_alone_where_the_cable_had_not_settled():
    found = diagnose(unsettled_log())
    (effect,) = found.effects
    low, high = effect.parameters["time_s"].ci90
    assert found.verdict == "named" and effect.name == "bending_damping"
    assert low <= SLOW_S <= high and high / low < 2.5
