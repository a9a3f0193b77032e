"""Estimates hold the true values, know what the recordings cannot tell, and say so by the names of the gap log."""

from __future__ import annotations

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.stats import t

import spatial_cases as cases
from cablejax.diagnose.fit import Fit, evaluate, improve
from cablejax.diagnose.protocol import explanation
from cablejax.simulate.rod import Rod
from cablejax.spatial.cable import FINER, TWISTED, SpatialCable
from cablejax.spatial.caveats import caveats
from cablejax.spatial.effects import effects_of
from cablejax.spatial.estimate import REPORTED, UNMODELLED, Interval, estimate, restarts
from cablejax.spatial.identify import Identified, TimeSteps, _for_predictions, layout_of
from cablejax.spatial.named import named_effects, parameters_of, quantities_of, with_both_drags
from cablejax.spatial.uncertainty import jackknife
from cablejax.spatial.windows import windows_of

_FOUND = ("bending_stiffness", "bending_damping")
_TRUE_STIFFNESS = cases.TRUE_RATIO * cases.NOMINAL


@pytest.fixture(scope="module")
def fitted():
    """A cable whose stiffness and damping were fitted, and the explanation."""
    windows = windows_of(cases.recording())
    cable = SpatialCable(Rod(16, twisting=False), layout_of(windows, cases.NOMINAL), windows)
    start = explanation(*((cable.layout.named(n), 0, (v,)) for n, v in zip(_FOUND, (1.0, 0.05), strict=True)))
    evidence = cable.evidence()
    (fit,) = improve(evidence, evaluate(evidence, [start]), 40)
    return cable, fit.explanation


@pytest.fixture(scope="module")
def estimated(fitted):
    """The estimate when so many more effects were tried, made once."""
    cable, best = fitted

    @functools.cache
    def with_tried(*more: str):
        return estimate(cable, [best], (*_FOUND, *more))

    return with_tried


@pytest.fixture(scope="module")
def everything(fitted, estimated):
    """With all that the rod without twist can be taught."""
    return estimated(*(e.name for e in fitted[0].layout.effects if e.name not in (TWISTED, *_FOUND)))


@pytest.fixture(scope="module")
def found(fitted, everything):
    """What an identification that tried all effects ends with."""
    cable = fitted[0]
    tried = tuple(effect.name for effect in cable.layout.effects)
    first = np.arange(len(cable.windows)) < 2
    return Identified(cable, TimeSteps(1, 0.0), _FOUND, tried, (), everything, (everything, everything), first)


def _width(interval):
    return np.log(interval.high / interval.low)


@pytest.mark.slow
def test_is_wider_the_more_may_be_true_and_holds_the_true_value(estimated):
    more = (), ("viscous_drag",), ("viscous_drag", "lumped_mass")
    estimates = [estimated(*names) for names in more]
    intervals = [one.stiffness for one in estimates]
    widths = [_width(interval) for interval in intervals]
    assert 0 < widths[0] < widths[1] < widths[2] < 0.2
    # apart from the scatter of four recordings and the error of the edges, which are as wide as what the drag adds
    alone = [dataclasses.replace(one, moves=0 * one.moves, shifts=one.shifts[:-1]) for one in estimates]
    priors = [_width(one.stiffness) for one in alone]
    assert 0 < priors[0] < 0.5 * priors[1] and priors[1] < 0.5 * priors[2]
    for interval in intervals[1:]:
        assert interval.low < _TRUE_STIFFNESS < interval.high


@pytest.mark.slow
def test_stiffness_and_drag_are_told_with_the_markers_mass_free(estimated):
    without, found_with = estimated("viscous_drag"), estimated("viscous_drag", "lumped_mass")
    assert found_with.drag.high - found_with.drag.low == pytest.approx(without.drag.high - without.drag.low, rel=0.05)
    # per mass of the bare cable it would not be known
    layout = found_with.layout
    bare = found_with.ratio(lambda values: layout.log_stiffness(values) + jnp.log(layout.laden(values)))
    assert _width(without.stiffness) < _width(found_with.stiffness) < 0.2 * _width(bare)
    laden, spacing = float(layout.laden(found_with.shared)), cases.LENGTH / (len(cases.MARKS) + 1)
    mass = found_with.shared[layout.slices["marker_mass"]].item()
    assert laden == pytest.approx(1 + mass / spacing, rel=1e-3)
    assert found_with.marker_mass.value * laden == pytest.approx(mass)


def test_no_effect_takes_the_place_of_another_stiffness_of_the_whole_cable(fitted):
    layout = fitted[0].layout
    plain = layout.physics(layout.null)
    values = layout.null.copy()
    values[layout.slices["log_profile"]] = 0.7
    jax.tree.map(np.testing.assert_array_equal, layout.physics(values), plain)
    values[layout.slices["log_profile"]] = [0.5, -0.1, 0.3, 0.0, -0.4]
    assert np.log(layout.physics(values).stiffness).mean() == pytest.approx(np.log(plain.stiffness).mean())
    # the mass of the markers leaves EI and drag over the mass of all as they are
    values = layout.null.copy()
    values[layout.slices["drag"]], values[layout.slices["marker_mass"]] = 0.5, 0.03
    loaded, laden = layout.physics(values), layout.laden(values)
    assert laden > 1.1 and loaded.drag / laden == pytest.approx(0.5)
    np.testing.assert_allclose(loaded.stiffness / laden, plain.stiffness)
    np.testing.assert_allclose(loaded.twist_stiffness / laden, plain.twist_stiffness)


def test_an_interval_grows_by_an_error_besides_and_no_less_to_its_wide_side():
    plain = Interval(2.0, 1.0, 4.0)
    assert plain.wider(0.0) == plain
    wider = plain.wider(1.0)
    assert (2.0 - wider.low, wider.high - 2.0) == pytest.approx((np.hypot(1.0, 1.645), np.hypot(2.0, 1.645)), rel=1e-3)
    factor = plain.wider_by_factor(1.0)
    assert factor.value == 2.0 and np.log(2.0 / factor.low) == pytest.approx(np.log(factor.high / 2.0))
    assert np.log(factor.high / 2.0) == pytest.approx(np.hypot(np.log(2.0), 1.645), rel=1e-3)


def test_what_is_told_is_wider_by_what_the_law_leaves_out(everything):
    for name, more in UNMODELLED.items():
        told = parameters_of(name, everything, 0.05)[0]
        plain = parameters_of(name, everything, 0.05, unmodelled={})[0]
        for key, parameter in plain.items():
            if parameter.ci90 is not None:
                wide, narrow = (np.ptp(np.reshape(np.array(p.ci90), (-1, 2)), axis=1) for p in (told[key], parameter))
                assert (wide > narrow).all() and more > 0
                assert told[key].value == parameter.value


def test_says_more_from_more_recordings(fitted, estimated):
    cable, best = fitted
    two, every = estimate(cable.on(cable.windows.chosen([0, 1])), [best], _FOUND), estimated()
    # what the edges leave open stays so, however many recordings there are
    few, all_ = (dataclasses.replace(one, shifts=one.shifts[:-1]).stiffness for one in (two, every))
    assert _width(all_) < 0.7 * _width(few)
    assert _width(every.stiffness) < _width(two.stiffness)


def test_tells_every_effect_with_its_interval(found, everything):
    stiffness, damping = named_effects(found, 0.05)
    assert stiffness.probability is None and damping.probability is None
    (ratio, absolute), (time,) = stiffness.parameters.values(), damping.parameters.values()
    assert absolute.unit == "m^4/s^2" and absolute.value == pytest.approx(ratio.value * cases.NOMINAL)
    assert ratio.value == pytest.approx(cases.TRUE_RATIO, rel=0.05)
    # there is no drag, and none is taken for damping
    assert time.value == pytest.approx(cases.TRUE_DAMPING, rel=0.05)
    assert ratio.value == pytest.approx(everything.stiffness.value / cases.NOMINAL)
    for effect in (e.name for e in found.cable.layout.effects if e.name != TWISTED):
        parameters, along = parameters_of(effect, everything, 0.05)
        assert (along is None) == (effect != "stiffness_profile")
        for parameter in parameters.values():
            if parameter.ci90 is not None:
                low, high = np.reshape(parameter.ci90, (-1, 2)).T
                assert (low <= np.ravel(parameter.value)).all() and (np.ravel(parameter.value) <= high).all()


def test_ei_over_rho_is_always_told_and_ei_where_the_density_is_known(found):
    known = quantities_of(found, 0.05)
    ratio, stiffness = known["stiffness_over_density_m4_per_s2"], known["bending_stiffness_n_m2"]
    assert (ratio.unit, stiffness.unit) == ("m^4/s^2", "N m^2")
    assert ratio.ci90[0] < _TRUE_STIFFNESS < ratio.ci90[1]  # type: ignore[index]
    assert stiffness.value == pytest.approx(0.05 * ratio.value)
    np.testing.assert_allclose(np.array(stiffness.ci90), 0.05 * np.array(ratio.ci90))
    assert "bending_stiffness_n_m2" not in quantities_of(found, None)
    # there is no drag
    low, high = known["drag_at_speed_per_s"].ci90  # type: ignore[misc]
    assert low == 0.0 < high and known["drag_at_speed_per_s"].value < 0.05
    # nothing is known of what was not free
    assert quantities_of(dataclasses.replace(found, tried=("bending_damping",)), 0.05) == {}


def _finer(cable):
    return dataclasses.replace(cable, rod=Rod(48, FINER, twisting=False))


@pytest.mark.slow
def test_few_edges_are_extrapolated_to_ever_more_and_the_next_order_shows_what_is_left(fitted):
    cable, best = fitted
    exact, begun = cable.exact(), cable.windows.valid
    motions = {"this": exact.motion(best)}
    motions |= {"next": motions["this"] + exact.left_by_edges(best)}
    # 48 edges have a quarter of the error of 26
    finer = _finer(cable).motion(best)
    motions |= {"most": exact.with_most_edges().motion(best)}
    motions |= {"true": finer + (finer - motions["most"]) / ((48 / 26) ** 2 - 1)}

    def apart(one, other):
        return np.abs(motions[one] - motions[other])[begun].mean()

    left = apart("this", "true")
    assert left < apart("most", "true") / 5
    assert left < apart("this", "next") < apart("this", "most") / 3


def test_few_edges_and_long_steps_do_not_pass_for_another_stiffness(fitted):
    cable, best = fitted
    coarse = cable.on(dataclasses.replace(cable.windows, keypoints=_finer(cable).motion(best)))
    evidence = coarse.evidence()
    (fit,) = improve(evidence, evaluate(evidence, [best]), max_iterations=40, tolerance=0.02)
    told = estimate(coarse, [best], _FOUND)
    uncorrected, true = (cases.NOMINAL * one.values()[0][0] for one in (fit.explanation, best))
    assert told.settled and told.stiffness.value == pytest.approx(true, rel=3e-3)
    assert abs(uncorrected / true - 1) > 0.02


@pytest.mark.slow
def test_does_not_stay_where_a_search_took_the_grips_astray(fitted):
    cable, best = fitted
    grips, said = cable.layout.named("gripper_rotation_offset"), []
    start = cable.with_own(best.plus((grips, 0, grips.null)))
    astray = start.moved(start.z, start.own + 8.0)
    told = estimate(cable, restarts(astray), (*_FOUND, grips.name), progress=said.append)
    assert told.settled and told.stiffness.value == pytest.approx(_TRUE_STIFFNESS, rel=0.02)
    # from there alone the second round still moves by 40 standard errors
    moves = [float(text.split()[-3]) for text in said if "standard errors" in text]
    assert moves[1] < 5


def _named(found, values):
    """Effects that are named where these are the fitted values."""
    return [e.name for e in named_effects(_at(found, values), 0.05)]


def _at(found, values):
    return dataclasses.replace(found, everything=_valued(found.everything, values))


def _valued(everything, values):
    """The estimate with these values."""
    one, layout = everything.explanation, everything.layout
    other = explanation(*((term.effect, term.variant, values[layout.slots(term.effect.name)]) for term in one.terms))
    return dataclasses.replace(everything, explanation=one.moved(other.z))


def test_values_that_the_simulators_own_error_may_hide_are_said_to_be_unsure(found):
    def said(part, *, compared=None, own=1e-4, after=1e-4):
        return sum(part in words for words in caveats(found.cable.windows, 0, found, compared, own, after))

    unsure, nominal, begun = "more than their intervals: record", "errors of the nominal cable", "The gap is therefore"
    assert not said(unsure) and not said(nominal) and not said(begun)
    assert said(nominal, own=0.06) == 1 and not said(unsure, own=0.06)
    assert said(unsure, after=0.06) == 1 and not said(nominal, after=0.06)
    assert said(begun, compared=1.0) == 1


def test_a_cable_that_bends_over_too_short_or_too_long_a_stretch_is_said_to(found, everything):
    def said(times):
        values = everything.shared.copy()
        values[everything.layout.slices["ratio"]] *= times
        words = caveats(found.cable.windows, 0, _at(found, values), None, 1e-4, 1e-4)
        return [part for part in words if part.startswith("By its estimated stiffness")]

    assert not said(1)
    assert "less than an edge" in said(1e-3)[0] and "more than a third of its length" in said(1e2)[0]


def test_a_clamp_beyond_the_last_keypoint_is_no_keypoint(found, everything):
    values, along = everything.shared.copy(), everything.layout.slices["along"]
    values[along.start], values[along.stop - 1] = 0.02, 0.03
    off, windows = _at(found, values), found.cable.windows
    first, last = windows.held[0], windows.held[0] + len(windows.arclength) - 1

    def displaced(count):
        cable = found.cable.on(dataclasses.replace(windows, n_keypoints=count))
        named = {e.name: e for e in named_effects(dataclasses.replace(off, cable=cable), 0.05)}
        return named["keypoint_bias"].parameters["index"].value

    assert displaced(last + 1) == [first, last] and displaced(last) == [first]


def test_names_only_what_the_estimate_shows(found, everything):
    # of a cable that is stiffer than believed, everywhere alike, and has some damping, whatever stayed in the search
    for stayed in ((), _FOUND, found.tried[:-1]):
        named = named_effects(dataclasses.replace(found, effects=stayed), 0.05)
        assert [effect.name for effect in named] == list(_FOUND)
    # of one whose bends are shorter than an edge: only what stayed in the search
    soft = everything.shared.copy()
    soft[everything.layout.slices["ratio"]] *= 1e-3
    chain = _at(found, soft)
    assert found.resolved and not chain.resolved
    for stayed in ((), _FOUND[1:]):
        named = named_effects(dataclasses.replace(chain, effects=stayed), 0.05)
        assert [effect.name for effect in named] == list(stayed)
    # an estimate of a softer middle that is held on both sides
    values, where = everything.shared.copy(), everything.layout.slices["log_profile"]
    values[where] += [0.0, 0.0, 1.5, 0.0, 0.0]
    assert "stiffness_profile" in _named(found, values)
    # damping that the integrator's own could be
    hidden, step = everything.shared.copy(), found.cable.windows.interval / found.time_steps.substeps
    hidden[everything.layout.slices["damping_time"]] = 0.25 * step
    assert "bending_damping" not in _named(found, hidden)


def test_predictions_have_as_many_edges_and_time_steps_as_matter(fitted):
    """Of what fits a motion at 50 Hz few are enough; of one of which nothing is left, all that it was corrected for."""
    cable, best = fitted
    noisy = dataclasses.replace(
        cable.windows,
        keypoints=cable.windows.keypoints + np.random.default_rng(0).normal(0, 0.02, cable.windows.keypoints.shape),
    )
    exact = dataclasses.replace(cable.windows, keypoints=cable.exact().motion(best))
    few, all_ = (_for_predictions(cable.on(windows), best) for windows in (noisy, exact))
    assert (few.rod.substeps, all_.rod.substeps) == (cable.rod.substeps, FINER * cable.rod.substeps)
    assert (few.edges, all_.edges) == ((26,), (16, 26))


def test_what_is_predicted_with_the_named_effects_alone_has_no_other(found, everything):
    alone, with_all = found.unseen(_FOUND)[0], found.unseen()[0]
    fitted = everything.explanation
    assert set(fitted.names) > set(_FOUND)
    values = dict(zip(fitted.names, fitted.values(), strict=True))
    only = explanation(*((found.cable.layout.named(name), 0, values[name]) for name in _FOUND))
    np.testing.assert_allclose(alone, found.cable.motion(only), atol=1e-9)
    np.testing.assert_array_equal(with_all, found.cable.motion(fitted))
    # there is no other effect, so the two are near
    assert 0 < np.abs(alone - with_all).max() < 5e-3
    assert np.array_equal(found.unseen(())[0], found.cable.motion(explanation()))
    # of a drag, motion shows the sum of both laws
    assert with_both_drags(["viscous_drag", "lumped_mass"]) == {"viscous_drag", "quadratic_drag", "lumped_mass"}
    assert with_both_drags(_FOUND) == set(_FOUND)


def test_of_the_drags_their_sum_is_told_by_the_name_of_the_larger_one(found, everything):
    values, where = everything.shared.copy(), everything.layout.slices
    values[where["drag"]], values[where["quadratic_drag"]] = 0.2, 0.5
    for linear, name in ((0.2, "quadratic_drag"), (0.6, "viscous_drag")):
        values[where["drag"]] = linear
        dragged = _at(found, values)
        (drag,) = (effect for effect in named_effects(dragged, 0.05) if "drag" in effect.name)
        assert drag.name == name and set(drag.parameters) == {"drag_at_speed_per_s", "speed_m_per_s"}
        assert drag.parameters["drag_at_speed_per_s"].value == pytest.approx(linear + 0.5 * everything.speed)
        # what stayed in the search keeps its name
        stayed = dataclasses.replace(found, effects=("viscous_drag",))
        assert [name for name in _named(stayed, values) if "drag" in name] == ["viscous_drag"]
    assert everything.speed == pytest.approx(found.cable.windows.speed)


def test_drag_and_mass_may_be_zero_and_not_less(everything):
    # there is neither
    for effect, name in (("viscous_drag", "drag_at_speed_per_s"), ("lumped_mass", "mass_kg")):
        told = parameters_of(effect, everything, 0.05)[0][name]
        low, high = told.ci90  # type: ignore[misc]
        assert low == 0.0 <= told.value < high


def test_many_intervals_hold_together(everything):
    one = Interval(1.0, 0.0, 3.0)
    assert one.among(1, 7) == one
    five = one.among(5, 10**6)
    assert (five.high - 1.0) / 2.0 == pytest.approx(1.0 - five.low) == pytest.approx(2.326 / 1.645, rel=1e-3)
    # of the means of four recordings each, all five hold in nine of ten cases
    random = np.random.default_rng(0).normal(size=(4000, 4, 5))
    mean, error = random.mean(axis=1), t.ppf(REPORTED, 3) * random.std(axis=1, ddof=1) / 2
    wider = Interval(0.0, -1.0, 1.0).among(5, 3).high
    assert 0.9 <= (np.abs(mean) < wider * error).all(axis=1).mean() < 0.94


def test_a_value_at_its_bound_leaves_the_others_as_uncertain_as_they_are():
    stiffness, drag = (e for e in effects_of(6, 0.0) if e.name in ("bending_stiffness", "viscous_drag"))
    random, count = np.random.default_rng(1), 8
    slopes = random.normal(size=(count, 40, 2))
    # by itself the drag would be far below 0; recordings differ in stiffness
    seen = slopes @ [0.5, -3.0] + slopes[..., 0] * random.normal(0.0, 0.5, (count, 1)) + random.normal(size=(count, 40))

    def best(use):
        design = np.vstack([slopes[use].reshape(-1, 2), np.eye(2)])
        return lsq_linear(design, np.append(seen[use], [0.0, 0.0]), ([-np.inf, 0.0], np.inf), tol=1e-14).x

    every = np.ones(count, bool)
    one = explanation((stiffness, 0, (1.0,)), (drag, 0, (0.0,))).moved(best(every))
    off = slopes @ one.z - seen
    squares = np.einsum("emp,emq->epq", slopes, slopes)
    fit = Fit(one, (off**2).sum(axis=1), np.einsum("emp,em->ep", slopes, off), squares)
    evidence = types.SimpleNamespace(
        simulator=types.SimpleNamespace(recording=np.arange(count)),
        episodes=np.arange(count),
        weight=lambda sse: np.ones(len(sse)),
    )
    left_out = np.array([best(np.arange(count) != k) for k in range(count)]) - one.z
    exact = np.sqrt((count - 1) / count * (left_out**2).sum(axis=0))
    error = np.linalg.norm(jackknife(evidence, fit), axis=0)  # type: ignore[arg-type]
    assert np.abs(one.z[1]) < 1e-12 and exact[1] < 1e-12
    assert error[0] == pytest.approx(exact[0], rel=0.01)
    # that it cannot be lower does not make it certain
    assert error[1] > 0.01


def test_a_mass_is_told_per_density(everything):
    values = everything.shared.copy()
    values[everything.layout.slices["marker_mass"]] = 0.01
    heavy = _valued(everything, values)
    one, other = (parameters_of("lumped_mass", heavy, density)[0]["mass_kg"] for density in (0.05, 0.1))
    assert other.value == pytest.approx(2 * one.value)
    np.testing.assert_allclose(np.array(other.ci90), 2 * np.array(one.ci90))


def test_refuses_an_effect_that_it_does_not_know(everything):
    with pytest.raises(ValueError, match="'axial_stretch', expected one of"):
        parameters_of("axial_stretch", everything, 0.05)
