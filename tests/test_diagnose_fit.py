"""Fits in lockstep: known parameters come back from noisy data, within their bounds, and nothing broken ever wins."""

from __future__ import annotations

import dataclasses
import functools
import types
from collections import Counter

import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.diagnose import LIBRARY, CableEffect, Calibration, Explanation, Parameter, explanation
from cablejax.diagnose.belief import (
    BESIDE_UNKNOWN,
    as_good,
    excess,
    explains_most_motions,
    leftover_p,
    leftover_score,
    level,
    log_scores,
)
from cablejax.diagnose.conclude import conclude, sentence
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit, evaluate, improve
from cablejax.diagnose.gap import held_out_predictions, measure_gap
from cablejax.diagnose.judgement import beside_unknown
from cablejax.diagnose.planar import physics_of
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.posterior import over_laws
from cablejax.diagnose.protocol import Term
from cablejax.diagnose.screen import screen, shortlist
from cablejax.diagnose.search import Search, without_one
from cablejax.effects import BendingStiffness
from cablejax.simulate.chain.replay import LARGEST_STEP
from diagnose_cases import BY_NAME, INTERVAL, SAMPLES, clean, evidence, evidence_of, parts, playback

LOOK_ALIKES = (("bending_stiffness", (0.3,)), ("table_friction", (0.3, 0.0)))
NOTHING = explanation()
OFFSET = ("gripper_rotation_offset", 1, (0.08,))


def fitted(facts: Evidence, effect: CableEffect, base: Explanation = NOTHING) -> Fit:
    """The best of an effect's starts after fitting."""
    starts = shortlist(screen(facts, base, [effect], facts.predict([base])[0]))
    return min(improve(facts, evaluate(facts, starts), max_iterations=15), key=lambda fit: fit.cost(facts))


RECOVERED = {
    "bending_stiffness": (0, (0.5,)),
    "gripper_rotation_offset": (1, (0.08,)),
    "viscous_drag": (0, (2.0,)),
    "keypoint_bias": (9, (0.006,)),
    "intrinsic_curvature": (0, (0.35, 0.2, 1.5)),
    "camera_similarity": (0, (1.01, 0.005, 0.003, -0.002)),
}


@pytest.mark.parametrize("name", RECOVERED)
def test_known_parameters_come_back(name):
    variant, truth = RECOVERED[name]
    facts = evidence((name, variant, truth))
    fit = fitted(facts, BY_NAME[name])
    assert fit.explanation.terms == (Term(BY_NAME[name], variant),)
    true_z = explanation(*parts((name, variant, truth))).z
    deviation = np.sqrt(np.diagonal(np.linalg.inv(fit.precision(facts))))
    assert deviation.max() < 0.1, "the log tells the parameters well"
    np.testing.assert_array_less(np.abs(fit.explanation.z - true_z), 4.5 * deviation)
    # what is left is the noise: a chi-square of as many degrees of freedom
    left = facts.count.sum() - len(true_z)
    assert abs(fit.sse.sum() - left) < 4.5 * np.sqrt(2 * left)


@pytest.mark.slow
def test_the_time_step_does_not_damp():
    """A light cable without friction creeps to rest after a turn of a gripper at a rate of its damping alone."""
    pose = np.tile(np.array([[0.0, 0.0, 0.6], [0.7, 0.0, -0.6]]), (1, 16, 1, 1))
    pose[0, 1:, 0, 2] += 0.2
    config = Discretisation(Cable(friction_coefficient=0.0, linear_density=1e-3), n_links=17)

    def relaxation_time(step: float) -> float:
        player = Playback.of_motion(config, pose, None, np.full(1, 0.1), step)
        points = player.keypoints([player.believed])[0, 0]
        distance = np.linalg.norm((points - points[-1]).reshape(len(points), -1), axis=1)
        return 0.3 / np.log(distance[2] / distance[5])

    assert relaxation_time(LARGEST_STEP) == pytest.approx(relaxation_time(0.002), rel=0.06)


@functools.cache
def soft_and_dragged():
    """A cable that is soft and dragged, and fits of what look alike on it, none at all last."""
    facts = evidence(("bending_stiffness", (0.25,)), ("viscous_drag", (0.3,)), noise_mm=0.02)
    fits = improve(facts, evaluate(facts, [explanation(*parts((n, v))) for n, v in LOOK_ALIKES]), max_iterations=15)
    fits += evaluate(facts, [explanation()])
    return fits, Search.of(fits, facts, Calibration())


def test_a_rival_that_leaves_as_little_is_a_look_alike():
    """However sure the likelihood is: in a wide gap it tells small differences between two laws from each other."""
    fits, found = soft_and_dragged()
    ((_, rival),) = conclude(dataclasses.replace(found, calibration=Calibration(as_good=1e3))).equivalent
    assert rival == "table_friction"
    strict = conclude(dataclasses.replace(found, calibration=Calibration(as_good=1.0)))
    assert strict.equivalent == () and strict.effects[0].probability > 0.99
    # draws of the posterior: each explanation as often as it is probable, none at all among them
    even = dataclasses.replace(found, fits=tuple(fits), scores=np.array([0.0, -0.4, -0.8]))
    posterior = conclude(even).posterior
    counts = Counter(tuple(effect.name for effect in draw) for draw in posterior)
    assert [counts[names] for names in (("bending_stiffness",), ("table_friction",), ())] == [8, 5, 3]
    assert len({draw[0].parameters["ratio"] for draw in posterior[:8]}) == 8


def test_what_does_not_pay_for_itself_stays_open_where_the_nominal_simulator_ranks_first():
    """A gap of which the log shows too little: the next motion is chosen between its complete explanations and none."""
    fits, found = soft_and_dragged()
    best_first = (fits[-1], *fits[:-1])
    open_ = dataclasses.replace(found, fits=best_first, scores=np.array([0.0, -20.0, -30.0]))
    conclusion = conclude(open_)
    assert conclusion.verdict == "unknown" and conclusion.undecided
    assert "too little of it to name the cause" in sentence(conclusion, None)
    kept, chances = open_.in_doubt()
    complete = [fit for fit in fits[:-1] if open_.complete(fit)]
    assert complete and list(map(id, kept)) == list(map(id, [fits[-1], *complete]))
    assert chances.sum() == pytest.approx(1.0) and (chances[1:] > 0.01).all()


def test_of_few_motions_an_explanation_that_leaves_a_little_more_is_as_good():
    facts = evidence(noise_mm=0.5)
    (fit,) = evaluate(facts, [explanation()])

    def leaving(ratio):
        return dataclasses.replace(fit, sse=facts.count * (1 + (10 * ratio) ** 2))

    one = dataclasses.replace(facts, motion=np.zeros(len(facts.count), int))
    for ratio, among_four, alone in ((1.2, True, True), (1.4, False, True), (1.7, False, False)):
        assert as_good(leaving(ratio), leaving(1.0), facts, Calibration()) == among_four
        assert as_good(leaving(ratio), leaving(1.0), one, Calibration()) == alone


def test_a_motion_that_nothing_explains_does_not_hide_the_cause_of_the_others():
    """Three motions with a turned gripper, one with an error that no effect makes: named beside unknown, not a
    look-alike of everything."""
    facts = evidence(("gripper_rotation_offset", 1, (0.08,)), noise_mm=0.5)
    strange = facts.observed.copy()
    # keypoints that swing against each other: no cable does that
    swing = np.sin(np.arange(strange.shape[1]) * INTERVAL)[:, None, None]
    strange[3] += 0.2 * swing * np.where(np.arange(strange.shape[2]) % 2, 1.0, -1.0)[:, None]
    facts = dataclasses.replace(facts, observed=strange)
    trials = [explanation(), explanation(*parts(OFFSET)), explanation(*parts(("bending_stiffness", (0.5,))))]
    null, right, wrong = improve(facts, evaluate(facts, trials), max_iterations=10)
    calibration = Calibration()
    assert explains_most_motions(right, null, facts, calibration)
    assert not explains_most_motions(wrong, null, facts, calibration)
    # over the whole log all leave about the same
    assert excess(wrong, facts) < calibration.as_good * excess(right, facts)
    assert not as_good(wrong, right, facts, calibration)
    assert as_good(right, right, facts, calibration)
    conclusion = conclude(Search.of([right, wrong, null], facts, calibration))
    assert conclusion.verdict == "named+unknown" and conclusion.explained < calibration.telling
    # beside an unknown cause a name may only resemble it; where nobody has counted how often, it has no probability
    (effect,) = conclusion.effects
    assert effect.probability == pytest.approx(BESIDE_UNKNOWN, rel=1e-3)
    assert beside_unknown(effect, None).probability is None
    assert [effect.name for effect in conclusion.effects] == ["gripper_rotation_offset"]
    assert conclusion.equivalent == ()
    left, gap = (excess(fit, facts) for fit in (right, null))
    assert conclusion.leftover_p == leftover_p(leftover_score(left, gap, level(facts), calibration)) < 0.05
    assert ", 70 %, looks" in sentence(conclusion, 0.7) and ", 0 %, looks" in sentence(conclusion, -0.2)
    assert 0 < conclusion.explained < 0.01 and ", less than 1 %, looks" in sentence(conclusion, None)


def test_two_effects_come_back_together():
    stiff = ("bending_stiffness", (0.5,))
    facts = evidence(stiff, OFFSET)
    one = fitted(facts, BY_NAME["gripper_rotation_offset"])
    both = fitted(facts, BY_NAME["bending_stiffness"], one.explanation)
    (angle,), (ratio,) = both.explanation.values()
    assert angle == pytest.approx(0.08, abs=0.002) and ratio == pytest.approx(0.5, rel=0.05)
    assert both.sse.sum() < 0.5 * one.sse.sum()


def test_the_true_effect_explains_most_at_first_sight():
    facts = evidence(OFFSET)
    effects = [BY_NAME[n] for n in ("bending_stiffness", "gripper_rotation_offset", "keypoint_bias", "viscous_drag")]
    templates = screen(facts, explanation(), effects, facts.nominal)
    best = max(templates, key=lambda t: t.explained)
    assert best.start.terms[0] == Term(BY_NAME["gripper_rotation_offset"], 1)
    assert 0.97 < best.explained < 1.03
    assert best.start.values()[0][0] == pytest.approx(0.08, abs=0.006), "stretched to the size of the gap"


def test_what_an_effect_leaves_is_the_noise():
    facts = evidence(OFFSET)
    left = facts.observed - facts.predict([explanation(*parts(OFFSET))])[0]
    assert left.std() == pytest.approx(5e-4, rel=0.03)


class _Bounded(BendingStiffness):
    name = "bounded"
    parameters = (Parameter("ratio", "", 0.7, 1.3, 1.0, 1.0, log=True),)

    def starts(self, context):
        return [(0, (0.9,)), (0, (1.1,))]


@pytest.mark.parametrize(("truth", "bound"), [(0.4, 0.7), (2.5, 1.3)])
def test_bounds_are_respected(truth, bound):
    facts = evidence(("bending_stiffness", (truth,)))
    fit = fitted(facts, _Bounded())
    assert fit.explanation.values()[0][0] == pytest.approx(bound, rel=1e-6)
    low, high = fit.explanation.bounds.T
    assert (fit.explanation.z >= low).all() and (fit.explanation.z <= high).all()


def test_a_start_beyond_the_bounds_is_brought_back():
    (term_bounds,) = explanation((_Bounded(), 0, (5.0,))).bounds
    assert explanation((_Bounded(), 0, (5.0,))).z[0] == term_bounds[1]


class _Broken(CableEffect):
    """Breaks the simulation down once its parameter exceeds a limit, and explains nothing."""

    name = "broken"
    parameters = (Parameter("amount", "", -1.0, 10.0, 0.0, 1.0),)
    null = (0.0,)
    limit = 0.0

    def apply(self, physics, values, variant, config):
        bad = np.float32(np.nan if float(values[0]) > self.limit else 1.0)
        return dataclasses.replace(physics, stiffness=physics.stiffness * bad)

    def starts(self, context):
        return [(0, (1.0,))]


def test_a_broken_simulation_never_wins():
    facts = evidence(OFFSET)
    broken = explanation((_Broken(), 0, (1.0,)))
    null, dead, good = evaluate(facts, [explanation(), broken, explanation(*parts(OFFSET))])
    assert (dead.sse > 1e9).all() and not dead.gradient.any() and not dead.curvature.any()
    assert np.isfinite(dead.cost(facts)) and dead.cost(facts) > null.cost(facts) > good.cost(facts)
    scores = log_scores([null, dead, good], facts, Calibration())
    assert np.isfinite(scores).all() and scores.argmin() == 1 and scores.argmax() == 2
    assert screen(facts, explanation(), [_Broken()], facts.nominal) == [], "no template of a breakdown"


def test_a_fit_does_not_step_into_a_breakdown():
    class Edge(BendingStiffness):
        """Stiffness that the simulation only bears above 0.55."""

        def apply(self, physics, values, variant, config):
            bad = np.float32(np.nan if float(values[0]) < 0.55 else 1.0)
            return dataclasses.replace(physics, stiffness=physics.stiffness * values[0] * bad)

    facts = evidence(("bending_stiffness", (0.4,)))
    start = evaluate(facts, [explanation((Edge(), 0, (0.9,)))])[0]
    fit = improve(facts, [start], max_iterations=15)[0]
    assert np.isfinite(fit.explanation.z).all() and (fit.sse < 1e9).all()
    assert 0.55 <= fit.explanation.values()[0][0] < 0.7 and fit.cost(facts) < start.cost(facts)


def test_iterations_never_make_a_fit_worse():
    facts = evidence(("bending_stiffness", (0.5,)), OFFSET)
    starts = shortlist(
        screen(facts, explanation(), [BY_NAME["bending_stiffness"], BY_NAME["viscous_drag"]], facts.nominal)
    )
    before = evaluate(facts, starts)
    after = improve(facts, before, max_iterations=3)
    assert all(a.cost(facts) <= b.cost(facts) for a, b in zip(after, before, strict=True))


def test_candidates_do_not_disturb_each_other():
    """Many candidates share a batch; each must come out as it does alone."""
    facts = evidence(OFFSET)
    several = [explanation(*parts(OFFSET)), explanation(), explanation(*parts(("bending_stiffness", (0.5,)), OFFSET))]
    for together, one in zip(evaluate(facts, several), several, strict=True):
        (alone,) = evaluate(facts, [one])
        np.testing.assert_allclose(together.sse, alone.sse, rtol=1e-5)
        np.testing.assert_allclose(together.curvature, alone.curvature, rtol=1e-3, atol=1e-3)


def test_missing_keypoints_do_not_count():
    facts = evidence(OFFSET)
    target = facts.observed.copy()
    target[0, 10:20, 3] = np.nan
    some = dataclasses.replace(facts, observed=target)
    np.testing.assert_array_equal(facts.count - some.count, [20, 0, 0, 0])
    (fit,) = evaluate(some, [explanation(*parts(OFFSET))])
    assert np.isfinite(fit.sse).all() and np.isfinite(fit.gradient).all()


def test_restricted_evidence_is_that_of_the_episodes():
    facts = evidence(OFFSET)
    whole, part = (evaluate(f, [explanation(*parts(OFFSET))])[0] for f in (facts, facts.restricted([2, 0])))
    np.testing.assert_allclose(part.sse, whole.sse[[2, 0]], rtol=1e-5)


def test_held_out_errors_are_those_of_a_fit_without_the_episode():
    effects = (("bending_stiffness", (0.5,)), OFFSET)
    facts = evidence(*effects, noise_mm=2.0)
    (fit,) = improve(facts, evaluate(facts, [explanation(*parts(*effects))]), max_iterations=10)
    short = fit.held_out_sse(facts)
    assert (short >= fit.sse).all() and (short - fit.sse).max() > 0.1
    without = []
    for episode in range(len(short)):
        rest = fit.precision(facts) - fit.curvature[episode]
        step = np.linalg.solve(rest, fit.gradient[episode])
        without.append(fit.explanation.moved(fit.explanation.z + step))
    for episode, seen in enumerate(evaluate(facts, without)):
        expected = max(seen.sse[episode], fit.sse[episode])
        assert short[episode] == pytest.approx(expected, abs=0.3 + 0.1 * abs(expected - fit.sse[episode]))


def test_every_start_of_the_library_lies_within_its_bounds():
    facts = evidence(OFFSET)
    for effect in LIBRARY:
        for variant, values in facts.simulator.starts(effect, facts.nominal, facts.observed - facts.nominal):
            assert variant in effect.variants
            for parameter, value in zip(effect.parameters, values, strict=True):
                assert parameter.low <= value <= parameter.high, (effect.name, parameter.name, value)


def test_the_headline_lists_no_cause_whose_probability_is_below_one_per_cent():
    """A likelihood may be sure against a look-alike that leaves as little: it is mentioned, not listed as a cause."""
    _, found = soft_and_dragged()
    conclusion = conclude(dataclasses.replace(found, calibration=Calibration(as_good=1e3, adequate=1.0)))
    assert conclusion.verdict == "ambiguous" and conclusion.ranking[1].probability < 0.01
    words = sentence(conclusion, 0.9)
    assert words.startswith("The gap comes from bending stiffness.")
    assert "Table friction would leave as little of the gap, but with a probability below 1 %." in words
    (named,) = conclusion.effects
    assert named.alike["table_friction"] < 0.01
    even = dataclasses.replace(conclusion, effects=(dataclasses.replace(named, alike=dict.fromkeys(named.alike, 0.5)),))
    assert "cannot tell apart: bending stiffness or table friction." in sentence(even, 0.9)


@pytest.mark.slow
def test_padding_is_not_simulated_and_changes_nothing():
    """Episodes of other lengths than their arrays: the same keypoints up to their end, the last ones from there on."""
    player = playback(17)
    believed, length = player.believed, np.array([60, 100, 41, 60])
    stiff = dataclasses.replace(believed, stiffness=2 * believed.stiffness)
    lagging = dataclasses.replace(believed, camera_lag=np.float32(0.25))
    obstacle = physics_of(explanation(*parts(("obstacle", (0.3, 0.2, 0.03)))), believed, player.config)
    physics = [believed, obstacle, stiff, lagging]
    whole, cut = (p.keypoints(physics) for p in (player, dataclasses.replace(player, length=length)))
    for e, n in enumerate(length):
        np.testing.assert_allclose(cut[:, e, :n], whole[:, e, :n], rtol=0, atol=1e-6)
    # a batch runs as long as its longest episode, here all of one
    alone = dataclasses.replace(player, length=length, rows=2).keypoints([believed, stiff], [2, 0])
    np.testing.assert_allclose(alone[:, 0, :41], whole[::2, 2, :41], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(alone[:, 0, 41:], np.repeat(alone[:, 0, 40:41], SAMPLES - 41, axis=1))
    assert np.abs(whole[:, 2, 41:] - whole[:, 2, 40:41]).max() > 1e-3


def test_held_out_predictions_are_those_of_fits_without_each_motion():
    """An effect that one motion alone shows is left out there; what the others show is fitted without it."""
    stiff, bias = ("bending_stiffness", (0.5,)), ("keypoint_bias", 4, (0.004,))
    points = clean(stiff, n_links=17).copy()
    points[2] = clean(stiff, bias, n_links=17)[2]
    facts = evidence_of(points)
    (best,) = improve(facts, evaluate(facts, [explanation(*parts(stiff, bias))]), max_iterations=10)
    predicted, held_out = held_out_predictions(facts, best)
    assert held_out == (0, 1, 2, 3)
    for e in range(4):
        rest = facts.restricted([i for i in range(4) if i != e])
        starts = evaluate(rest, [best.explanation, *without_one(best.explanation)])
        (fit,) = improve(rest, starts[:1], max_iterations=2)
        simpler = min(starts[1:], key=lambda one: one.cost(rest))
        assert (simpler.cost(rest) < starts[0].cost(rest) + 2.0) == (e == 2)
        expected = (simpler if e == 2 else fit).explanation
        np.testing.assert_allclose(predicted[e], facts.predict([expected])[0, e], rtol=0, atol=1e-5)


def test_a_simulation_that_breaks_down_explains_nothing():
    random, shape = np.random.default_rng(0), (4, 200, 2)
    observed = 1e-3 * random.standard_normal(shape)
    before, after = observed + 0.02, observed + 0.02
    after[2:] = np.nan
    bare = types.SimpleNamespace(unit="m")
    facts = Evidence(
        simulator=bare, episodes=np.arange(4), observed=observed, nominal=before, noise=np.array(1e-3),
        temper=np.ones(4), freedom=6.0, motion=np.arange(4),
    )  # fmt: skip
    time = {"interval": np.full(4, 0.1), "length": np.full(4, 200)}
    gap = measure_gap(facts, before, after, **time, held_out=(0, 1, 2, 3), resolvable=True)
    assert gap.shrinkage == 0.0 and gap.split["named"] == 0.0
    late = observed.copy()
    late[:, :15] = np.nan
    facts = dataclasses.replace(facts, observed=late)
    gap = measure_gap(facts, before, before, **time, held_out=(), resolvable=True)
    assert list(gap.horizons_mm) == [2.0, 5.0, 10.0, 19.9] and np.isfinite(list(gap.horizons_mm.values())).all()
    quiet = dataclasses.replace(facts, observed=observed, noise=np.array(0.1))
    assert measure_gap(quiet, before, before, **time, held_out=(0,), resolvable=True).shrinkage is None


def test_draws_by_laws_whose_shares_were_rounded_up_are_no_more_than_asked():
    own = np.zeros((400, 1))
    drawn = over_laws(own, [(chance, np.ones((400, 1))) for chance in (0.401, 0.351, 0.247)])
    assert drawn.shape == (400, 1) and drawn.mean() > 0.99
