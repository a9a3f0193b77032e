"""Expected information: its bound holds against a Monte Carlo estimate, and it behaves as information does."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from cablejax.diagnose.information import entropy, mutual_information, parameter_information

CHANCES = np.array([0.5, 0.3, 0.2])


def gaussians(scale: float, seed: int = 0, size: int = 5):
    """Three explanations with two, one and no parameter."""
    rng = np.random.default_rng(seed)
    means = scale * rng.normal(size=(3, size))
    spreads = [rng.normal(size=(2, size)), 0.5 * rng.normal(size=(1, size)), np.zeros((0, size))]
    return means, spreads


def by_sampling(means, spreads, chances, count=40_000) -> tuple[float, float]:
    """Mutual information and its standard error, from draws of the mixture."""
    rng, size = np.random.default_rng(1), means.shape[1]
    covariances = [np.eye(size) + spread.T @ spread for spread in spreads]
    which = rng.choice(len(chances), size=count, p=chances)
    draws = np.empty((count, size))
    for c, (mean, covariance) in enumerate(zip(means, covariances, strict=True)):
        own = which == c
        draws[own] = mean + rng.normal(size=(own.sum(), size)) @ np.linalg.cholesky(covariance).T
    logs = np.empty((count, len(chances)))
    for c, (mean, covariance) in enumerate(zip(means, covariances, strict=True)):
        r = draws - mean
        quadratic = np.einsum("ni,ni->n", r @ np.linalg.inv(covariance), r)
        logs[:, c] = -0.5 * quadratic - 0.5 * np.linalg.slogdet(covariance)[1]
    values = logs[np.arange(count), which] - logsumexp(logs + np.log(chances), axis=1)
    return float(values.mean()), float(values.std() / np.sqrt(count))


@pytest.mark.parametrize("scale", [0.0, 0.3, 1.0, 3.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_bound_holds_against_sampling(scale, seed):
    means, spreads = gaussians(scale, seed)
    lower = mutual_information(means, spreads, CHANCES)
    sampled, error = by_sampling(means, spreads, CHANCES)
    assert 0 <= lower <= min(sampled + 4 * error, entropy(CHANCES))


def test_explanations_that_predict_the_same_are_not_told_apart():
    means, spreads = gaussians(1.0)
    same = np.repeat(means[:1], 3, axis=0)
    assert mutual_information(same, [spreads[0]] * 3, CHANCES) == pytest.approx(0.0, abs=1e-12)


def test_information_grows_with_the_separation_up_to_the_doubt():
    means, spreads = gaussians(1.0)
    lowers = [mutual_information(k * means, spreads, CHANCES) for k in (0.1, 0.5, 1.0, 2.0, 5.0, 50.0)]
    assert (np.diff(lowers) > 0).all()
    assert lowers[-1] == pytest.approx(entropy(CHANCES), rel=1e-6)


def test_difference_that_own_parameters_can_make_up_for_does_not_count():
    direction, chances = np.eye(1, 5), np.array([0.5, 0.5])
    means = np.concatenate([0 * direction, 3 * direction])
    certain = mutual_information(means, [np.zeros((0, 5))] * 2, chances)
    open_ = mutual_information(means, [30 * direction] * 2, chances)
    elsewhere = mutual_information(means, [30 * np.eye(5)[1:2]] * 2, chances)
    assert certain > 0.4 and open_ < 0.01
    assert elsewhere == pytest.approx(certain, rel=1e-9)


def test_reparametrisation_changes_nothing():
    means, spreads = gaussians(1.0)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(2, 2)))[0]
    turned = [turn @ spreads[0], -spreads[1], spreads[2]]
    assert mutual_information(means, turned, CHANCES) == pytest.approx(mutual_information(means, spreads, CHANCES))
    assert parameter_information(turned[0], spreads[1]) == pytest.approx(parameter_information(spreads[0], spreads[1]))
    # coordinates of the recording, and an offset that all explanations share
    whole = np.linalg.qr(np.random.default_rng(4).normal(size=(5, 5)))[0]
    moved = mutual_information((means + 1e3) @ whole, [s @ whole for s in spreads], CHANCES)
    assert moved == pytest.approx(mutual_information(means, spreads, CHANCES), rel=1e-6)


def test_information_about_parameters_is_that_of_a_linear_gaussian_model():
    spread = np.array([[3.0, 0.0, 4.0]])
    assert parameter_information(spread, np.zeros((0, 3))) == pytest.approx(0.5 * np.log(26.0))
    assert parameter_information(np.zeros((0, 3)), spread) == 0.0
    # what a nuisance may do as well says nothing: left are 4 of the 5 units across it
    assert parameter_information(spread, 1e6 * np.eye(1, 3)) == pytest.approx(0.5 * np.log(17.0), rel=1e-6)


def test_counts_have_to_agree():
    with pytest.raises(ValueError, match="as many of each"):
        mutual_information(np.zeros((2, 3)), [np.zeros((0, 3))], np.array([1.0]))
