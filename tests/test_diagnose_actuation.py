"""What the arms do wrong is told from commands and encoders alone."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.diagnose import Calibration, explanation
from cablejax.diagnose.actuation import actuation
from cablejax.diagnose.actuation_verdict import with_arms
from cablejax.diagnose.case import calibrated
from cablejax.diagnose.conclude import Conclusion, sentence
from cablejax.diagnose.diagnosis import EffectValues
from cablejax.diagnose.fit import Fit
from cablejax.effects.arms import lag_weights, lagged
from cablejax.types import ROTATION_WEIGHT
from diagnose_cases import INTERVAL, MOTIONS, poses

FINE = 20
"""Steps between two samples in which the true lag is integrated."""


def test_a_slow_arm_that_rests_far_from_the_origin_does_not_drift():
    poses = np.full((2000, 2, 3), 100.0, np.float32)
    for xp in (np, jnp):
        assert (np.asarray(lagged(xp.asarray(poses), 0.1, 0.25, np.float32(30.0))) == 100.0).all()


def test_weights_of_a_slow_lag_add_up_in_single_precision():
    kept, before, after = lag_weights(np.float32(300.0))
    assert float(before) == pytest.approx(0.5 / 300, rel=1e-2) and float(after) == pytest.approx(0.5 / 300, rel=1e-2)
    assert float(kept + before + after) == pytest.approx(1.0, abs=2e-7)


def commands() -> np.ndarray:
    """Twists that carry the grippers along the motions, shape [E, T, 2, 3]."""
    wanted = np.stack([poses(m) for m in MOTIONS])
    twist = np.zeros_like(wanted)
    twist[:, :-1] = np.diff(wanted, axis=1) / INTERVAL
    return twist


def arms(*, gain: float = 1.0, delay: float = 0.0, slow: float = 0.0, backlash: float = 0.0, noise: float = 2e-5):
    """Measured poses of arms that scale, delay, smooth, and play; integrated in small steps."""
    wanted = np.stack([poses(m) for m in MOTIONS])
    moved = wanted[:, :1] + gain * (wanted - wanted[:, :1])
    n = moved.shape[1]
    fine = np.arange((n - 1) * FINE + 1) / FINE
    before = np.minimum(fine.astype(int), n - 2)
    share = (fine - before)[:, None, None]

    def at(path, times):
        times = np.clip(times, 0, n - 1)
        lower = np.minimum(times.astype(int), n - 2)
        weight = (times - lower)[:, None, None]
        return (1 - weight) * path[lower] + weight * path[lower + 1]

    measured = []
    for path in moved:
        target = at(path, fine - delay / INTERVAL) if delay else (1 - share) * path[before] + share * path[before + 1]
        state, states = target[0].copy(), [target[0].copy()]
        for goal in target[1:]:
            if slow:
                state = state + (goal - state) * (INTERVAL / FINE / slow)
            elif backlash:
                state = np.clip(state, goal - backlash / 2, goal + backlash / 2)
            else:
                state = goal
            states.append(state)
        measured.append(np.stack(states[::FINE]))
    result = np.stack(measured)
    return result + noise * np.random.default_rng(0).normal(size=result.shape)


def told(**faults):
    measured = arms(**faults)
    n = len(MOTIONS)
    return actuation(
        measured, commands(), np.full(n, INTERVAL), np.full(n, measured.shape[1]), np.arange(n), np.full(n, True)
    )


def test_exact_arms_do_not_deviate():
    result = told()
    assert not result.deviates and result.explained and result.effects == {}
    np.testing.assert_allclose(result.commanded, arms(noise=0.0), atol=2e-4)


@pytest.mark.parametrize("gain", [0.92, 1.08])
def test_a_gain_is_told(gain):
    result = told(gain=gain)
    assert set(result.effects) == {"actuation_gain"} and result.explained(2e-4)
    estimate = result.effects["actuation_gain"]["gain"]
    low, high = estimate.ci90
    assert estimate.value == pytest.approx(gain, abs=0.002) and low <= gain <= high and estimate.unit == ""


@pytest.mark.parametrize(
    ("delay", "slow"), [(0.25, 0.0), (0.0, 0.25), (0.15, 0.2)], ids=["delay", "first order", "delay and first order"]
)
def test_a_lag_is_told_by_its_total(delay, slow):
    result = told(delay=delay, slow=slow)
    assert set(result.effects) == {"actuation_lag"} and result.explained(2e-4)
    total, pure = (result.effects["actuation_lag"][name] for name in ("time_s", "delay_s"))
    low, high = total.ci90
    assert pure.value == pytest.approx(delay, abs=0.02)
    assert total.value == pytest.approx(delay + slow, abs=0.02) and total.unit == pure.unit == "s"
    assert low - 0.01 <= delay + slow <= high + 0.01
    low, high = pure.ci90
    assert low - 0.01 <= delay <= high + 0.01 and high - low > 5e-4, "no delay is known to the last digit"
    assert result.leftover < 0.1 * result.deviation


def test_gain_and_lag_are_told_together():
    result = told(gain=1.08, delay=0.1, slow=0.15)
    assert set(result.effects) == {"actuation_gain", "actuation_lag"} and result.explained(2e-4)
    assert result.effects["actuation_gain"]["gain"].value == pytest.approx(1.08, abs=0.004)
    assert result.effects["actuation_lag"]["time_s"].value == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize(("backlash", "verdict"), [(0.012, "unknown"), (0.001, "none")])
def test_backlash_is_seen_but_has_no_name(backlash, verdict):
    result = told(backlash=backlash)
    assert result.deviates and not result.effects
    assert with_arms(NOTHING, result, Calibration()).verdict == verdict


@pytest.mark.parametrize("faults", [{}, {"gain": 1.08}], ids=["none", "gain"])
def test_noise_of_the_measured_poses_is_no_deviation(faults):
    result = told(noise=5e-4, **faults)
    assert result.noise == pytest.approx(5e-4 * np.sqrt((1 + 1 + 0.15**2) / 3), rel=0.4)
    assert set(result.effects) == ({"actuation_gain"} if faults else set())
    assert with_arms(NOTHING, result, Calibration()).verdict == ("named" if faults else "none")


def test_episodes_without_commands_say_nothing_of_the_arms():
    """An importer made theirs of the poses: counted as commands, they would be of exact arms."""
    measured, n = arms(gain=1.08), len(MOTIONS)
    derived, known = commands().copy(), np.arange(n) > 0
    derived[0, :-1] = np.diff(measured[0], axis=0) / INTERVAL
    shape = np.full(n, INTERVAL), np.full(n, measured.shape[1])
    result = actuation(measured, derived, *shape, np.arange(n), known)
    gain = result.effects["actuation_gain"]["gain"]
    low, high = gain.ci90
    assert gain.value == pytest.approx(1.08, abs=1e-3) and low <= 1.08 <= high and not result.count[0]
    np.testing.assert_array_equal(result.predicted[0], measured[0])
    np.testing.assert_array_equal(result.commanded[0], measured[0])
    nothing = actuation(measured, derived, *shape, np.arange(n), np.full(n, False))
    assert not nothing.deviates and nothing.effects == {}


def test_an_effect_at_the_bound_of_its_fit_has_no_name():
    """Commands that mean something else are fitted best by arms that barely move."""
    measured, n = arms(), len(MOTIONS)
    result = actuation(
        measured, 50.0 * commands(), np.full(n, INTERVAL), np.full(n, measured.shape[1]), np.arange(n), np.full(n, True)
    )
    assert result.deviates and not result.effects and result.strays(1e-3)


def test_poses_with_the_effects_are_the_measured_ones():
    measured = arms(gain=1.08, slow=0.2)
    result = told(gain=1.08, slow=0.2)
    assert np.abs(result.predicted - measured).max() < 1e-3 < np.abs(result.commanded - measured).max()


def test_padding_does_not_count():
    measured, twist = arms(gain=1.08), commands()
    length = np.array([measured.shape[1]] * len(MOTIONS))
    padded = np.concatenate([measured, np.full((*measured.shape[:1], 30, 2, 3), 9.0)], axis=1)
    more = np.concatenate([twist, np.zeros((*twist.shape[:1], 30, 2, 3))], axis=1)
    plain = actuation(measured, twist, np.full(4, INTERVAL), length, np.arange(4), np.full(4, True))
    result = actuation(padded, more, np.full(4, INTERVAL), length, np.arange(4), np.full(4, True))
    gain, expected = (one.effects["actuation_gain"]["gain"].value for one in (result, plain))
    assert gain == pytest.approx(expected, abs=1e-6)
    assert result.deviation == pytest.approx(plain.deviation)


NOTHING = Conclusion("none", Fit(explanation(), np.zeros(4), np.zeros((4, 0)), np.zeros((4, 0, 0))), (), (), (), 0.0)


@pytest.mark.parametrize(
    ("faults", "names"),
    [
        ({"gain": 0.92}, {"actuation_gain"}),
        ({"slow": 0.25}, {"actuation_lag"}),
        ({"gain": 1.08, "slow": 0.25}, {"actuation_gain", "actuation_lag"}),
    ],
    ids=["gain", "lag", "both"],
)
def test_probabilities_are_those_of_errors_on_motions_that_no_fit_has_seen(faults, names):
    conclusion = with_arms(NOTHING, told(**faults), Calibration())
    assert conclusion.verdict == "named" and {effect.name for effect in conclusion.effects} == names
    assert all(0.95 < effect.probability <= 1.0 for effect in conclusion.effects)
    # one of them, or none
    chances = [ranked.probability for ranked in conclusion.ranking]
    assert 0.95 < sum(chances) < 1.0 and max(chances) > 0.95


@pytest.mark.parametrize("scatter", [3e-4, 1e-3, 2e-3])
def test_poses_that_scatter_are_no_fault_of_the_arms(scatter):
    wanted, turn = np.stack([poses(m) for m in MOTIONS]), [1.0, 1.0, 1 / ROTATION_WEIGHT]
    shape = np.full(len(wanted), INTERVAL), np.full(len(wanted), wanted.shape[1])
    drawn = scatter * np.random.default_rng(0).standard_normal(wanted.shape) * turn
    known = np.arange(len(wanted)), np.full(len(wanted), True)
    exact = actuation(wanted + drawn, commands(), *shape, *known)
    assert exact.noise == pytest.approx(scatter, rel=0.1) and not exact.deviates
    # and hide none
    result = actuation(arms(gain=1.08) + drawn, commands(), *shape, *known)
    assert result.effects["actuation_gain"]["gain"].value == pytest.approx(1.08, abs=0.01)


def test_arms_err_by_as_much_with_a_short_cable():
    wanted = np.stack([poses(m) for m in MOTIONS])
    wave = 4e-4 * np.sin(0.3 * np.arange(wanted.shape[1]))[None, :, None, None] * [1.0, 1.0, 0.0]
    shape = np.full(len(wanted), INTERVAL), np.full(len(wanted), wanted.shape[1])
    result = actuation(wanted + wave, commands(), *shape, np.arange(len(wanted)), np.full(len(wanted), True))
    assert result.deviates and not result.effects
    for length in (1.0, 0.25):
        assert with_arms(NOTHING, result, calibrated(length), length).verdict == "none"
    assert with_arms(NOTHING, result, calibrated(0.25)).verdict == "unknown"


def test_a_deviation_that_shows_in_one_motion_only_makes_nothing_certain():
    """What was fitted to that motion is no help on the others, and the others say nothing of it."""
    wanted = np.stack([poses(m) for m in MOTIONS])
    one = np.arange(len(MOTIONS))[:, None, None, None] == 0
    measured = np.where(one, arms(gain=1.08), arms())
    shape = np.full(len(wanted), INTERVAL), np.full(len(wanted), wanted.shape[1])
    result = actuation(measured, commands(), *shape, np.arange(len(wanted)), np.full(len(wanted), True))
    conclusion = with_arms(NOTHING, result, Calibration())
    assert max((effect.probability for effect in conclusion.effects), default=0.0) < 0.5


def test_draws_of_an_explanation_have_the_arms_in_them():
    cable = (EffectValues("bending_stiffness", {"ratio": 2.0}),)
    found = dataclasses.replace(NOTHING, verdict="named", posterior=(cable,) * 64)
    conclusion = with_arms(found, told(gain=1.08, delay=0.1, slow=0.15), Calibration())
    assert all(draw[-1] == cable[0] for draw in conclusion.posterior)
    lags = [draw[1].parameters for draw in conclusion.posterior]
    assert {draw[0].name for draw in conclusion.posterior} == {"actuation_gain"}
    assert np.mean([lag["time_s"] for lag in lags]) == pytest.approx(0.25, abs=0.02)
    assert all(0 <= lag["delay_s"] <= lag["time_s"] for lag in lags)
    assert np.std([lag["time_s"] for lag in lags]) > 0 and np.mean([lag["delay_s"] for lag in lags]) > 0.05


def test_many_motions_leave_both_single_effects_without_a_chance_and_the_ranking_whole():
    one = told(gain=1.08, delay=0.1, slow=0.15)
    many = dataclasses.replace(
        one,
        count=np.tile(one.count, 60),
        motion=np.arange(60 * len(one.motion)),
        unseen={effects: np.tile(error, 60) for effects, error in one.unseen.items()},
    )
    conclusion = with_arms(NOTHING, many, Calibration())
    assert sum(ranked.probability for ranked in conclusion.ranking) == pytest.approx(1.0)


def test_what_the_arms_alone_explain_has_draws_too():
    conclusion = with_arms(NOTHING, told(gain=1.08), Calibration())
    assert conclusion.verdict == "named" and len(conclusion.posterior) == 16
    assert {draw[0].name for draw in conclusion.posterior} == {"actuation_gain"}


def test_that_the_cable_may_have_no_effect_is_said_beside_the_arms():
    cable = (EffectValues("bending_stiffness", {"ratio": 2.0}),)
    found = dataclasses.replace(NOTHING, verdict="named", posterior=(cable,) * 12 + ((),) * 4, nothing=0.25)
    assert "With a probability of 25 % there is no effect" in sentence(
        with_arms(found, told(gain=1.08), Calibration()), 0.8
    )
