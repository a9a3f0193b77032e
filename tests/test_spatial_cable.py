"""The rod behind the protocol: derivatives, what is a recording's own, robust losses, and fits that hold all of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.bounded import Result
from cablejax.diagnose.evidence import Robust
from cablejax.diagnose.fit import Fit, evaluate, improve
from cablejax.diagnose.protocol import Explanation, explanation
from cablejax.simulate.rod import Rod
from cablejax.spatial.cable import SpatialCable
from cablejax.spatial.estimate import Estimate, estimate_at, starts_from
from cablejax.spatial.identify import layout_of
from cablejax.spatial.memory import Memory
from cablejax.spatial.search import Step
from cablejax.spatial.uncertainty import jackknife, resolution
from cablejax.spatial.windows import windows_of

_EFFECTS = ("bending_stiffness", "bending_damping", "gripper_rotation_offset")


@pytest.fixture(scope="module")
def cable():
    windows = windows_of(cases.recording())
    return SpatialCable(Rod(16, twisting=False), layout_of(windows, cases.NOMINAL), windows)


def at(cable: SpatialCable, effects=_EFFECTS, *, seed: int | None = None) -> Explanation:
    """All parameters at their prior medians, or drawn near there."""
    named = [cable.layout.named(name) for name in effects]
    one = cable.with_own(explanation(*((e, 0, [p.centre for p in e.parameters]) for e in named)))
    if seed is None:
        return one
    random = np.random.default_rng(seed)
    return one.moved(0.3 * random.normal(size=one.z.shape), 0.5 * random.normal(size=one.own.shape))


def test_a_recording_that_was_not_fitted_has_what_all_share(cable):
    own = np.array([[0.5] * 4, [0.0] * 4, [-1.0] * 4, [0.0] * 4])
    one = at(cable, seed=0).moved(at(cable, seed=0).z, own)
    short = one.moved(one.z, own[:1])
    same = cable.motion(short)
    np.testing.assert_array_equal(same[0], cable.motion(one)[0])
    np.testing.assert_array_equal(same[1:], cable.motion(one.moved(one.z, 0 * own))[1:])
    # without the effect nothing is a recording's own, and it comes back as nothing
    bare = cable.with_own(one.without("gripper_rotation_offset"))
    assert bare.own.size == 0 and cable.with_own(dataclasses.replace(one, own=bare.own)).own.shape == (4, 4)
    other = one.moved(one.z + 1.0, np.array([[0.1] * 4, [0.2] * 4]))
    mean = starts_from(one, other)[0]
    np.testing.assert_allclose(mean.z, one.z + 0.5)
    np.testing.assert_allclose(mean.own[:, 0], [0.3, 0.2, -1.0, 0.0])


def test_moves_where_the_system_binds_no_process_to_cores(cable, monkeypatch):
    usual = cable.motion(explanation())
    monkeypatch.delattr("os.sched_getaffinity", raising=False)
    np.testing.assert_array_equal(cable.motion(explanation()), usual)


def test_derivatives_are_those_of_finite_differences(cable):
    trial, episodes = at(cable, (*_EFFECTS, "keypoint_bias"), seed=1), np.array([0, 3])
    ((here, slopes),) = cable.linearise([trial], episodes)
    assert slopes.shape == (len(trial.z) + 4, *here.shape)
    np.testing.assert_allclose(here, cable.predict([trial], episodes)[0], atol=1e-9)
    random, step = np.random.default_rng(2), 1e-4
    shared, own = random.normal(size=trial.z.shape), random.normal(size=4)
    ahead, behind = (
        cable.predict([trial.moved(trial.z + s * shared, trial.own + s * own)], episodes)[0] for s in (step, -step)
    )
    central = (ahead - behind) / (2 * step)
    along = np.tensordot(np.concatenate([shared, own]), slopes, 1)
    np.testing.assert_allclose(along, central, atol=1e-5 * np.abs(central).max())


def _of_rods(cable, one, episodes, numbers, substeps):
    """What rods of these numbers of edges predict, and the polynomial in the squared length of an edge at zero."""
    rods = [Rod(n, substeps, twisting=False, local_error=cable.rod.local_error * n / 16) for n in numbers]
    found = np.stack([dataclasses.replace(cable, rod=rod).predict([one], episodes)[0] for rod in rods])
    powers = np.vander(1 / np.square(numbers, dtype=float), increasing=True)
    return found, np.linalg.solve(powers, found.reshape(len(numbers), -1))[0].reshape(found.shape[1:])


def _extrapolated(cable, one, episodes, substeps):
    """Less so where they are further apart than a good fit is off."""
    (coarse, fine), limit = _of_rods(cable, one, episodes, (16, 26), substeps)
    apart = np.linalg.norm(fine - coarse, axis=-1, keepdims=True)
    assert np.nanmax(apart) > 1e-3
    return fine + (limit - fine) / (1 + (apart / 0.01) ** 2)


@pytest.mark.slow
def test_a_corrected_cable_is_an_extrapolated_one_at_one_place_and_moves_as_before(cable):
    one, episodes = at(cable, seed=1), np.array([0, 3])
    corrected = cable.corrected(one)
    ((here, slopes),), ((_, plain),) = (c.linearise([one], episodes) for c in (corrected, cable))
    np.testing.assert_array_equal(slopes, plain)
    for predicted in (here, corrected.predict([one], episodes)[0]):
        np.testing.assert_allclose(predicted, _extrapolated(cable, one, episodes, 4), atol=1e-12)
    ((directly, also),) = cable.exact().linearise([one], episodes)
    np.testing.assert_allclose(directly, here, atol=1e-12)
    assert also.shape == slopes.shape
    # it says what is missing, not what was missing before, and nothing about other windows
    once, twice = corrected.correction, corrected.corrected(one).correction
    assert once is not None and twice is not None and 1e-4 < np.abs(once).max() < 0.05
    np.testing.assert_allclose(twice, once, atol=1e-12)
    assert corrected.on(cable.windows).correction is None


def test_the_loss_is_the_pseudo_huber_one_and_its_derivatives_are(cable):
    evidence, trial = cable.evidence(), at(cable, seed=3)
    (fit,) = evaluate(evidence, [trial])
    step = 1e-4
    for k in range(2):
        ends = [evaluate(evidence, [trial.moved(trial.z + s * np.eye(len(trial.z))[k])])[0].sse for s in (step, -step)]
        np.testing.assert_allclose(2 * fit.gradient[:, k], (ends[0] - ends[1]) / (2 * step), rtol=1e-4, atol=1e-6)
    # what broke down counts as a metre off, point by point, and has no derivative
    lost = np.full((1, *evidence.observed.shape), np.nan)
    broken = dataclasses.replace(cable)
    object.__setattr__(broken, "linearise", lambda explanations, episodes: [(lost[0], np.zeros((0, *lost.shape[1:])))])
    (gone,) = evaluate(dataclasses.replace(evidence, simulator=broken), [explanation()])
    loss = evidence.robust
    assert isinstance(loss, Robust)
    points = np.isfinite(evidence.observed).all(axis=-1).sum(axis=(1, 2))
    np.testing.assert_allclose(gone.sse, 2 * loss.distance * loss.lost * points / evidence.noise[0, 0] ** 2)


def test_a_chaotic_window_counts_as_lost_and_leaves_the_fit_to_the_others(cable):
    evidence, trial = cable.evidence(), at(cable, seed=3)
    (usual,) = evaluate(evidence, [trial])
    ((predicted, slopes),) = cable.linearise([trial], evidence.episodes)
    loss = evidence.robust
    assert loss is not None and np.abs(slopes).max() < loss.steepest
    slopes = slopes.copy()
    slopes[0, 1] = 40.0
    chaotic = dataclasses.replace(cable)
    object.__setattr__(chaotic, "linearise", lambda explanations, episodes: [(predicted, slopes)])
    (fit,) = evaluate(dataclasses.replace(evidence, simulator=chaotic), [trial])
    others = np.arange(len(fit.sse)) != 1
    points = np.isfinite(evidence.observed[1]).all(axis=-1).sum()
    np.testing.assert_allclose(fit.sse[1], 2 * loss.distance * loss.lost * points / evidence.noise[0, 0] ** 2)
    assert not fit.gradient[1].any() and not fit.curvature[1].any()
    np.testing.assert_array_equal(fit.sse[others], usual.sse[others])
    np.testing.assert_array_equal(fit.gradient[others], usual.gradient[others])


def test_elimination_solves_the_whole_system(cable):
    random, group = np.random.default_rng(0), np.array([0, 0, 2, 3, 3])
    trial, n, m = at(cable, seed=4), 6, 4
    roots = random.normal(size=(5, 40, n + m))
    fit = Fit(trial, np.ones(5), random.normal(size=(5, n + m)), roots.transpose(0, 2, 1) @ roots, group)
    weight = random.uniform(0.5, 2.0, 5)

    # all unknowns at once: shared coordinates, then the own numbers of every recording that is there
    rows = [0, 2, 3]
    whole, pull = np.eye(n + m * len(rows)), np.concatenate([trial.z, trial.own[rows].ravel()])
    for k, recording in enumerate(rows):
        into = np.zeros((n + m, len(pull)))
        into[:n, :n], into[n:, n + m * k : n + m * (k + 1)] = np.eye(n), np.eye(m)
        for e in np.flatnonzero(group == recording):
            whole += weight[e] * into.T @ fit.curvature[e] @ into
            pull += weight[e] * into.T @ fit.gradient[e]
    model = fit.model(weight, 0.0)
    np.testing.assert_allclose(model.curvature, whole, rtol=1e-9)
    np.testing.assert_allclose(model.gradient, pull, rtol=1e-9)
    evidence = dataclasses.replace(
        cable.evidence(), temper=np.ones(5), motion=np.arange(5), observed=np.zeros((5, 1, 1, 3)), episodes=np.arange(5)
    )
    flat = fit.model(evidence.weight(fit.sse), 0.0).curvature
    np.testing.assert_allclose(np.linalg.inv(fit.precision(evidence)), np.linalg.inv(flat)[:n, :n], rtol=1e-7)
    moved = fit.at(model.point + 1.0)
    np.testing.assert_allclose(moved.own[rows], trial.own[rows] + 1.0)
    np.testing.assert_array_equal(moved.own[1], trial.own[1])


@pytest.mark.slow
def test_grips_of_every_recording_are_found_and_leave_the_stiffness_alone(cable):
    true = at(cable)
    own = 0.25 / 0.3 * np.random.default_rng(2).normal(size=(4, 4))
    true = true.moved(np.array([0.7, 0.0, 0.0, 0.0, 0.0, 0.0]), own)
    seen = cable.on(dataclasses.replace(cable.windows, keypoints=cable.motion(true)))
    evidence, fits = seen.evidence(), {}
    for grips in (False, True):
        start = at(cable, _EFFECTS[: 2 + grips])
        (fits[grips],) = improve(evidence, evaluate(evidence, [start]), 40)
        assert fits[grips].result is Result.CONVERGED
    found = fits[True].explanation
    assert abs(found.z[0] - 0.7) < 0.05
    assert abs(found.z[0] - 0.7) < 0.5 * abs(fits[False].explanation.z[0] - 0.7)
    held = [0.3 * (one.z[2:] + one.own) for one in (found, true)]
    assert np.abs(held[0] - held[1]).max() < 0.1 and np.abs(held[1]).max() > 0.3
    moves = jackknife(evidence, fits[True])
    assert moves.shape == (4, 6) and 0 < np.sqrt((moves[:, 0] ** 2).sum()) < 0.2
    # seen by the same rod: there is nothing to correct
    corrected = dataclasses.replace(seen, correction=np.zeros_like(evidence.observed))
    told = estimate_at(corrected.evidence(), fits[True]).stiffness
    assert told.low < cases.NOMINAL * np.exp(0.7) < told.high


def test_what_finer_edges_would_do_is_part_of_an_interval(cable):
    true = at(cable).moved(np.array([0.7, 0.0, 0.0, 0.0, 0.0, 0.0]), np.zeros((4, 4)))
    seen = cable.on(dataclasses.replace(cable.windows, keypoints=cable.exact().motion(true)))
    corrected = seen.corrected(true)

    def fitted(cable, start):
        evidence = cable.evidence()
        return evidence, improve(evidence, evaluate(evidence, [start]), 40, tolerance=1e-6)[0]

    evidence, fit = fitted(corrected, at(cable))
    expected = resolution(evidence, fit)
    every = np.arange(len(cable.windows))
    this = _extrapolated(cable, fit.explanation, every, 1)
    _, following = _of_rods(cable, fit.explanation, every, (16, 20, 26), 1)
    finer = dataclasses.replace(corrected, correction=corrected.correction + following - this)
    _, again = fitted(finer, fit.explanation)
    moved = again.explanation.z - fit.explanation.z
    assert np.abs(moved).max() > 1e-4
    np.testing.assert_allclose(expected, moved, atol=0.1 * np.abs(moved).max())
    found = estimate_at(evidence, fit)
    assert found.stiffness.low < cases.NOMINAL * np.exp(0.7) < found.stiffness.high
    np.testing.assert_allclose(
        found.shifts[-1] @ found.shifts[-1], ((expected @ cable.directions(fit.explanation)[0]) ** 2).sum()
    )


def test_what_was_done_is_read_back(cable, tmp_path):
    one, path = at(cable, seed=5), tmp_path / "state.json"
    step = Step("bending_damping", True, (one, explanation()), np.array([0.1, 0.2]), 0.9)
    memory = Memory(path, "mark", cable.layout)
    memory.keep("search", [step])
    size = cable.layout.size
    told = Estimate(cable.layout, one, np.ones((3, size)), np.zeros((0, size)), 0.7, settled=False)
    memory.keep("estimates", [told])
    again = Memory(path, "mark", cable.layout)
    (read,), (estimated,) = again.done("search"), again.done("estimates")
    assert (read.effect, read.accepted, read.chance) == ("bending_damping", True, 0.9)
    assert (estimated.speed, estimated.settled) == (0.7, False)
    for name in ("shared", "moves", "shifts"):
        np.testing.assert_array_equal(getattr(estimated, name), getattr(told, name))
    for kept in (read.halves[0], estimated.explanation):
        assert kept.terms == one.terms
        np.testing.assert_array_equal(kept.z, one.z)
        np.testing.assert_array_equal(kept.own, one.own)
    assert read.halves[1].terms == () and Memory(path, "other", cable.layout).done("search") == []
