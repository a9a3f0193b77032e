"""What to record next: motions that a cable bears, and the one that tells two explanations apart."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

import diagnose_cases
import spatial_cases
from cablejax.cable import Cable, Discretisation
from cablejax.diagnose import LIBRARY, Calibration, Explanation, explanation
from cablejax.diagnose.diagnosis import NextMotion
from cablejax.diagnose.motion_bounds import Bounds, BoundsError, cable_beyond, grippers_beyond
from cablejax.diagnose.motion_design import DesignConfig
from cablejax.diagnose.motion_file import write_motion
from cablejax.diagnose.motion_judge import Judge
from cablejax.diagnose.next_motion import next_motion, require_some_motion
from cablejax.diagnose.planar import physics_of
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.safe_motions import INTERVAL, safe_motions, starting_pose
from cablejax.effects.given import parse_effect
from cablejax.gaplog import read_gap_log
from cablejax.simulate.plant import Plant, PlantConfig
from cablejax.simulate.play import play

CONFIG = Discretisation(n_links=17)
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


@pytest.mark.parametrize("first", [[[0, 0, 1.29], [0.63, 0, 2.15]], [[0, 0, 1.9], [0.83, 0, 0.84]]])
def test_cables_of_any_length_bear_the_same_motions(first):
    """Relative to their length: a short cable may be bent more sharply."""
    borne = []
    for length in (0.4, 1.0, 2.5):
        config = Discretisation(Cable(length=length), n_links=9)
        borne.append(set(safe_motions(config, np.array(first) * [length, length, 1.0])))
    assert borne[0] == borne[1] == borne[2]


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


def judge_of(*explanations: Explanation, deviation: float = 0.1, **settings) -> Judge:
    """All as probable, every parameter known to a tenth of its prior's width."""
    roots = tuple(deviation * np.eye(len(each.z)) for each in explanations)
    chances = np.full(len(explanations), 1 / len(explanations))
    return Judge(log_motion(), explanations, chances, roots, NOISE, **settings)


def test_yield_shows_where_the_cable_is_bent_most():
    following = next_motion(judge_of(one("plasticity", 7.0, 0.3), explanation()))
    assert following.motion == "overload_return" and following.designed is None
    assert following.separates == ("plasticity", "nominal") and set(following.shapes) == set(following.separates)
    assert following.information == max(following.alternatives.values()) > 0.1
    assert following.doubt == pytest.approx(np.log(2))
    assert following.prior == pytest.approx(0.5) and 0.5 < following.certainty <= 1


@pytest.mark.slow
def test_obstacle_shows_where_the_cable_has_not_been():
    following = next_motion(judge_of(explanation(), one("obstacle", 0.42, 0.49, 0.03)))
    assert following.motion in ("shifted_repeat", "translation")
    still = [size for name, size in following.alternatives.items() if name in ("mirror", "taut")]
    assert max(still) < 0.1 * following.information


def test_information_is_that_of_the_predictions():
    pair = one("stiffness_profile", 0.3, 0.3, 0.4), one("stiffness_profile", 0.3, 0.3, 0.5)
    judge = judge_of(*pair, deviation=0.0)
    poses = safe_motions(CONFIG, ARCH, 300)["ramp_hold"]
    (judged,) = judge.judged([poses])
    motion = Playback.of_motion(CONFIG, poses[None], None, np.full(1, INTERVAL))
    a, b = motion.keypoints([physics_of(c, motion.believed, CONFIG) for c in pair])[:, 0].astype(float)
    np.testing.assert_allclose(judged.keypoints, [a, b], atol=1e-6)
    # without the clamps' error two explanations without parameters have a Bhattacharyya distance of d^2 / 8
    nominal = motion.keypoints([motion.believed])[0, 0].astype(float)
    gap = np.sqrt(0.5 * ((a - nominal) ** 2).mean() + 0.5 * ((b - nominal) ** 2).mean())
    temper = Calibration().temper(np.array([gap]), 1e-3, a.size)[0]
    distance = ((a - b) ** 2).sum() / 1e-6 / temper / 8
    assert 0 < judged.information < np.log(2) - np.log(1 + np.exp(-distance))
    assert judged.information == pytest.approx(np.log(2) - np.log(1 + np.exp(-distance)), rel=0.5)


def test_wide_posterior_leaves_less_to_tell():
    pair = one("intrinsic_curvature", 0.3, 0.3, 0.3), one("intrinsic_curvature", 0.3, 0.3, 0.6)
    judge = judge_of(*pair)
    # of centre, width and size only the size is open
    sharp, wide = (next_motion(dataclasses.replace(judge, roots=(np.diag([0.0, 0.0, d]),) * 2)) for d in (1e-3, 1.0))
    assert wide.information < 0.5 * sharp.information


def test_explanations_that_do_the_same_are_inseparable_once_a_motion_was_searched_for():
    twice = one("bending_stiffness", 0.5), one("bending_stiffness", 0.501)
    library = next_motion(judge_of(*twice))
    assert library.faint and not library.inseparable
    assert next_motion(judge_of(*twice), DesignConfig(simulations=500, patience=2)).inseparable


def test_single_explanation_is_sharpened_where_it_is_seen_best():
    following = next_motion(judge_of(one("axial_stretch", 500.0)))
    assert following.separates == () and following.certainty is None and not following.inseparable
    assert following.motion == "taut" and following.information > 0


def test_nothing_is_left_to_find_out_without_parameters():
    assert next_motion(judge_of(explanation())) is None


def test_bounds_that_exclude_every_motion_say_which_and_how_many():
    judge = judge_of(one("axial_stretch", 20.0), bounds=Bounds(workspace=((5.0, 5.0), (6.0, 6.0))))
    with pytest.raises(BoundsError, match=r"of the 6 motions tried, workspace excludes 6\. Relax the first"):
        next_motion(judge)
    with pytest.raises(BoundsError, match="workspace excludes"):
        require_some_motion(log_motion(), NOISE, judge.bounds)


@functools.cache
def designed() -> tuple[Judge, NextMotion]:
    """Stiffness or friction, next to a disc, in a narrow workspace."""
    bounds = Bounds(
        workspace=((-0.15, -0.25), (1.1, 0.6)), keep_out=((0.4, -0.2, 0.05),), bend_radius=0.05, duration=25.0
    )
    judge = judge_of(one("bending_stiffness", 0.4), one("table_friction", 2.5, 0.0), bounds=bounds)
    return judge, next_motion(judge, DesignConfig(simulations=1500, patience=5))


@pytest.mark.slow
def test_designed_motion_is_worth_at_least_the_best_safe_one():
    judge, following = designed()
    assert following.motion == "designed" and following.ended in ("clear", "settled", "budget")
    assert following.information == max(following.alternatives.values())
    safe = next_motion(judge)
    assert following.information > safe.information
    poses, interval = following.designed
    assert interval * (len(poses) - 1) <= 25.0


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["bending_stiffness:ratio=0.4", "table_friction:coefficient=0.25"])
def test_designed_motion_keeps_all_bounds_when_it_is_executed(effect, tmp_path):
    judge, following = designed()
    log = diagnose_cases.record()
    path = write_motion(tmp_path, following, log)
    commands = read_gap_log(path)
    plant = Plant(
        PlantConfig(
            discretisation=Discretisation(n_links=16, dimension=3, timestep=0.005), effects=(parse_effect(effect),)
        )
    )
    done = play(plant, commands, source="contact plant")
    assert done.meta["motion"] == ["designed"] and done.hold[0, -1] and not done.hold[0].all()
    poses, points = done.gripper_pose[0].astype(float), done.keypoints.astype(float)
    np.testing.assert_allclose(poses, following.poses, atol=2e-5)
    assert grippers_beyond(judge.bounds, CONFIG, following.poses, INTERVAL) == {}
    assert cable_beyond(judge.bounds, CONFIG, poses, points) == {}


def test_files_of_a_motion_agree(tmp_path):
    _, following = designed()
    commands = read_gap_log(write_motion(tmp_path, following, diagnose_cases.record()))
    table = np.loadtxt(tmp_path / "next_motion.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, 0], commands.time[0], atol=1e-6)
    np.testing.assert_allclose(table[:, 1:].reshape(-1, 2, 3), commands.gripper_pose[0], atol=1e-6)
    moved = commands.gripper_pose[0, 0] + INTERVAL * np.cumsum(commands.gripper_command[0, :-1], axis=0)
    np.testing.assert_allclose(moved, following.poses[1:], atol=1e-5)
    assert np.isnan(commands.keypoints).all()
    assert write_motion(tmp_path, None, diagnose_cases.record()) is None and not list(tmp_path.iterdir())


def test_motion_of_a_cable_in_space_is_not_played(tmp_path):
    log = spatial_cases.recording()
    with pytest.raises(ValueError, match="expected"):
        play(Plant(PlantConfig()), log, source="plant")


def test_first_pose_has_to_be_two_poses():
    with pytest.raises(ValueError, match="first has shape"):
        safe_motions(CONFIG, np.zeros((3, 2)))
