"""What each recording has for its own: a nuisance that is fitted, no gap and no cause; fits that leave parts out."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cablejax.diagnose import Calibration, Effect, Parameter, Simulator, diagnose_simulator, explanation
from cablejax.diagnose.belief import LEAST_SQUARES
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.protocol import Plan
from cablejax.diagnose.refits import refitted
from cablejax.diagnose.run import weighed

_EPISODES, _SAMPLES, _NOISE = 8, 40, 0.01
_TIME = np.linspace(0.0, 1.0, _SAMPLES)


class Ramps(Simulator):
    """Ramps that begin somewhere else in each of four recordings, two episodes each."""

    unit = "V"
    effects = (
        Effect(name="slope", parameters=(Parameter("v_per_s", "V/s", -5.0, 5.0, 0.0, 1.0),), null=(0.0,), amplitude=0,
               reversible=True),
        Effect(name="bend", parameters=(Parameter("v_per_s2", "V/s^2", -5.0, 5.0, 0.0, 1.0),), null=(0.0,), amplitude=0,
               reversible=True),
    )  # fmt: skip
    recording = np.arange(_EPISODES) // 2
    plan = Plan(parts=4)

    def __init__(self, fits_unseen: bool = True):
        self.fits_unseen = fits_unseen

    def own(self, one) -> int:
        return 1

    def predict(self, explanations, episodes):
        result = []
        for one in explanations:
            slope, bend = one.vector(self.effects)
            begins = self.with_own(one).own[self.recording[np.asarray(episodes)], 0]
            result.append(begins[:, None] + slope * _TIME + bend * np.sin(9 * _TIME))
        return np.stack(result)[..., None]


def recorded(slope: float) -> np.ndarray:
    random = np.random.default_rng(0)
    begins = np.repeat(random.normal(size=4), 2)[:, None]
    return (begins + slope * _TIME + random.normal(scale=_NOISE, size=(_EPISODES, _SAMPLES)))[..., None]


_CALIBRATION = Calibration(baseline=1e-3, correlated_samples=10.0)


def test_a_cause_is_named_and_what_is_a_recordings_own_is_none():
    options = {"interval": 0.025, "noise": _NOISE, "motion": Ramps.recording, "calibration": _CALIBRATION}
    found = diagnose_simulator(Ramps(), recorded(0.7), **options)
    assert found.verdict == "named" and found.effects[0].name == "slope"
    slope = found.effects[0].parameters["v_per_s"]
    assert slope.value == pytest.approx(0.7, abs=0.02) and slope.ci90[0] < 0.7 < slope.ci90[1]  # type: ignore[index]
    assert found.gap.after_rmse_mm == pytest.approx(1e3 * _NOISE, rel=0.1)
    assert diagnose_simulator(Ramps(), recorded(0.0), **options).verdict == "none"
    repeats = diagnose_simulator(Ramps(), recorded(0.7), **options | {"motion": np.zeros(_EPISODES, int)})
    assert repeats.verdict == "named" and repeats.gap.shrinkage_ci90 is not None


def test_unseen_recordings_have_none_unless_they_are_fitted_too():
    observed = recorded(0.7)
    sizes = {}
    for fitted in (False, True):
        simulator = Ramps(fitted)
        start = explanation((simulator.effects[0], 0, (0.1,)))
        evidence = weighed(
            simulator, observed, np.zeros_like(observed), np.array([_NOISE]), Ramps.recording, _CALIBRATION
        )
        (fit,) = refitted(evidence, improve(evidence, evaluate(evidence, [start]), 20))
        assert fit.refits is not None and len(fit.refits.left_out) == 4
        np.testing.assert_allclose([one.z[0] for one in fit.refits.explanations], 0.7, atol=0.05)
        assert sorted(np.concatenate(fit.refits.left_out)) == list(range(_EPISODES))
        sizes[fitted] = fit.refits.sse.sum() / observed.size
        again = refitted(evidence, [fit])
        assert again[0].refits is fit.refits
    assert sizes[True] == pytest.approx(1.0, rel=0.3) and sizes[False] > 100


def test_derivatives_and_precision_hold_the_own_numbers():
    simulator, observed = Ramps(), recorded(0.7)
    evidence = weighed(simulator, observed, np.zeros_like(observed), np.array([_NOISE]), Ramps.recording, _CALIBRATION)
    evidence = dataclasses.replace(evidence, temper=np.ones(_EPISODES), freedom=LEAST_SQUARES, fit_freedom=None)
    trial = simulator.with_own(explanation((simulator.effects[0], 0, (0.3,))))
    ((_, slopes),) = simulator.linearise([trial], np.arange(_EPISODES))
    np.testing.assert_allclose(slopes[0, ..., 0], np.tile(_TIME, (_EPISODES, 1)), atol=1e-9)
    np.testing.assert_allclose(slopes[1], 1.0, atol=1e-9)
    (fit,) = evaluate(evidence, [trial])
    # two episodes of a recording share a vote, so each recording is one ramp with a free beginning
    share = 0.5 * 2 / _NOISE**2
    cross, alone = share * _TIME.sum(), share * _SAMPLES + 1.0
    exact = 1.0 + 4 * (share * (_TIME**2).sum() - cross**2 / alone)
    np.testing.assert_allclose(fit.precision(evidence), [[exact]], rtol=1e-6)


class Swings(Simulator):
    """Springs that swing, 150 samples each."""

    unit = "m"
    effects = (
        Effect(name="stiffness", parameters=(Parameter("ratio", "", 0.2, 5.0, 1.0, 0.2, log=True),), null=(1.0,)),
        Effect(name="damping", parameters=(Parameter("per_s", "1/s", 0.0, 5.0, 0.2, 0.2),), null=(0.0,)),
    )
    time = np.linspace(0.0, 3.0, 150)
    size = np.array([0.05, 0.08])[:, None]
    rate = np.array([1.0, 1.5])[:, None]

    def predict(self, explanations, episodes):
        result = []
        for one in explanations:
            ratio, damping = one.vector(self.effects)
            swing = np.cos(self.rate * np.sqrt(ratio) * self.time) * np.exp(-damping * self.time)
            result.append((self.size * swing)[np.asarray(episodes)])
        return np.stack(result)[..., None]


class Deaf(Swings):
    """Of which one effect changes nothing, or breaks the simulation."""

    def __init__(self, factor: float):
        self.factor = factor

    def predict(self, explanations, episodes):
        still = [one if "damping" not in one.names else explanation() for one in explanations]
        factor = [1.0 if one.vector(self.effects)[1] == 0 else self.factor for one in explanations]
        return super().predict(still, episodes) * np.array(factor)[:, None, None, None]


def observed_swings(ratio: float) -> np.ndarray:
    spring = Swings.effects[0]
    exact = Swings().predict([explanation((spring, 0, (ratio,)))], np.arange(2))[0]
    return exact + np.random.default_rng(0).normal(scale=1e-4, size=exact.shape)


def test_a_few_samples_weigh_more_than_a_prior_that_is_far_off():
    """No more samples can be correlated than an episode has."""
    found = diagnose_simulator(Swings(), observed_swings(2.2), interval=0.02, noise=1e-4)
    assert found.verdict == "named" and [effect.name for effect in found.effects] == ["stiffness"]
    estimate = found.effects[0].parameters["ratio"]
    assert estimate.ci90[0] < 2.2 < estimate.ci90[1] and estimate.value == pytest.approx(2.2, rel=0.05)
    assert any("3.8 prior standard deviations" in caveat for caveat in found.caveats)


def test_noise_alone_makes_no_gap():
    """The mean square of a few hundred samples scatters by a tenth."""
    exact = Swings().predict([explanation()], np.arange(2))[0]
    verdicts = []
    for seed in range(40):
        observed = exact + np.random.default_rng(seed).normal(scale=1e-3, size=exact.shape)
        verdicts.append(diagnose_simulator(Swings(), observed, interval=0.02, noise=1e-3).verdict)
    assert verdicts.count("none") >= 38


@pytest.mark.parametrize(
    ("factor", "gives"), [(1.0, "exactly what it gives without"), (np.nan, "values that are not finite")]
)
def test_an_effect_that_does_nothing_is_a_caveat(factor, gives):
    found = diagnose_simulator(Deaf(factor), observed_swings(1.3), interval=0.02, noise=1e-4)
    assert any(f"With damping (per_s = 0.4) predict gives {gives}" in caveat for caveat in found.caveats)
    assert [effect.name for effect in found.effects] == ["stiffness"]


def test_a_simulator_that_ignores_its_explanations_is_refused():
    class Ignoring(Swings):
        def predict(self, explanations, episodes):
            return super().predict([explanation() for _ in explanations], episodes)

    with pytest.raises(ValueError, match="Does predict use its explanations"):
        diagnose_simulator(Ignoring(), observed_swings(1.3), interval=0.02, noise=1e-4)


def test_one_episode_with_numbers_of_its_own_is_too_little():
    class One(Ramps):
        recording = np.zeros(1, int)

    with pytest.raises(ValueError, match="There is one episode"):
        diagnose_simulator(One(), recorded(0.7)[:1], interval=0.025, noise=_NOISE)
