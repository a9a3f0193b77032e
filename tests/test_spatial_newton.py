"""Gauss-Newton on what recordings share and on what each has for its own."""

from __future__ import annotations

import dataclasses

import numpy as np

import spatial_cases as cases
from cablejax.bounded import Result
from cablejax.simulate.rod import Rod
from cablejax.spatial.fit import Simulator, Sums
from cablejax.spatial.identify import layout_of
from cablejax.spatial.newton import (
    Move,
    RodFit,
    coordinates,
    improve,
    jackknife,
    moved_by,
    newton_step,
    prior_shifts,
    slopes,
)
from cablejax.spatial.values import Values, from_json, mean_of, shared_by_all, to_json
from cablejax.spatial.windows import windows_of

_EFFECTS = ["bending_stiffness", "bending_damping", "gripper_rotation_offset"]


def _simulator():
    windows = windows_of(cases.recording())
    return windows, Simulator(Rod(16, twisting=False), layout_of(windows, cases.NOMINAL, twisting=False))


def test_a_recording_that_was_not_fitted_has_what_all_share():
    values = Values(np.array([1.0, 2.0]), np.array([3, 7]), np.array([[0.5, 0.0], [0.0, -1.0]]))
    np.testing.assert_array_equal(values.of(np.array([7, 4, 3])), [[1, 1], [1, 2], [1.5, 2]])
    wider = values.covering(np.array([4, 4]))
    np.testing.assert_array_equal(wider.recordings, [3, 4, 7])
    np.testing.assert_array_equal(wider.of(np.array([7, 4, 3])), values.of(np.array([7, 4, 3])))
    longer = values.of_size(3)
    np.testing.assert_array_equal(longer.of(np.array([7])), [[1, 1, 0]])
    np.testing.assert_array_equal(longer.of_size(2).of(np.array([7])), values.of(np.array([7])))
    again = from_json(to_json(values))
    for field in ("shared", "recordings", "own"):
        np.testing.assert_array_equal(getattr(again, field), getattr(values, field))
    other = Values(np.array([3.0, 2.0]), np.array([3, 7]), np.zeros((2, 2)))
    np.testing.assert_array_equal(mean_of(values, other).of(np.array([3])), [[2.5, 2.0]])


def test_what_cannot_be_negative_never_becomes_it():
    layout = _simulator()[1].layout
    drag, damping = (layout.slices[name].start for name in ("drag", "damping_time"))
    values = shared_by_all(np.zeros(layout.size), np.array([0]))
    values.shared[damping] = 0.05
    active = layout.active(["bending_stiffness", "bending_damping", "viscous_drag"])
    down = Move(np.full(layout.size, -3.0), np.zeros_like(values.own))
    less = moved_by(layout, values, active, down).shared
    assert less[drag] == 0.0 and less[damping] == 0.05 * np.exp(-3.0)
    assert less[layout.slices["log_stiffness"].start] == -3.0
    more = moved_by(layout, values, active, down * -1.0).shared
    assert more[drag] > 0.0 and more[damping] == 0.05 * np.exp(3.0)
    np.testing.assert_array_equal(less[~active], values.shared[~active])


def test_elimination_solves_the_whole_system():
    _, simulator = _simulator()
    layout, generator = simulator.layout, np.random.default_rng(0)
    count, group = layout.size, np.array([0, 0, 2, 5, 5])
    roots = 10 * generator.normal(size=(5, 40, count))
    sums = Sums(np.zeros(5), 1e-3 * generator.normal(size=(5, count)), roots.transpose(0, 2, 1) @ roots, np.zeros(5))
    active, spreads = layout.active(_EFFECTS), layout.spreads
    m = np.flatnonzero(active & (spreads > 0))
    own = np.zeros((3, count))
    own[:, m] = 1e-3 * generator.normal(size=(3, len(m)))
    shared = np.where(active, 1e-3, 0.0)
    shared[layout.slices["damping_time"]] = 0.03
    fit = RodFit(Values(shared, np.array([0, 2, 5]), own), active, sums, group)

    # all unknowns at once: shared coordinates, then every recording's own values
    slope, a = slopes(layout, shared), np.flatnonzero(active)
    size = count + 3 * len(m)
    gradient, matrix = np.zeros(size), np.zeros((size, size))
    gradient[:count], matrix[:count, :count] = coordinates(layout, shared), np.eye(count)
    for r, recording in enumerate((0, 2, 5)):
        jacobian = np.zeros((count, size))
        jacobian[:, :count] = np.diag(slope)
        at = count + r * len(m) + np.arange(len(m))
        jacobian[m, at] = 1.0
        gradient += jacobian.T @ sums.gradient[group == recording].sum(axis=0)
        matrix += jacobian.T @ sums.curvature[group == recording].sum(axis=0) @ jacobian
        gradient[at] += own[r, m] / spreads[m] ** 2
        matrix[at, at] += 1 / spreads[m] ** 2
    free = np.concatenate([a, np.arange(count, size)])
    whole = -np.linalg.solve(matrix[np.ix_(free, free)], gradient[free])
    step = newton_step(fit, layout, np.ones(5, bool))
    np.testing.assert_allclose(step.shared[a], whole[: len(a)], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(step.own[:, m].ravel(), whole[len(a) :], rtol=1e-6, atol=1e-12)
    assert not step.shared[~active].any()

    # the shared part of the whole inverse is what a unit pull on each shared coordinate does
    shifts = np.zeros((count, count))
    shifts[np.ix_(a, a)] = np.linalg.inv(matrix[np.ix_(free, free)])[: len(a), : len(a)]
    np.testing.assert_allclose(prior_shifts(fit, layout), shifts * slope, rtol=1e-6, atol=1e-12)


def test_grips_of_every_recording_are_found_and_leave_the_stiffness_alone():
    windows, simulator = _simulator()
    layout = simulator.layout
    where, generator = layout.slices, np.random.default_rng(2)
    true = shared_by_all(np.zeros(layout.size), windows.group)
    true.shared[where["log_stiffness"]], true.shared[where["damping_time"]] = 0.7, 0.03
    true.own[:, where["clamp_rotation"]] = 0.25 * generator.normal(size=(4, 4))
    seen = dataclasses.replace(windows, keypoints=simulator.predict(true, windows))

    start = shared_by_all(np.zeros(layout.size), windows.group)
    start.shared[where["damping_time"]] = 0.06
    fits = {own: improve(simulator, start, _EFFECTS[: 2 + own], seen) for own in (False, True)}
    assert all(fit.result is Result.CONVERGED for fit in fits.values())
    found = fits[True].values
    assert abs(found.shared[where["log_stiffness"]].item() - 0.7) < 0.05
    assert abs(found.shared[where["log_stiffness"]].item() - 0.7) < 0.5 * abs(
        fits[False].values.shared[where["log_stiffness"]].item() - 0.7
    )
    held = [values.of(windows.group)[:, where["clamp_rotation"]] for values in (found, true)]
    assert np.abs(held[0] - held[1]).max() < 0.1
    assert np.abs(held[1]).max() > 0.3
    moves = jackknife(fits[True], layout)
    error = np.sqrt((moves[:, where["log_stiffness"]] ** 2).sum())
    assert 0 < error < 0.2
