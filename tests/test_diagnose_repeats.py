"""Episodes that repeat one another are one piece of evidence."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cablejax.diagnose import explanation
from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.evidence import repeated_motions, share_of_motion
from cablejax.diagnose.fit import evaluate, improve
from cablejax.diagnose.gap import held_out_predictions, measure_gap
from cablejax.diagnose.posterior import QUANTILE, profile_widths
from cablejax.diagnose.run import weighed
from diagnose_cases import evidence, parts


def test_motions_a_twentieth_of_the_length_apart_are_one():
    pose = np.zeros((4, 10, 2, 3))
    pose[1, :, 0, 0] = 0.04
    pose[2, :, 0, 0] = 0.2
    # the end of a shorter episode is not compared
    pose[3, 7:] = np.nan
    assert repeated_motions(pose, np.full(4, 0.1), 1.0).tolist() == [0, 0, 2, 0]
    # seen on a shorter cable they differ
    assert repeated_motions(pose, np.full(4, 0.1), 0.5).tolist() == [0, 1, 2, 0]
    motion, seen = np.array([0, 0, 2, 0]), np.array([True, True, False, False])
    np.testing.assert_allclose(share_of_motion(motion, np.ones(4, bool)), [1 / 3, 1 / 3, 1, 1 / 3])
    np.testing.assert_allclose(share_of_motion(motion, seen)[seen], [1 / 2, 1 / 2])


def test_an_episode_twice_tells_no_more_than_once():
    once = evidence(("bending_stiffness", (1.4,)))
    twice = dataclasses.replace(once.restricted([0, 1, 2, 3, 0]), motion=np.array([0, 1, 2, 3, 0]))
    trial = explanation(*parts(("bending_stiffness", (1.3,))))
    one, two = evaluate(once, [trial])[0], evaluate(twice, [trial])[0]
    assert once.log_likelihoods(one.sse).sum() == pytest.approx(twice.log_likelihoods(two.sse).sum(), rel=1e-6)
    np.testing.assert_allclose(one.precision(once), two.precision(twice), rtol=1e-4)
    np.testing.assert_allclose(one.held_out_sse(once), two.held_out_sse(twice)[:4], rtol=1e-4)


def test_a_repetition_that_nobody_saw_has_no_say():
    """The camera was off in it."""
    once = evidence(("bending_stiffness", (1.4,)))
    twice = dataclasses.replace(once.restricted([0, 1, 2, 3, 0]), motion=np.array([0, 1, 2, 3, 0]))
    twice.observed[4] = np.nan
    trial = explanation(*parts(("bending_stiffness", (1.3,))))
    one, two = evaluate(once, [trial])[0], evaluate(twice, [trial])[0]
    assert one.cost(once) == pytest.approx(two.cost(twice), rel=1e-6)
    assert once.log_likelihoods(one.sse).sum() == pytest.approx(twice.log_likelihoods(two.sse).sum(), rel=1e-6)
    np.testing.assert_allclose(one.precision(once), two.precision(twice), rtol=1e-4)


def test_a_motion_that_nobody_saw_is_none_that_can_be_held_out():
    facts = evidence(("bending_stiffness", (1.4,)))
    observed, motion = facts.observed.copy(), np.array([0, 0, 0, 3])
    observed[3] = np.nan
    seen = weighed(facts.simulator, observed, facts.nominal, facts.noise, motion, Calibration())
    (best,) = evaluate(seen, [explanation(*parts(("bending_stiffness", (1.3,))))])
    predicted, held_out = held_out_predictions(seen, best)
    assert held_out == ()
    time = {"interval": np.full(4, 0.1), "length": np.full(4, observed.shape[1])}
    gap = measure_gap(seen, facts.nominal, predicted, **time, held_out=(0, 1, 2), resolvable=True)
    without = measure_gap(
        seen.restricted([0, 1, 2]),
        facts.nominal[:3],
        predicted[:3],
        **{name: values[:3] for name, values in time.items()},
        held_out=(0, 1, 2),
        resolvable=True,
    )
    assert gap.shrinkage == pytest.approx(without.shrinkage) and gap.shrinkage > 0.5
    assert gap.shrinkage_ci90 == pytest.approx(without.shrinkage_ci90)


def test_profiles_of_a_nearly_linear_fit_are_those_of_its_covariance():
    facts = evidence(("table_friction", (0.45, 0.02)), ("camera_similarity", (1.003, 0.002, 0.002, 0.0)), noise_mm=0.5)
    start = explanation(*parts(("camera_similarity", (1.003, 0.002, 0.002, 0.0)), ("table_friction", (0.45, 0.02))))
    fit = improve(facts, evaluate(facts, [start]), max_iterations=8)[0]
    laplace = QUANTILE * np.sqrt(np.diagonal(np.linalg.inv(fit.precision(facts))))
    np.testing.assert_allclose(profile_widths(facts, fit)[:4], np.repeat(laplace[:4, None], 2, axis=1), rtol=0.1)


def test_a_profile_ends_where_the_refitted_cost_has_risen_by_its_share():
    """The ratio of friction is known in its order of magnitude; the cost is minimised here over its static excess."""
    facts = evidence(("table_friction", (0.45, 0.02)), noise_mm=3.0)
    start = explanation(*parts(("table_friction", (0.45, 0.02))))
    fit = improve(facts, evaluate(facts, [start]), max_iterations=12, tolerance=1e-4)[0]
    widths = profile_widths(facts, fit)
    z, bounds = fit.explanation.z, fit.explanation.bounds
    seen = 0
    for side, sign in enumerate((-1, 1)):
        end = z[0] + sign * widths[0, side]
        if not bounds[0, 0] + 1e-6 < end < bounds[0, 1] - 1e-6:
            continue
        seen += 1
        costs = []
        for other in np.linspace(z[1] - 2, z[1] + 2, 41):
            moved = fit.explanation.moved(np.clip([end, other], *bounds.T))
            costs.append(moved)
        weight = facts.weight(fit.sse)
        lowest = min(
            0.5 * (weight @ trial.sse + trial.explanation.z @ trial.explanation.z) for trial in evaluate(facts, costs)
        )
        assert lowest - 0.5 * (weight @ fit.sse + z @ z) == pytest.approx(0.5 * QUANTILE**2, rel=0.35)
    assert seen == 2


def test_episodes_are_compared_over_their_own_lengths():
    """Two short motions in a log with a long one: neither their padding nor its length says anything of them."""
    pose = np.full((4, 300, 2, 3), np.nan)
    sway = 0.3 * np.sin(np.linspace(0.0, np.pi, 60))
    pose[0] = 0.0
    pose[1:, :60] = 0.0
    pose[1, :60, 0, 1], pose[2, :60, 0, 1], pose[3, :60, 0, 1] = sway, sway, -sway
    assert repeated_motions(pose, np.full(4, 0.1), 1.0).tolist() == [0, 1, 1, 3]


def test_one_motion_at_two_rates_is_one():
    def closing(interval: float) -> np.ndarray:
        pose = np.full((400, 2, 3), np.nan)
        time = interval * np.arange(400)
        pose[time < 20] = 0.0
        pose[time < 20, 1, 0] = 0.9 - 0.02 * time[time < 20]
        return pose

    intervals = np.array([0.1, 0.05, 0.08, 0.1])
    motions = np.stack([closing(interval) for interval in intervals])
    motions[3, :, 1, 1] += 0.2
    assert repeated_motions(motions, intervals, 1.0).tolist() == [0, 0, 0, 3]


def test_a_held_out_score_is_that_of_the_minimum_wherever_the_fit_ended():
    """Within its tolerance: where one motion says nearly all, what is left of the gradient is much beside the rest."""
    facts = evidence(("bending_stiffness", (0.3,)))
    best = improve(facts, evaluate(facts, [explanation(*parts(("bending_stiffness", (0.3,))))]), 8)[0].explanation
    offsets = np.linspace(-4e-4, 4e-4, 17)
    fits = evaluate(facts, [best.moved(best.z + off) for off in offsets])

    def rise(values):
        """From the middle to either end, by a parabola: single values are rounded to a few hundredths."""
        return np.polyfit(offsets / offsets[-1], values, 2)[0]

    assert 0.0 < rise([fit.cost(facts) for fit in fits]) < 0.05
    scores = [facts.log_likelihoods(fit.held_out_sse(facts)).sum() for fit in fits]
    assert abs(rise(scores)) < 0.02
