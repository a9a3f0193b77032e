"""The method of the diagnosis: what it claims must hold where the truth is known to the last digit.

All logs come from the simulator that fits them, with white noise: what fails here cannot be blamed on the model.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, kstest

from cablejax.diagnose import LIBRARY, CableDiagnosis, Calibration, Explanation, diagnose, explanation
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.planar import physics_of
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.protocol import Term
from cablejax.diagnose.search import search
from cablejax.diagnose.significance import LEVEL, NOISE_TOLERANCE, contrast_p, exceedance_p, variance_inflation
from cablejax.diagnose.where import localise
from cablejax.effects import CableEffect
from cablejax.types import GapLog
from diagnose_cases import BY_NAME, clean, evidence, evidence_of, log_of, noise, parts, playback, record, simulator

FEW = tuple(BY_NAME[n] for n in ("gripper_rotation_offset", "bending_stiffness", "keypoint_bias", "viscous_drag"))
OFFSET = ("gripper_rotation_offset", 0, (0.08,))
CURVED = ("intrinsic_curvature", (0.3, 0.2, 1.5))
EXACT = Calibration(baseline=1e-6, law_error=0.0, freedom=1e6)
"""For a simulator that is exact: every sample of white noise counts."""
STATED = 5e-4
"""Noise that is believed [m]."""


# What is no gap.


def coloured(shape, rho: float, seed: int) -> np.ndarray:
    """Noise as loud as the test of the gap still accepts, first-order autoregressive in time [m]."""
    drive = noise(shape, 1e3 * STATED * np.sqrt(NOISE_TOLERANCE), seed) * np.sqrt(1 - rho**2)
    drive[:, 0] /= np.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], drive, axis=1)


@pytest.mark.parametrize("rho", [0.0, 0.5], ids=["white", "correlated"])
def test_p_values_of_no_gap_are_uniform(rho):
    nominal = clean(n_links=17)
    p = []
    for seed in range(200):
        log = log_of(nominal + coloured(nominal.shape, rho, seed))
        whitened = (log.keypoints.astype(float) - nominal) / STATED
        inflation = variance_inflation(whitened, log, log.hold)
        p.append(exceedance_p((whitened**2).mean(axis=-1).reshape(1, -1), inflation)[0])
    assert kstest(p, "uniform").pvalue > 0.01


def test_p_values_of_no_contrast_are_uniform():
    """The smallest of several corrected p-values is the p-value of no contrast at all."""
    rng = np.random.default_rng(0)
    smallest = [
        contrast_p(rng.normal(size=(8, 5)) * np.exp(rng.normal(size=5)), np.arange(8)).min() for _ in range(300)
    ]
    assert kstest(smallest, "uniform").pvalue > 0.01


def test_no_gap_is_seldom_told_anywhere():
    """Family-wise over episodes and keypoints, for noise that is as stated."""
    nominal = clean(n_links=17)
    alarms = 0
    for seed in range(30):
        where = localise(log_of(nominal + noise(nominal.shape, 1e3 * STATED, seed)), nominal, np.full(13, STATED))
        told = [*where.episode_p, *where.keypoint_p, *(p for _, p in where.contrasts.values())]
        alarms += min(told) < LEVEL
    assert alarms <= binom.isf(0.01, 30, 3 * LEVEL), "three families of statements, each at that level"


def test_noise_is_not_explained_by_an_effect():
    """The search forced upon pure noise: each effect may win by chance, but seldom."""
    won = 0
    for seed in range(12):
        facts = dataclasses.replace(evidence(seed=seed), simulator=simulator(17, FEW))
        null = evaluate(facts, [explanation()])[0]
        found = search(facts, null, EXACT, progress=lambda _: None)
        won += bool(found.fits[0].explanation.terms)
    assert won <= 2, f"an effect was preferred to none in {won} of 12 logs of pure noise"


@pytest.mark.parametrize("seed", range(2))
def test_a_log_without_effect_gets_no_name(seed):
    result = diagnose(record(seed=seed), effects=FEW)
    assert result.verdict == "none" and result.effects == () and result.gap.shrinkage is None
    assert result.gap.before_rmse_mm == pytest.approx(0.5, rel=0.03)


# How sure a fit is.


def posterior_ranks(terms: tuple[Term, ...], n_draws: int, noise_mm: float = 0.5) -> np.ndarray:
    """Ranks of true coordinates among draws from the posterior of each fit, over draws of the truth from its prior.

    Uniform if the posterior is calibrated (Talts et al. 2018). Shape [draws, P], from 0 to 1.
    """
    rng = np.random.default_rng(1)
    player = playback(17)
    null = Explanation(terms, np.zeros(sum(term.size for term in terms)))
    bounds = null.bounds.T
    truths = [np.clip(rng.normal(size=len(null.z)), *bounds) for _ in range(n_draws)]
    everything = [null.moved(z) for z in truths]
    simulated = player.keypoints([physics_of(c, player.believed, player.config) for c in everything])
    ranks = []
    for seed, (truth, points) in enumerate(zip(truths, simulated, strict=True)):
        facts = evidence_of(points, noise_mm=noise_mm, seed=seed)
        (fit,) = improve(facts, evaluate(facts, [null]), max_iterations=15)
        drawn = rng.multivariate_normal(fit.explanation.z, np.linalg.inv(fit.precision(facts)), size=199)
        ranks.append(((drawn < truth).sum(axis=0) + 0.5) / 200)
    return np.array(ranks)


def assert_calibrated(ranks: np.ndarray):
    for column in ranks.T:
        assert kstest(column, "uniform").pvalue > 0.01
        covered = ((column > 0.05) & (column < 0.95)).sum()
        assert binom.ppf(0.005, len(column), 0.9) <= covered


ONE = {"gripper_rotation_offset": 1, "bending_stiffness": 0, "viscous_drag": 0}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "bending_stiffness" else pytest.mark.slow) for name in ONE]
)
def test_posterior_is_calibrated(name):
    assert_calibrated(posterior_ranks((Term(BY_NAME[name], ONE[name]),), 20))


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [("bending_stiffness", "gripper_rotation_offset"), ("linear_density",), ("gravity_tilt",), ("camera_similarity",)],
    ids="+".join,
)
def test_posterior_is_calibrated_in_several_dimensions(names):
    assert_calibrated(posterior_ranks(tuple(Term(BY_NAME[n], 0) for n in names), 40))


@pytest.mark.parametrize("effect", [OFFSET, ("bending_stiffness", (0.5,)), CURVED], ids=lambda e: e[0])
def test_twice_the_noise_makes_fits_half_as_sharp(effect):
    sharpness = []
    for noise_mm in (0.5, 1.0):
        facts = evidence(effect, noise_mm=noise_mm)
        (fit,) = improve(facts, evaluate(facts, [explanation(*parts(effect))]), max_iterations=10)
        # less the prior's part
        sharpness.append(np.diagonal(fit.precision(facts)) - 1.0)
    np.testing.assert_allclose(sharpness[0] / sharpness[1], 4.0, rtol=0.1)


def width(result: CableDiagnosis) -> float:
    (effect,) = result.effects
    low, high = effect.parameters["angle_rad"].ci90
    return high - low


@pytest.mark.slow
def test_twice_the_noise_widens_the_reported_interval():
    widths = [width(diagnose(record(OFFSET, noise_mm=s), effects=FEW, calibration=EXACT)) for s in (0.4, 0.8)]
    assert widths[1] / widths[0] == pytest.approx(2.0, rel=0.15)


def test_the_posterior_holds_what_is_named_as_uncertain_as_it_is():
    result = plain(OFFSET, FEW)
    (effect,) = result.effects
    assert len(result.posterior) == 16 and {one.name for draw in result.posterior for one in draw} == {effect.name}
    estimate = effect.parameters["angle_rad"]
    drawn = np.array([one.parameters["angle_rad"] for (one,) in result.posterior])
    low, high = estimate.ci90
    assert np.sum((low <= drawn) & (drawn <= high)) >= 12 and len(set(drawn)) == 16
    assert abs(drawn.mean() - estimate.value) < 0.5 * (high - low)


# What must not matter.


def permuted(log: GapLog, order: list[int]) -> GapLog:
    arrays = {f.name: getattr(log, f.name)[order] for f in dataclasses.fields(GapLog) if f.name != "meta"}
    return GapLog(meta={**log.meta, "motion": [log.meta["motion"][i] for i in order]}, **arrays)


def from_the_other_end(log: GapLog) -> GapLog:
    """Arc length counted from the other gripper, whose poses then point the other way."""
    pose = log.gripper_pose[:, :, ::-1].copy()
    pose[..., 2] += np.pi
    return dataclasses.replace(
        log, keypoints=log.keypoints[:, :, ::-1], gripper_pose=pose, gripper_command=log.gripper_command[:, :, ::-1]
    )


def turned(log: GapLog, angle: float = 2.4) -> GapLog:
    """The same in a frame turned about the world's origin."""
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]], np.float32)
    pose, command = log.gripper_pose.copy(), log.gripper_command.copy()
    pose[..., :2] = pose[..., :2] @ turn
    pose[..., 2] += angle
    command[..., :2] = command[..., :2] @ turn
    return dataclasses.replace(log, keypoints=log.keypoints @ turn, gripper_pose=pose, gripper_command=command)


@functools.cache
def plain(effect: tuple, effects: tuple[CableEffect, ...]) -> CableDiagnosis:
    return diagnose(record(effect), effects=effects)


def assert_same(result: CableDiagnosis, other: CableDiagnosis, *, error_mm: float = 0.003, **changed):
    """The same verdict, names, numbers and gap; `changed` gives parameters that must come out otherwise."""
    assert result.verdict == other.verdict
    assert [e.name for e in result.effects] == [e.name for e in other.effects]
    assert {frozenset(s) for s in result.equivalent} == {frozenset(s) for s in other.equivalent}
    for one, two in zip(result.effects, other.effects, strict=True):
        assert one.probability == pytest.approx(two.probability, abs=0.02)
        for name, estimate in two.parameters.items():
            expected = changed.get(name, estimate.value)
            spread = 0.0 if estimate.ci90 is None else 0.25 * (estimate.ci90[1] - estimate.ci90[0])
            assert one.parameters[name].value == pytest.approx(expected, abs=spread), name
    assert result.gap.before_rmse_mm == pytest.approx(other.gap.before_rmse_mm, abs=error_mm)
    assert result.gap.shrinkage == pytest.approx(other.gap.shrinkage, abs=0.01)


@pytest.mark.slow
def test_order_of_the_episodes_does_not_matter():
    order = [2, 0, 3, 1]
    result, other = diagnose(permuted(record(OFFSET), order), effects=FEW), plain(OFFSET, FEW)
    assert_same(result, other)
    np.testing.assert_allclose(result.where.per_episode_mm, other.where.per_episode_mm[order], rtol=1e-3)
    assert {r.name: r.probability for r in result.ranking} == pytest.approx(
        {r.name: r.probability for r in other.ranking}, abs=0.01
    )


ASYMMETRY_MM = 0.1
"""What the chain's first-order step may err otherwise from one end than from the other: half its assumed error."""


def test_the_chain_is_the_same_from_either_end():
    one, player = clean(n_links=17), playback(17)
    pose = player.gripper_pose[:, :, ::-1].astype(float)
    pose[..., 2] += np.pi
    reverse = Playback.of_motion(player.config, pose, one[:, 0, ::-1], player.interval)
    other = reverse.keypoints([reverse.believed])[0][:, :, ::-1]
    assert 1e3 * np.abs(one[:, 0] - other[:, 0]).max() < 1e-3, "settled starts are the same"
    assert 1e3 * np.sqrt(((one - other) ** 2).mean(axis=(1, 2, 3))).max() < ASYMMETRY_MM


def test_the_end_to_count_from_does_not_matter():
    result, other = diagnose(from_the_other_end(record(OFFSET)), effects=FEW), plain(OFFSET, FEW)
    assert other.verdict == "named" and other.effects[0].parameters["gripper"].value == 0
    assert_same(result, other, error_mm=ASYMMETRY_MM, gripper=1)
    np.testing.assert_allclose(result.where.along_cable_mm, other.where.along_cable_mm[::-1], atol=ASYMMETRY_MM)


@pytest.mark.slow
def test_the_frame_does_not_matter():
    result, other = diagnose(turned(record(OFFSET)), effects=FEW), plain(OFFSET, FEW)
    assert_same(result, other)


@pytest.mark.slow
@pytest.mark.parametrize("view", ["permuted", "other end", "turned"])
def test_no_view_of_the_log_changes_the_verdict_of_the_whole_library(view):
    log, other = record(CURVED), plain(CURVED, LIBRARY)
    assert other.effects[0].name == "intrinsic_curvature"
    if view == "permuted":
        assert_same(diagnose(permuted(log, [2, 0, 3, 1])), other)
    elif view == "turned":
        assert_same(diagnose(turned(log)), other)
    else:
        found = other.effects[0].parameters
        mirrored = {
            "centre_m": 1.0 - found["centre_m"].value,
            "curvature_per_m": -found["curvature_per_m"].value,
        }
        assert_same(diagnose(from_the_other_end(log)), other, error_mm=ASYMMETRY_MM, **mirrored)


@pytest.mark.slow
def test_both_grippers_askew_are_named_for_each():
    log = record(("gripper_rotation_offset", 0, (0.12,)), ("gripper_rotation_offset", 1, (-0.1,)))
    result = diagnose(log, effects=LIBRARY)
    found = {e.parameters["gripper"].value: e.parameters["angle_rad"].value for e in result.effects}
    assert result.verdict == "named" and {e.name for e in result.effects} == {"gripper_rotation_offset"}
    assert found == {0: pytest.approx(0.12, abs=0.01), 1: pytest.approx(-0.1, abs=0.01)}
    assert result.sentence.startswith("The gap comes from gripper rotation offset, which explains")


@pytest.mark.slow
def test_a_short_stiff_end_is_no_soft_rest_of_the_cable():
    result = diagnose(record(("stiffness_profile", (1.0, 0.1, 4.0))), effects=LIBRARY)
    (effect,) = result.effects
    assert effect.name == "stiffness_profile" and effect.parameters["ratio"].value > 2.0
    assert effect.parameters["centre_m"].value > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10, 16))
def test_the_whole_library_names_nothing_without_an_effect(seed):
    assert diagnose(record(seed=seed)).verdict == "none"
