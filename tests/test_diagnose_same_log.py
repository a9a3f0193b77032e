"""One log written in other words is the same log: turned, wound, numbered from the other end, on another clock.

One that is similar, with another unit of length, is explained alike.
"""

import copy
import dataclasses

import numpy as np
import pytest

from cablejax.diagnose import DiagnosisError, diagnose, explanation
from cablejax.diagnose.actuation import actuation
from cablejax.diagnose.belief import excess
from cablejax.diagnose.case import Case, calibrated
from cablejax.diagnose.fit import evaluate
from cablejax.diagnose.recording import prepare
from cablejax.gaplog_join import chosen
from cablejax.types import GapLog
from diagnose_cases import INTERVAL, SAMPLES, clean, log_of, record
from staged import similar

TILT = ("gravity_tilt", 0, (0.12, -0.05))


def gap_mm(log: GapLog) -> float:
    """Root mean square of what the nominal simulator is off."""
    case = Case.of(log)
    return 1e3 * float(np.sqrt(np.nanmean((case.recording.keypoints - case.nominal) ** 2)))


def with_meta(log: GapLog, **changes) -> GapLog:
    return dataclasses.replace(log, meta=copy.deepcopy(log.meta) | changes)


def turned(log: GapLog, angle: float) -> GapLog:
    """The world turned, angles wrapped."""
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    pose, command = log.gripper_pose.astype(float), log.gripper_command.astype(float)
    pose[..., :2], command[..., :2] = pose[..., :2] @ matrix.T, command[..., :2] @ matrix.T
    pose[..., 2] = (pose[..., 2] + angle + np.pi) % (2 * np.pi) - np.pi
    keypoints = log.keypoints.astype(float) @ matrix.T
    arrays = {"keypoints": keypoints, "gripper_pose": pose, "gripper_command": command}
    return dataclasses.replace(log, **{name: array.astype(np.float32) for name, array in arrays.items()})


def from_the_other_end(log: GapLog) -> GapLog:
    pose = log.gripper_pose[:, :, ::-1].copy()
    pose[..., 2] = (pose[..., 2] + 2 * np.pi) % (2 * np.pi) - np.pi
    return dataclasses.replace(
        log,
        keypoints=log.keypoints[:, :, ::-1].copy(),
        gripper_pose=pose,
        gripper_command=log.gripper_command[:, :, ::-1].copy(),
    )


def wound(log: GapLog) -> GapLog:
    """A whole turn more at gripper 1, and angles from 0 on."""
    pose = log.gripper_pose.copy()
    pose[:, :, 0, 2] %= 2 * np.pi
    pose[:, :, 1, 2] += 2 * np.pi
    return dataclasses.replace(log, gripper_pose=pose)


def marked_elsewhere() -> GapLog:
    """One keypoint 3 cm along the cable, and stated to be there."""
    log = record(("keypoint_bias", 2 * 5, (0.03,)))
    marks = list(log.meta["keypoint_arclength_m"])
    marks[5] += 0.03
    return with_meta(log, keypoint_arclength_m=marks)


def thick(log: GapLog) -> GapLog:
    return with_meta(log, cable=log.meta["cable"] | {"diameter_m": 0.03})


CHANGES = {
    "turned": lambda log: turned(log, 3.0),
    "wound": wound,
    "from the other end": from_the_other_end,
    "marked elsewhere": lambda log: marked_elsewhere(),
    "thick": thick,
}


@pytest.fixture(scope="module")
def of_size():
    """Similar logs of a cable that is 3.7 of its lengths away from where the others are, by its length [m]."""
    log = record(TILT)
    shift = np.array([3.7, 0.0, 0.0], np.float32)
    log = dataclasses.replace(log, gripper_pose=log.gripper_pose + shift, keypoints=log.keypoints + shift[:2])
    return {size: Case.of(similar(log, size)) for size in (1.0, 0.25)}


@pytest.fixture(scope="module")
def usual_mm():
    return gap_mm(record())


@pytest.mark.parametrize("name", CHANGES)
def test_the_gap_is_the_same(name, usual_mm):
    assert gap_mm(CHANGES[name](record())) == pytest.approx(usual_mm, rel=0.03)


@pytest.mark.slow
def test_a_short_cable_has_a_gap_where_a_long_one_has(of_size):
    def gap_over_least(size: float) -> float:
        case, calibration = of_size[size], calibrated(size)
        evidence = case.evidence(calibration)
        return excess(evaluate(evidence, [explanation()])[0], evidence) / calibration.smallest_gap(
            case.noise.std.mean()
        )

    assert gap_over_least(0.25) == pytest.approx(gap_over_least(1.0), rel=0.03)


def test_places_sizes_and_curvatures_are_sought_in_lengths_of_the_cable(of_size):
    def priors(size: float) -> dict[str, tuple[float, ...]]:
        units = {"m": size, "1/m": 1 / size}
        return {
            f"{effect.name} {p.name}": (p.centre / units[p.unit], (1 if p.log else 1 / units[p.unit]) * p.scale)
            for effect in of_size[size].simulator.effects
            for p in effect.parameters
            if p.unit in units and effect.name != "camera_similarity"
        }

    long, short = priors(1.0), priors(0.25)
    assert {name.split()[0] for name in long} >= {"friction_patch", "obstacle", "plasticity", "gripper_slip"}
    assert long["obstacle x_m"][0] == pytest.approx(4.4)
    for name, prior in long.items():
        assert short[name] == pytest.approx(prior), name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "size"),
    [(("table_friction", 0, (4.0, 0.0)), 0.25), (("obstacle", 0, (0.45, 0.33, 0.03)), 4.0)],
    ids=["short", "long"],
)
def test_a_similar_cable_is_diagnosed_alike(effect, size):
    log = record(effect)
    usual, other = diagnose(log), diagnose(similar(log, size))
    assert other.verdict == usual.verdict != "none"
    assert {one.name for one in other.effects} == {one.name for one in usual.effects}
    assert set(map(frozenset, other.equivalent)) == set(map(frozenset, usual.equivalent))


def test_episodes_that_repeat_are_known_whatever_their_angles():
    pose = prepare(turned(log_of(clean()), 3.0)).gripper_pose
    assert np.ptp(pose[:, 0, 0, 2]) < np.pi
    np.testing.assert_allclose(np.diff(pose[..., 2], axis=2), np.diff(log_of(clean()).gripper_pose[..., 2]), atol=1e-5)


def test_exact_arms_are_exact_on_any_clock():
    log, rng = log_of(clean()), np.random.default_rng(0)
    even = INTERVAL * np.arange(SAMPLES)
    time = np.stack([even + INTERVAL * rng.uniform(-0.1, 0.1, SAMPLES) for _ in log.time])
    pose = np.stack([_at(t, even, p) for t, p in zip(time, log.gripper_pose, strict=True)])
    command = np.zeros_like(pose)
    command[:, :-1] = np.diff(pose, axis=1) / np.diff(time, axis=1)[..., None, None]
    points = np.stack([_at(t, even, k) for t, k in zip(time, log.keypoints, strict=True)])
    arrays = {"keypoints": points, "gripper_pose": pose, "gripper_command": command}
    jittered = dataclasses.replace(log, time=time, **{n: a.astype(np.float32) for n, a in arrays.items()})
    recording = prepare(jittered)
    arms = actuation(
        recording.gripper_pose,
        recording.gripper_command,
        recording.interval,
        recording.length,
        np.arange(len(time)),
        recording.commanded,
    )
    assert not arms.deviates and arms.deviation < 1e-5
    assert any("off an even one" in caveat for caveat in recording.caveats)


def test_a_tilt_that_the_log_states_is_no_gap(usual_mm):
    log = record(TILT)
    x, y = 9.81 * np.array(TILT[2])
    stated = with_meta(log, gravity_m_per_s2=[x, y, -float(np.sqrt(9.81**2 - x**2 - y**2))])
    assert gap_mm(stated) == pytest.approx(usual_mm, rel=0.03)
    assert gap_mm(log) > 2 * usual_mm


def test_gravity_in_the_plane_of_the_keypoints_is_refused():
    with pytest.raises(DiagnosisError, match="the cable hangs"):
        Case.of(with_meta(record(), gravity_m_per_s2=[0.0, -9.81, 0.0]))


def test_an_episode_of_a_few_samples_is_left_out():
    log = record()
    length = log.episode_length.copy()
    length[1] = 7
    case = Case.of(dataclasses.replace(log, episode_length=length))
    assert np.isnan(case.recording.keypoints[1]).all() and np.isfinite(case.recording.keypoints[0]).any()
    assert any("fewer than 20 samples: episode 1." in caveat for caveat in case.recording.caveats)
    with pytest.raises(DiagnosisError, match="longest episode has 7 samples"):
        Case.of(dataclasses.replace(log, episode_length=np.full_like(length, 7)))


@pytest.mark.parametrize("fault", ["unseen", "short"])
def test_an_episode_that_is_left_out_leaves_the_others_as_they_are(fault):
    """It moves nothing, and is no motion against which others count as sensitive."""
    log = record()
    points, length = log.keypoints.copy(), log.episode_length.copy()
    if fault == "unseen":
        points[2:] = np.nan
    else:
        length[2:] = 7
    facts = []
    for one in (chosen(log, [0, 1]), dataclasses.replace(log, keypoints=points, episode_length=length)):
        case = Case.of(one)
        facts.append((case.growth(explanation()), case.stated_error(), case.simulator.duration))
    np.testing.assert_allclose(facts[1][0][:2], facts[0][0], rtol=0.01)
    assert facts[1][1] == pytest.approx(facts[0][1], rel=0.01) and facts[1][2] == facts[0][2]
    if fault == "unseen":
        assert any("no keypoint was observed: episode 2, 3." in caveat for caveat in case.recording.caveats)


def _at(time, even, values):
    """Linear between samples, as twists that are held make poses."""
    columns = [np.interp(time, even, column) for column in values.reshape(len(values), -1).T]
    return np.stack(columns, axis=1).reshape(len(time), *values.shape[1:])
