"""The generator of the blind check: its rod, its effects, its labels."""

import collections
import dataclasses
import json

import numpy as np
import pytest

from blind.cases import make_case
from blind.effects import EFFECTS, SPECIFIED, Setup
from blind.motions import FAMILIES, INTERVAL, Commands, draw_motion, draw_motions
from blind.observe import Camera, lagged, observe
from blind.plan import B_EFFECTS, C_EFFECTS, Case, development_plan, stored_plan
from blind.record import FRAME, FRAMES, context_of, family_a, gap, quick, record
from blind.rod import Motion, RodConfig, simulate
from blind.severity import search
from blind.store import checked_labels, is_done, publish_hashes, read_cases, write_case
from blind.unknown import UNSPECIFIED
from blind.world import World
from cablejax.gaplog import read_gap_log
from rows import read_rows

WORLD = World(stiffness=0.01, friction=0.3)


def short(name: str, seed: int = 0, samples: int = 130) -> Commands:
    """The beginning of a motion, the rest of it left out."""
    commands = draw_motion(np.random.default_rng(seed), name, 1.0)
    return dataclasses.replace(commands, twist=commands.twist[:samples], hold=commands.hold[:samples])


@pytest.fixture(scope="module")
def commands() -> list[Commands]:
    return [short("approach_s", samples=100), short("translation", 1, samples=100)]


@pytest.fixture(scope="module")
def before(commands):
    return record(Setup(WORLD), commands, quick)


@pytest.mark.slow
def test_a_cable_without_load_has_one_shape_whatever_its_stiffness(commands):
    path = commands[0].fine_path(FRAMES)[:2]
    soft, stiff = (
        simulate(World(stiffness=ei, friction=0.0, axial_stiffness=1e6), path, FRAME).points[-1] for ei in (0.005, 0.05)
    )
    assert np.abs(soft - stiff).max() < 1e-5
    steps = np.linalg.norm(np.diff(soft, axis=0), axis=1)
    assert np.abs(steps * 48 - 1).max() < 1e-3


@pytest.mark.slow
def test_mirrored_commands_give_the_mirrored_cable(commands):
    path = commands[0].fine_path(FRAMES)[:400]
    mirrored = path * [1.0, -1.0, -1.0]
    one, other = simulate(WORLD, path, FRAME).points, simulate(WORLD, mirrored, FRAME).points
    assert np.abs(one * [1.0, -1.0] - other).max() < 1e-7


@pytest.mark.slow
def test_the_rod_converges_in_nodes_and_time_step(commands):
    path = commands[0].fine_path(FRAMES)[:400]
    fine = simulate(WORLD, path, FRAME, RodConfig(96, 2e-3, 3)).points[:, ::8]
    assert np.sqrt(np.mean((simulate(WORLD, path, FRAME, RodConfig(48, 4e-3)).points[:, ::4] - fine) ** 2)) < 1e-4
    assert np.sqrt(np.mean((quick(WORLD, path, FRAME).points[:, ::4] - fine) ** 2)) < 2e-4


@pytest.mark.slow
def test_friction_holds_a_cable_at_rest(commands):
    path = commands[0].fine_path(FRAMES)[:400]
    path = np.concatenate([path, np.repeat(path[-1:], 500, axis=0)])  # ten seconds of rest
    points = simulate(WORLD, path, FRAME).points
    assert np.abs(points[-1] - points[450]).max() < 5e-4
    assert np.abs(points[399] - points[0]).max() > 0.01


def test_there_are_the_specified_effects_and_as_many_others_as_needed():
    assert len(SPECIFIED) == 22 and len(UNSPECIFIED) >= 8
    assert set(B_EFFECTS) < set(SPECIFIED) and len(B_EFFECTS) >= 10 and set(C_EFFECTS) < set(SPECIFIED)


@pytest.mark.parametrize("name", SPECIFIED + UNSPECIFIED)
def test_every_effect_changes_the_log_more_the_stronger_it_is(name, commands, before):
    effect = EFFECTS[name]
    fixed = effect.draw(np.random.default_rng(2), context_of(WORLD, commands, before))
    known = before if effect.side == "camera" else None
    low, high = np.log(effect.strengths)
    gaps = []
    for part in (0.1, 0.75):
        setup, parameters = effect.apply(Setup(WORLD), fixed, float(np.exp(low + part * (high - low))))
        json.dumps(parameters)
        gaps.append(gap(record(setup, commands, quick, known), before)[0])
    assert gaps[1] > 2e-4 and gaps[1] > 2 * gaps[0]


def test_motions_keep_to_their_limits_and_end_in_a_hold():
    rng = np.random.default_rng(5)
    for name in (*FAMILIES, *("mirror_" + family for family in FAMILIES)):
        commands = draw_motion(rng, name, 1.0)
        distance = np.linalg.norm(np.diff(commands.path[:, :, :2], axis=1)[:, 0], axis=-1)
        assert 20.0 <= len(commands.twist) * INTERVAL <= 30.2 and distance.max() <= 0.99 and distance.min() > 0.3
        assert commands.hold[0] and commands.hold[-15:].all() and not commands.twist[-30:].any()
        moving = (commands.twist != 0).any(axis=(1, 2))
        assert not commands.hold[1:][moving[:-1]].any()
    drawn = [draw_motions(rng, 1.0) for _ in range(40)]
    names = [{c.motion for c in six} for six in drawn]
    assert all(len(six) == 6 for six in drawn)
    assert np.mean([any("mirror_" + name in six for name in six) for six in names]) > 0.6


def test_lag_is_late_by_its_total():
    ramp = np.arange(400)[:, None] * 0.02
    for share in (0.0, 0.4, 1.0):
        assert (ramp - lagged(ramp, 0.3, share, 0.02))[-1, 0] == pytest.approx(0.3, abs=0.011)
    assert (lagged(np.ones((50, 1)), 0.3, 0.5, 0.02) == 1).all()


def test_the_camera_acts_as_specified():
    angle = np.linspace(0, 1, 49)
    arc = Motion(np.stack([np.sin(angle), 1 - np.cos(angle)], -1)[None].repeat(2, 0), angle[None].repeat(2, 0))
    plain = observe(arc, Camera(), 1.0, FRAME, 1, 0)[0]
    np.testing.assert_allclose(plain[4], [np.sin(1 / 3), 1 - np.cos(1 / 3)], atol=1e-8)
    shift = tuple(0.01 if k == 4 else 0.0 for k in range(13))
    along = observe(arc, Camera(shift_along=shift), 1.0, FRAME, 1, 0)[0]
    np.testing.assert_allclose(along[4], [np.sin(1 / 3 + 0.01), 1 - np.cos(1 / 3 + 0.01)], atol=1e-8)
    across = observe(arc, Camera(shift_across=shift), 1.0, FRAME, 1, 0)[0]  # towards the centre of the circle
    np.testing.assert_allclose(np.linalg.norm(across[4] - [0, 1]), 0.99, atol=1e-7)
    similar = observe(arc, Camera(scale=2.0, angle=np.pi / 2, offset=(0.1, 0.0)), 1.0, FRAME, 1, 0)[0]
    np.testing.assert_allclose(similar, 2 * np.stack([-plain[:, 1], plain[:, 0]], -1) + [0.1, 0.0], atol=1e-12)


def test_the_search_finds_a_strength_or_the_nearest():
    assert search(lambda x: 3 * x**1.5, 0.6, (1e-3, 10.0))[0] == pytest.approx(0.342, rel=0.06)
    strength, reached = search(lambda x: np.tanh(x), 4.0, (1e-3, 10.0))
    assert reached == pytest.approx(1.0, abs=1e-3) and strength > 3


def test_the_stored_plan_is_what_was_asked_for():
    plan = stored_plan(20261120)
    assert len(plan) >= 150 and len({case.name(1) for case in plan}) == len(plan)
    singles = collections.Counter(case.effects[0] for case in plan if case.kind == "single")
    assert set(singles) == set(SPECIFIED) and set(singles.values()) == {4}
    kinds = collections.Counter(case.kind for case in plan)
    assert kinds["none"] >= 30 and kinds["pair"] >= 16 and kinds["unknown"] >= 16
    assert stored_plan(20261120) == plan != stored_plan(1)
    assert {case.family for case in plan} == {"A", "B", "C"} and {c.family for c in development_plan(7)} == {"A"}


def test_a_case_is_the_same_again_and_its_label_is_locked(tmp_path):
    case = Case(3, "single", "A", ("gripper_rotation_offset",), 4)
    out, labels, published = tmp_path / "out", tmp_path / "labels.jsonl", tmp_path / "cases.jsonl"
    out.mkdir()
    name = case.name(11)
    assert not is_done(name, out, labels)
    draft = make_case(case, 11, family_a)
    write_case(case, draft, 11, out, labels)
    assert is_done(name, out, labels) and publish_hashes(labels, published) == 1
    label = checked_labels(read_cases([published, labels]))[name]
    log = read_gap_log(out / f"{name}.npz")
    assert label["severity"] == 4 and not label["traceless"]
    assert label["gap_over_noise"] == pytest.approx(4, rel=0.1)
    (effect,) = label["effects"]
    assert effect["name"] == "gripper_rotation_offset" and set(effect["parameters"]) == {"gripper", "angle_rad"}
    assert label["oracle_after_mm"] == pytest.approx(label["noise_mm"], rel=0.02)
    assert label["gap_rmse_mm_noisy"] == pytest.approx(
        np.hypot(label["gap_rmse_mm_noiseless"], label["noise_mm"]), rel=0.05
    )
    assert "gripper_rotation_offset" not in json.dumps(log.meta)
    # What the label says reproduces the log to its noise, the grippers' noise included.
    offset = [0.0, 0.0]
    offset[effect["parameters"]["gripper"]] = effect["parameters"]["angle_rad"]
    cable, length = log.meta["cable"], log.episode_length[0]
    world = World(
        stiffness=cable["bending_stiffness_n_m2"], linear_density=cable["linear_density_kg_per_m"],
        friction=log.meta["table"]["friction_coefficient"], grasp_offset=(offset[0], offset[1]),
    )  # fmt: skip
    commands = Commands(
        "", log.gripper_pose[0, :15].astype(float).mean(axis=0), log.gripper_command[0, :length], log.hold[0]
    )
    again = record(Setup(world), [commands], family_a).keypoints[0]
    left = np.sqrt(np.nanmean((again - log.keypoints[0, :length]) ** 2))
    assert 1e3 * left == pytest.approx(label["noise_mm"], rel=0.06)
    # Again: the same log and label; elsewhere with another salt.
    write_case(case, draft, 11, tmp_path, labels)
    np.testing.assert_array_equal(read_gap_log(tmp_path / f"{name}.npz").keypoints, log.keypoints)
    write_case(case, draft, 11, tmp_path, tmp_path / "other.jsonl")
    (locked,), (other,) = read_rows(labels), read_rows(tmp_path / "other.jsonl")
    assert locked["label"] == other["label"] and locked["salt"] != other["salt"]


@pytest.mark.slow
@pytest.mark.parametrize("family", ["B", "C", "D"])
def test_other_families_agree_without_effect_and_refuse_what_they_do_not_know(family, commands):
    if family in "BD":
        pytest.importorskip("elastica", reason="PyElastica is not installed: pip install pyelastica==1.0.0")
    from blind.families import FAMILIES as SIMULATORS

    other = SIMULATORS[family]()
    path = commands[0].fine_path(FRAMES)
    shape = Motion(*(np.asarray(part) for part in dataclasses.astuple(other(WORLD, path, FRAME))))
    own = family_a(WORLD, path, FRAME)
    seen, true = (observe(motion, Camera(), 1.0, FRAME, FRAMES, 0) for motion in (shape, own))
    assert np.sqrt(np.mean((seen - true) ** 2)) < 1e-3
    with pytest.raises(ValueError, match="no law for"):
        other(World(creep=1.0), path, FRAME)
