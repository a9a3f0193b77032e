"""The diagnosis in space on synthetic recordings whose cause is known."""

from __future__ import annotations

import copy
import dataclasses
import json
import types
from typing import Any

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.bounded import Result
from cablejax.diagnose import explanation, verdict_json
from cablejax.diagnose.diagnosis import ParameterEstimate
from cablejax.diagnose.fit import evaluate, improve
from cablejax.gaplog import episodes_of, stack_episodes
from cablejax.log_setup import setup_fault
from cablejax.poses import poses_at
from cablejax.report.diagnosis_page import write_diagnosis_page
from cablejax.simulate.rod import Rod
from cablejax.simulate.rod.clamps import frames_along
from cablejax.spatial.cable import SpatialCable, errors
from cablejax.spatial.caveats import hidden_sentence
from cablejax.spatial.clock import on_one_clock, thinned, with_poses_in_time
from cablejax.spatial.diagnose import _ranking, diagnose_space
from cablejax.spatial.estimate import Estimate
from cablejax.spatial.gap import OWN, is_gap, own_error, smallest_gap, where_of, with_gap
from cablejax.spatial.geometry import local_changes
from cablejax.spatial.identify import TWISTED, Identified, _searched, _twisted, layout_of
from cablejax.spatial.judge import _equivalent, judge
from cablejax.spatial.named import _damped
from cablejax.spatial.search import Step, falls, halves
from cablejax.spatial.windows import windows_of


def test_windows_know_what_the_grippers_hold():
    windows = windows_of(cases.recording())
    assert windows.held == (2, 2)
    assert windows.keypoints.shape == (4, 100, 6, 3)
    np.testing.assert_allclose(windows.arclength, [*cases.MARKS, cases.LENGTH], atol=1e-9)
    np.testing.assert_allclose(windows.noise, cases.NOISE, rtol=0.2)
    np.testing.assert_allclose(
        windows.frames @ np.swapaxes(windows.frames, -1, -2), np.eye(3) * np.ones((4, 100, 2, 1, 1)), atol=1e-6
    )


def test_clamps_that_scatter_are_smoothed_and_others_are_not():
    clean = cases.recording()
    quiet = windows_of(clean)
    assert quiet.smoothed == 0 and quiet.first_clamp == pytest.approx(cases.REACH)
    noisy = copy.deepcopy(clean)
    scatter = 5e-4 * np.random.default_rng(5).normal(size=noisy.keypoints.shape)
    noisy.keypoints[:] += scatter
    tangent = 1e-2 * np.random.default_rng(6).normal(size=noisy.gripper_pose[..., 4:].shape)
    noisy.gripper_pose[..., 4:] += tangent
    noisy.gripper_pose[..., 3:] /= np.linalg.norm(noisy.gripper_pose[..., 3:], axis=-1, keepdims=True)
    shaken = windows_of(noisy)
    assert shaken.held == quiet.held and 3e-4 < shaken.smoothed < 8e-4
    raw = noisy.keypoints[:, :100, [1, -2]].astype(float)

    def jerk(paths):
        return np.abs(np.diff(paths, 3, axis=1)).mean()

    assert jerk(shaken.position) < 0.2 * jerk(raw)
    off = np.linalg.norm(shaken.position - quiet.position, axis=-1)
    assert off.mean() < 0.7 * np.linalg.norm(raw - quiet.position, axis=-1).mean()
    turned = np.linalg.norm(shaken.frames[..., 0, :] - quiet.frames[..., 0, :], axis=-1)
    assert turned.mean() < 0.012
    np.testing.assert_allclose(np.linalg.norm(shaken.frames, axis=-1), 1.0, atol=1e-6)
    # the noise of markers is no speed
    assert shaken.speed == pytest.approx(quiet.speed, rel=0.05)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: log.gripper_pose[..., :3].__iadd__(0.3), "Keypoint 0 is 0.52 m from gripper 0"),
        (
            lambda log: log.gripper_pose.__setitem__(slice(None), log.gripper_pose[:, :, ::-1].copy()),
            "Exchange the",
        ),
    ],
)
def test_grippers_elsewhere_are_refused(change, message):
    log = copy.deepcopy(cases.recording())
    change(log)
    with pytest.raises(ValueError, match=message):
        windows_of(log)


def test_an_axis_that_points_away_from_the_cable_or_passes_it_is_a_fault():
    log = cases.recording()
    assert setup_fault(log) is None
    turned = copy.deepcopy(log)
    # half a turn about the gripper's own y axis
    w, x, y, z = np.moveaxis(log.gripper_pose[..., 3:], -1, 0)
    turned.gripper_pose[..., 3:] = np.stack([-y, -z, w, x], axis=-1)
    assert "The x axis of gripper 0 is 1" in (setup_fault(turned) or "")
    beside = copy.deepcopy(log)
    beside.gripper_pose[..., 0] += 0.03
    beside.gripper_pose[..., 2] += 0.04
    assert "beside the x axis of gripper" in (setup_fault(beside) or "")


def test_gravity_that_points_away_from_where_the_cable_hangs_is_a_fault():
    log = copy.deepcopy(cases.recording())
    for gravity in ([0.0, 0.0, 9.81], [0.0, -9.81, 0.0]):
        log.meta["gravity_m_per_s2"] = gravity
        with pytest.raises(ValueError, match=r"gravity_m_per_s2.*but the cable sags along \(.*correct gravity's sign"):
            windows_of(log)
    # in a stiff cable an arch may stand up
    log.meta["cable"]["bending_stiffness_n_m2"] = 1e3 * log.meta["cable"]["linear_density_kg_per_m"]
    windows_of(log)


def test_quaternions_with_their_scalar_last_are_not_diagnosed():
    log = copy.deepcopy(cases.recording())
    log.gripper_pose[..., 3:] = np.roll(log.gripper_pose[..., 3:], -1, axis=-1)
    with pytest.raises(ValueError, match=r"x axis of gripper|their scalar last"):
        windows_of(log)


def test_a_stated_damping_is_believed():
    windows = windows_of(cases.recording())
    layout = layout_of(windows, cases.NOMINAL, 0.04)
    assert float(layout.physics(layout.null).damping_time) == pytest.approx(0.04)

    def damped(value, low, high, compared, *, longer_only, drawn=0.0):
        one = explanation((layout.named("bending_damping"), 0, (value,)))
        shifts = np.zeros((2, layout.size))
        shifts[0, layout.slots("bending_damping")] = drawn * value
        estimate = Estimate(layout, one, np.zeros((9, layout.size)), shifts, 0.5)
        time = ParameterEstimate(value, (low, high), "s")
        return _damped(estimate, time, 1.2, compared, longer_only=longer_only)

    interval = 0.041, 0.037, 0.046
    assert damped(*interval, 0.001, longer_only=True)
    assert not damped(*interval, 0.04, longer_only=False)
    assert damped(*interval, 0.1, longer_only=False), "less than stated"
    assert not damped(*interval, 0.1, longer_only=True)
    short = 0.0043, 0.0030, 0.0062
    assert damped(*short, 0.0025, longer_only=True)
    assert not damped(*short, 0.0025, longer_only=True, drawn=0.2), "its prior makes as much of an undamped cable"
    assert damped(*interval, 0.0025, longer_only=True, drawn=0.2)


def test_a_gap_is_more_than_the_simulator_may_err_by():
    windows = windows_of(cases.recording())
    assert smallest_gap(1e-5, windows) == pytest.approx(OWN, rel=0.01)
    assert smallest_gap(1e-3, windows) == pytest.approx(3e-3, rel=0.03)


def test_grippers_that_rest_are_never_fast():
    """A cable that swings to rest between clamps: nothing is said of a speed that none has."""
    log = cases.recording()
    windows = windows_of(log)
    windows = dataclasses.replace(windows, position=np.broadcast_to(windows.position[:1, :1], windows.position.shape))
    before = np.nan_to_num(windows.keypoints) + 0.01
    where = where_of(log, windows, before, 1e-4, 1e-3, ())
    assert set(where.regimes) == {"speed: slow"} and not any("nan" in text for text in where.sentences)


@pytest.mark.parametrize(
    ("better", "accepted", "verdict"), [(0.9, True, "unknown"), (0.9, False, "none"), (0.3, True, "none")]
)
def test_a_gap_that_amplified_noise_hides_is_undecided(monkeypatch, better, accepted, verdict):
    """The nominal cable counts as off by itself by half a metre, so that no gap can be told from that."""
    says, _ = judged_as(monkeypatch, better, accepted, own=0.5)
    assert says.verdict == verdict and not says.effects and says.gap.shrinkage is None
    if says.hidden is None:
        assert verdict == "none"
        return
    assert says.hidden.shrinkage == pytest.approx(better, abs=0.02)
    assert f"from {says.hidden.before_rmse_mm:.1f} to {says.hidden.after_rmse_mm:.1f} mm" in hidden_sentence(
        says.hidden
    )


def test_the_gap_of_an_unknown_cause_is_that_of_all_effects_together(monkeypatch):
    says, nearer = judged_as(monkeypatch, 0.6, True, own=1e-5)
    assert says.verdict == "unknown" and not says.effects and says.hidden is None
    assert says.gap.shrinkage == pytest.approx(0.6, abs=0.02)
    np.testing.assert_array_equal(says.after, nearer)


def judged_as(monkeypatch, better: float, accepted: bool, own: float):
    """The judgement of a cable of which no effect is named and all together take a part of the squared error."""
    monkeypatch.setattr("cablejax.spatial.gap.own_error", lambda *arguments: own)
    monkeypatch.setattr("cablejax.spatial.judge.own_error", lambda *arguments: own)
    monkeypatch.setattr("cablejax.spatial.judge.named_effects", lambda found, density: ())
    windows = windows_of(cases.recording())
    cable = SpatialCable(Rod(8, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    before, seen = cable.motion(explanation()), np.where(np.isfinite(windows.observed), windows.observed, 0.0)
    off = np.where(np.isfinite(windows.observed), before - seen, 0.0)
    # the part of the squared error that goes
    nearer = before - (1 - np.sqrt(1 - better)) * off

    steps = [Step("", True, (explanation(),) * 2, np.ones(4), 0.0), Step("drag", accepted, (), np.ones(4), 0.9)]
    found: Any = types.SimpleNamespace(
        cable=cable,
        steps=steps,
        everything=types.SimpleNamespace(with_only=lambda names: explanation()),
        unseen=lambda names=None: (nearer if names is None else before, np.zeros(len(windows), int)),
    )
    return judge(found, 1.0), nearer


@pytest.mark.parametrize("better", ["", "stiffness_profile"])
def test_rest_curvature_is_tried_in_place_of_its_look_alike_too(monkeypatch, better):
    windows = windows_of(cases.recording())
    cable = SpatialCable(Rod(8, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    profile = cable.layout.named("stiffness_profile")
    one, error = explanation((profile, 0, profile.null)), np.full(len(windows), 0.01)
    steps = [Step("", True, (explanation(),) * 2, 2 * error, 0.0), Step(profile.name, True, (one, one), error, 0.9)]

    def tried(cable, first, name, starts, before, progress, instead_of=""):
        share = 0.5 if instead_of == better else 0.6
        return Step(name, True, starts, share * before.error, 0.9, instead_of=instead_of)

    monkeypatch.setattr("cablejax.spatial.identify.tried_with", tried)
    steps += _twisted(cable, halves(cable.recording), steps, lambda text: None)
    assert [(step.effect, step.accepted) for step in steps[2:]] == [(TWISTED, False), (TWISTED, True)]
    assert steps[-1].instead_of == better
    assert steps[-1].halves[0].names == ((TWISTED,) if better else (profile.name, TWISTED))
    found = Identified(cable, None, (), (), tuple(steps), None, (None, None), None)  # pyright: ignore[reportArgumentType]
    assert [one.name for one in _ranking(found)] == [profile.name, TWISTED, TWISTED]
    # as good by chance as on top of it: the two look alike
    assert _equivalent(found, [profile.name]) == (() if better else ((profile.name, TWISTED),))
    assert _equivalent(found, []) == ()


def test_a_fit_finds_stiffness_and_damping():
    windows = windows_of(cases.recording())
    cable = SpatialCable(Rod(16, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    before = errors(cable.motion(explanation()), windows).mean()
    effects = [cable.layout.named(name) for name in ("bending_stiffness", "bending_damping")]
    start = explanation(*((effect, 0, (value,)) for effect, value in zip(effects, (1.0, 0.05), strict=True)))
    evidence = cable.evidence()
    (fit,) = improve(evidence, evaluate(evidence, [start]), cable.plan.last_steps)
    assert fit.result is Result.CONVERGED
    assert errors(cable.motion(fit.explanation), windows).mean() < 0.1 * before
    (ratio,), (damping,) = fit.explanation.values()
    np.testing.assert_allclose(ratio, cases.TRUE_RATIO, rtol=0.15)
    np.testing.assert_allclose(damping, cases.TRUE_DAMPING, rtol=0.2)


def test_finds_the_file_that_was_gripped_anew():
    (change,) = local_changes(cases.recording(regripped=2), (2, 2))
    assert "file 2, keypoints 0 and 1 at gripper 0 " in change
    assert "22.0 mm apart instead of 30.0 mm: it was gripped again." in change
    assert local_changes(cases.recording(), (2, 2)) == ()


def test_keypoints_that_single_files_do_not_show_say_nothing_of_their_geometry():
    log = cases.recording(regripped=2)
    keypoints = log.keypoints.copy()
    keypoints[0, :, 4] = keypoints[:, :, 7] = np.nan
    hidden = dataclasses.replace(log, keypoints=keypoints)
    assert local_changes(hidden, (2, 2)) == local_changes(log, (2, 2))


def test_halves_keep_recordings_together():
    group = np.array([0, 0, 0, 1, 1, 2, 3, 3])
    first = halves(group)
    assert 3 <= first.sum() <= 5
    for g in range(4):
        assert len(set(first[group == g])) == 1
    assert falls(np.full(8, 2.0), np.full(8, 1.0), group)[0]
    assert not falls(np.full(8, 2.0), np.array([1, 1, 1, 3, 3, 3, 3.0, 3]), group)[0]
    # one window of one recording is no proof
    assert not falls(np.full(8, 2.0), np.array([0.5] + 7 * [2.05]), np.zeros(8, int))[0]
    assert falls(np.full(8, 2.0), np.full(8, 1.0), np.zeros(8, int))[0]


def test_refuses_what_it_cannot_diagnose():
    log = cases.recording()
    with pytest.raises(ValueError, match="expected a cable in space"):
        windows_of(dataclasses.replace(log, keypoints=log.keypoints[..., :2]))
    with pytest.raises(ValueError, match="hang free"):
        windows_of(dataclasses.replace(log, meta={**log.meta, "table": {"friction_coefficient": 0.1}}))
    time = log.time.copy()
    time[:, 50:] += 0.3
    with pytest.raises(ValueError, match="resample"):
        windows_of(dataclasses.replace(log, time=time))
    with pytest.raises(ValueError, match="eval"):
        diagnose_space(dataclasses.replace(log, meta={**log.meta, "split": ["eval"] * 4}))
    with pytest.raises(ValueError, match="no effect 'obstacle' in space"):
        diagnose_space(log, only=["obstacle"])


def test_labels_are_one_for_each_episode_or_none():
    log = cases.recording()
    for odd in (7, "2024-01-01 lab.bag", ["a"], [None] * 4):
        told = windows_of(dataclasses.replace(log, meta={**log.meta, "recording": odd, "file": odd, "split": odd}))
        assert len(np.unique(told.group)) == 4 and set(told.split) == {""}
        assert set(told.name) == {"0", "1", "2", "3"}
    told = windows_of(dataclasses.replace(log, meta={**log.meta, "recording": [1, 1, 2, 2], "take": list("abcd")}))
    assert len(np.unique(told.group)) == 2 and set(told.name) == set("abcd")


def test_gravity_is_the_one_that_the_log_states():
    log = cases.recording()
    gravity = [0.0, -4.0, -9.0]
    windows = windows_of(dataclasses.replace(log, meta={**log.meta, "gravity_m_per_s2": gravity}))
    layout = layout_of(windows, 0.02)
    np.testing.assert_allclose(layout.physics(layout.null).gravity, gravity, rtol=1e-6)


@pytest.mark.parametrize("unseen", [0, 1, 4])
def test_a_keypoint_that_is_never_seen_is_named(unseen):
    log = cases.recording()
    keypoints = log.keypoints.copy()
    keypoints[:, :, unseen] = np.nan
    with pytest.raises(ValueError, match=f"Keypoint {unseen} is never observed"):
        windows_of(dataclasses.replace(log, keypoints=keypoints))


def test_clocks_that_differ_are_made_one():
    """Two episodes at half the rate, one whose samples jitter: the others are as they were."""
    log, rng = cases.recording(), np.random.default_rng(0)
    same, nothing = on_one_clock(log)
    assert same is log and nothing == ()
    uneven, interval = copy.deepcopy(log), cases.INTERVAL
    half = (cases.SAMPLES + 1) // 2
    for e in (1, 2):
        for name in ("time", "keypoints", "gripper_pose", "gripper_command"):
            array = getattr(uneven, name)
            array[e, :half] = getattr(log, name)[e, ::2]
        uneven.episode_length[e] = half
    late = interval * rng.uniform(-0.2, 0.2, cases.SAMPLES)
    uneven.time[3] += late
    uneven.keypoints[3, :-1] += (late[:-1, None, None] / interval) * np.diff(log.keypoints[3], axis=0)
    even, told = on_one_clock(uneven)
    assert len(told) == 1 and "every 20 ms" in told[0]
    for e in range(4):
        n = int(even.episode_length[e])
        assert n >= cases.SAMPLES - 2
        np.testing.assert_allclose(np.diff(even.time[e, :n]), interval, rtol=1e-9)
        off = np.abs(even.keypoints[e, :n] - log.keypoints[e, :n])[3:-3]
        assert np.nanmedian(off) < (1e-9 if e == 0 else 3e-4)
        np.testing.assert_allclose(np.linalg.norm(even.gripper_pose[e, :n, :, 3:], axis=-1), 1.0, atol=1e-6)
    assert len(windows_of(even)) == len(windows_of(log))


def test_many_samples_a_second_are_averaged_and_keep_their_episodes():
    """Four times as many, with noise that is less by half in their means; an episode of two has one."""
    log, rng = cases.recording(), np.random.default_rng(0)
    fast = copy.deepcopy(log)
    fast.time[:] = fast.time / 4
    fast.episode_length[1] = 3
    fast.keypoints[:] = log.keypoints[:, :1] + rng.normal(0, 1e-3, log.keypoints.shape)
    assert thinned(log) == (log, ())
    found, (told,) = thinned(fast)
    assert "5 ms apart: every 2 were averaged" in told
    assert len(found.episode_length) == len(log.episode_length) and found.episode_length[1] == 1
    assert found.episode_length[0] == log.episode_length[0] // 2
    n = int(found.episode_length[0])
    np.testing.assert_allclose(np.diff(found.time[0, :n]), cases.INTERVAL / 2, rtol=1e-9)
    off = found.keypoints[0, :n] - log.keypoints[0, 0]
    assert np.std(off) == pytest.approx(1e-3 / np.sqrt(2), rel=0.05)
    np.testing.assert_allclose(np.linalg.norm(found.gripper_pose[0, :n, :, 3:], axis=-1), 1.0, atol=1e-6)


@pytest.mark.slow
def test_noise_in_the_beginning_of_a_window_and_few_edges_make_no_gap():
    """Half a millimetre at 50 Hz is a velocity of 2 to 4 cm/s that the cable does not have."""
    windows = windows_of(cases.recording())
    few, many = (
        SpatialCable(Rod(edges, twisting=False), layout_of(windows, cases.NOMINAL), windows) for edges in (20, 32)
    )
    coarse, fine = few.motion(explanation()), many.motion(explanation())
    edges, some, more = (own_error(few, explanation(), coarse, noise) for noise in (0.0, 1e-4, 5e-4))
    off = np.sqrt(np.mean((coarse - fine) ** 2))
    # a part 1.6 squared of it is left with the finer one
    assert (
        edges == pytest.approx(off / (1 - 1 / 1.6**2), rel=0.4)
        and own_error(many, explanation(), fine, 0.0) < 0.6 * edges
    )
    assert np.sqrt(more**2 - edges**2) == pytest.approx(5 * np.sqrt(some**2 - edges**2), rel=0.2)
    assert smallest_gap(5e-4, windows, more) == pytest.approx(np.hypot(1.5 * more, smallest_gap(5e-4, windows)))


def _softly_damped(times: int) -> tuple[SpatialCable, np.ndarray]:
    """A soft cable that swings so many times as long, seen without noise, and its motion if it were not damped."""
    windows = cases.swinging(times)
    cable = SpatialCable(Rod(20, 1, twisting=False), layout_of(windows, 0.02 * cases.NOMINAL), windows)
    damped = (
        (cable.layout.named(name), 0, (value,)) for name, value in (("bending_damping", 0.03), ("viscous_drag", 0.5))
    )
    seen = dataclasses.replace(windows, keypoints=cable.motion(explanation(*damped)))
    return cable.on(seen), cable.motion(explanation())


@pytest.mark.slow
def test_a_gap_shows_before_the_nominal_cable_amplifies_noise():
    noise = 3e-4
    short, nominal = _softly_damped(1)
    compared, smallest, own = with_gap(short, nominal, noise)
    assert compared.windows.valid.sum() == short.windows.valid.sum() and is_gap(nominal, compared.windows, smallest)
    assert smallest > own == own_error(short, explanation(), nominal, noise)

    long, nominal = _softly_damped(3)
    assert not is_gap(
        nominal, long.windows, smallest_gap(noise, long.windows, own_error(long, explanation(), nominal, noise))
    )
    compared, smallest, _ = with_gap(long, nominal, noise)
    assert compared.windows.valid.sum() <= 0.5 * long.windows.valid.sum()
    assert is_gap(nominal, compared.windows, smallest)

    # what the nominal cable explains has no gap, however short
    same = long.on(dataclasses.replace(long.windows, keypoints=nominal))
    compared, smallest, _ = with_gap(same, nominal, noise)
    assert compared.windows.valid.sum() == same.windows.valid.sum() and not is_gap(nominal, compared.windows, smallest)


@pytest.mark.parametrize("late", [10, -7, 3.4])
def test_poses_on_another_clock_than_the_keypoints_are_shifted(late):
    log = cases.recording()
    assert with_poses_in_time(log) == (log, ())
    step = log.time[0, 1]
    wrong = copy.deepcopy(log)
    for e, time in enumerate(log.time):
        wrong.gripper_pose[e] = poses_at(time - late * step, time, log.gripper_pose[e])
    right, (told,) = with_poses_in_time(wrong)
    assert told.startswith(f"The keypoints at the grippers fit their poses {abs(late) * step:.2g} s ")
    assert ("later" if late > 0 else "earlier") in told and "poses were shifted" in told
    seen = np.isfinite(right.keypoints).all(axis=(2, 3))
    assert (~seen).sum(axis=1).max() <= abs(late) + 1
    seen[:, 0] = False  # before the first pose that was written there is none
    np.testing.assert_allclose(right.gripper_pose[seen], log.gripper_pose[seen], atol=2e-3)
    if abs(late) == 10:
        np.testing.assert_allclose(right.keypoints[seen], log.keypoints[seen])


@pytest.mark.slow
def test_names_the_cause_and_goes_on_where_it_was(tmp_path):
    log, state, said = cases.recording(6, regripped=3), tmp_path / "state.json", []
    only = ["bending_stiffness", "bending_damping", "viscous_drag"]
    result = diagnose_space(log, only=only, state=state, progress=said.append)
    assert {e.name for e in result.effects} == {"bending_stiffness", "bending_damping"}
    found = result.identified
    assert "viscous_drag" not in found.effects
    assert all(set(one.explanation.names) == set(only) and one.settled for one in (found.everything, *found.halves))
    assert result.verdict in ("named", "named+unknown")
    assert result.gap.shrinkage is not None and result.gap.shrinkage > 0.9
    interval = next(e for e in result.effects if e.name == "bending_damping").parameters["time_s"].ci90
    assert interval is not None
    assert interval[0] < 1.1 * cases.TRUE_DAMPING and interval[1] > 0.9 * cases.TRUE_DAMPING  # type: ignore[operator]
    assert "gripper 0" in result.sentence
    again = diagnose_space(log, only=only, state=state)
    np.testing.assert_array_equal(again.identified.everything.explanation.z, result.identified.everything.explanation.z)
    page = write_diagnosis_page(result, tmp_path / "report").read_text()
    assert 'id="orbit"' in page and "http://" not in page.replace("http://www.w3.org", "")
    verdict = json.loads((tmp_path / "report" / "verdict.json").read_text())
    assert verdict == json.loads(json.dumps(verdict_json(result)))
    assert len(verdict["where"]["per_episode_mm"]) == 6


@pytest.mark.slow
def test_the_cause_is_named_from_the_windows_of_one_recording():
    log = cases.recording(6)
    log = dataclasses.replace(log, meta={**log.meta, "recording": 6 * ["one"]})
    result = diagnose_space(log, only=["bending_stiffness", "bending_damping"])
    assert result.verdict == "named" and {e.name for e in result.effects} == {"bending_stiffness", "bending_damping"}
    assert result.gap.shrinkage_ci90 is not None
    assert any("only one recording" in caveat for caveat in result.caveats)


@pytest.mark.slow
def test_one_window_is_too_little_and_one_that_ends_at_once_is_left_out():
    log = cases.recording(1)
    with pytest.raises(ValueError, match="one window to fit"):
        diagnose_space(log)
    whole = cases.recording()
    keypoints = whole.keypoints.copy()
    keypoints[1, 2:, 1:-1] = np.nan
    windows = windows_of(dataclasses.replace(whole, keypoints=keypoints))
    assert len(windows) == 3 and len(windows.left_out) == 1


def test_a_window_that_no_fit_sees_is_left_out():
    log = cases.recording()
    keypoints = log.keypoints.copy()
    keypoints[1, 2::4] = np.nan
    windows = windows_of(dataclasses.replace(log, keypoints=keypoints))
    # its first two samples of all keypoints are 0 and 1
    assert windows.episode.tolist() == [0, 2, 3] and len(windows.left_out) == 1
    evidence = SpatialCable(Rod(8, 1, twisting=False), layout_of(windows, cases.NOMINAL), windows).evidence()
    assert evidence.count.min() > 0


def test_too_few_samples_are_refused_before_anything_is_fitted():
    log, said = cases.recording(), []
    fields = ("time", "keypoints", "gripper_pose", "gripper_command", "hold")
    few = [dataclasses.replace(e, **{f: getattr(e, f)[::14] for f in fields}) for e in episodes_of(log)]
    with pytest.raises(ValueError, match="noise cannot be estimated: no keypoint is observed often enough"):
        diagnose_space(stack_episodes(few, {**log.meta, "roll_observed": True}), progress=said.append)
    assert not any("time steps" in text for text in said)


@pytest.mark.slow
def test_of_one_whole_window_the_short_ones_are_used_too():
    """A recording of 8 s is one window of 5 s and one of 3 s: a search holds either out."""
    windows = windows_of(cases.recording(2))
    short = dataclasses.replace(windows, valid=windows.valid & (np.arange(100) < [[100], [60]]))
    assert short.whole(24).tolist() == _searched(short, halves(short.group)).tolist() == [0, 1]


def test_the_search_sees_windows_of_both_halves():
    windows = windows_of(cases.recording())
    many = windows.chosen(np.repeat(np.arange(len(windows)), 10))
    many = dataclasses.replace(many, group=np.repeat([0, 1, 2, 3, 4], [12, 11, 9, 6, 2])[: len(many)])
    first = halves(many.group)
    seen = _searched(many, first)
    assert len(seen) == len(set(seen)) == 24 and (np.diff(seen) > 0).all() and first[seen].sum() == 12
    # of a half with one whole window, that one alone
    valid = many.valid & (
        (np.arange(many.valid.shape[1]) < 20) | ~first[:, None] | (np.arange(len(many)) == 0)[:, None]
    )
    assert first[0] and first[_searched(dataclasses.replace(many, valid=valid), first)].sum() == 1


def test_grippers_that_move_in_a_pause_are_refused():
    log, late = cases.recording(), np.zeros(cases.SAMPLES)
    late[60:] = 1.5
    paused = dataclasses.replace(log, time=log.time + late)
    still = dataclasses.replace(paused, gripper_pose=log.gripper_pose[:, :1].repeat(cases.SAMPLES, axis=1))
    assert "resampled" in on_one_clock(still)[1][0]
    pose = np.where(np.arange(cases.SAMPLES)[:, None] < 60, 0.0, [0.05, *np.zeros(6)])
    moved = dataclasses.replace(still, gripper_pose=still.gripper_pose + pose[:, None].astype(np.float32))
    with pytest.raises(ValueError, match=r"Episode 0 has no samples for 1\.5 s after 1\.18 s, where .* by 50 mm"):
        on_one_clock(moved)


def test_a_recording_at_another_rate_is_sampled_again():
    """By 4 %: no jitter, or one clock would play it too fast."""
    log = cases.recording()
    time = log.time.copy()
    time[1] *= 1.04
    even, repairs = on_one_clock(dataclasses.replace(log, time=time))
    assert repairs and "resampled" in repairs[0]
    assert even.episode_length[1] == pytest.approx(1.04 * log.episode_length[1], abs=1)


def test_frames_of_set_ups_that_were_turned_by_half_a_turn():
    angle = np.concatenate([np.linspace(-0.2, 0.2, 10), np.pi + np.linspace(-0.2, 0.2, 10)])
    tangent = np.stack([np.cos(angle), np.sin(angle), np.zeros(20)], axis=1)
    frames = frames_along(tangent)
    np.testing.assert_allclose(frames @ np.swapaxes(frames, -1, -2), np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(frames[:, 0], tangent, atol=1e-9)
