"""Time steps of the rod are solved or say so, over wide ranges of cables; their balances; their derivatives."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.simulate.compile import compiler_options
from cablejax.simulate.rod import Rod, RodResult
from cablejax.simulate.rod.constrained import TOLERANCE, ElasticChain, constrained, with_held
from real_cables.rod_grid import INTERVAL, Case, inputs_of, physics_of, rollouts


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


# Corners of the ranges, and a cable as they are recorded.
_GRID = [
    Case(0.0003, 0.3, 1.0, "jerk"),
    Case(0.0003, 1.0, 0.0, "hand"),
    Case(0.0003, 3.0, 0.0, "loop"),
    Case(0.3, 0.3, 0.0, "jerk"),
    Case(0.3, 0.3, 0.03, "loop"),
    Case(0.03, 0.3, 1.0, "loop"),
    Case(0.3, 0.3, 1.0, "loop"),
    Case(0.3, 3.0, 1.0, "taut"),
    Case(0.03, 1.0, 0.03, "jerk"),
    Case(0.03, 1.0, 0.0, "taut"),
]


def test_solved_over_the_ranges_and_near_a_thirtysecond_of_the_step():
    found = rollouts(_GRID, seconds=1.3, edges=16)
    reference = rollouts(_GRID, substeps=32, seconds=1.3, edges=16)
    for one in (found, reference):
        assert (one.result == RodResult.SOLVED).all() and (one.solved == 130).all()
    off = np.abs(found.points - reference.points).mean(axis=(1, 2, 3))
    moved = np.ptp(reference.points, axis=1).mean(axis=(1, 2))
    # BDF2 takes energy out of what vibrates at 20 Hz, as this one does and nothing else damps
    share = [0.1 if case == Case(0.3, 0.3, 0.0, "jerk") else 0.02 for case in _GRID]
    assert (off < share * moved).all(), off / moved


def test_a_jerk_that_folds_a_soft_cable_is_solved():
    # between the edges of a fold, what twist carries grows without bound
    (result,) = rollouts([Case(0.0003, 0.3, 0.03, "jerk")], seconds=1.5, batch=1).result
    assert result == RodResult.SOLVED


def test_a_jerk_is_made_in_short_steps_and_what_follows_in_long_ones():
    one = rollouts([Case(0.03, 1.0, 0.03, "jerk"), Case(0.03, 1.0, 0.03, "hand")], seconds=1.3, edges=16)
    assert one.steps[1] <= 130 < one.steps[0] < 260


@pytest.mark.parametrize("sample", [0, 60])
def test_where_no_step_has_a_solution_it_says_so_and_keeps_what_came_before(sample):
    case = Case(0.03, 1.0, 0.03, "hand")
    position, frames, seen = inputs_of(case, 1.0)
    broken = position.copy()
    broken[sample, 1, 0] = np.nan
    rod = Rod(16, 1, twisting=False)
    # both in one batch: one that is lost does not take others with it
    run = jax.jit(
        jax.vmap(lambda p: rod.rollout(physics_of(case), p, frames, seen, INTERVAL)),
        compiler_options=compiler_options(),
    )
    whole, lost = (
        jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], run(np.stack([position, broken]))) for i in (0, 1)
    )
    assert whole.result == RodResult.SOLVED and np.isfinite(whole.points).all()
    assert lost.result == RodResult.UNSOLVED
    if not sample:
        assert lost.solved == 0
        return
    # the clamp's path between two samples depends on two samples to either side
    assert sample - 2 <= lost.solved <= sample
    np.testing.assert_allclose(lost.points[: lost.solved], whole.points[: lost.solved], atol=1e-9)
    assert (lost.points[lost.solved :] == lost.points[lost.solved - 1]).all()


def test_the_solution_of_a_step_is_one_from_a_poor_guess():
    generator = np.random.default_rng(0)
    h, free, radius = 0.05, 16, 0.3
    turn = 2 * np.arcsin(0.5 * h / radius) * np.arange(free + 4)
    arc = radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    chain = ElasticChain(
        weight=jnp.full(free, 2.2e4), bending=jnp.full(free + 2, 5e3), edge=jnp.asarray(h),
        compliance=jnp.asarray(h**4 / 5e4), pins=jnp.zeros((0, free)),
    )  # fmt: skip
    held = jnp.asarray(arc[[0, 1, -2, -1]]) - jnp.array([[0.0, 0, 0]] * 2 + [[0.05, 0, 0]] * 2)
    guess = arc[2:-2] + 0.005 * generator.normal(size=(free, 3))
    force = 2.2e4 * (arc[2:-2] + 0.01 * generator.normal(size=(free, 3)))
    found = constrained(False, chain, jnp.asarray(force), held, jnp.asarray(guess), jnp.zeros(free + 1))
    assert found.error <= TOLERANCE
    nodes = np.asarray(with_held(found.free, held))
    edges = np.diff(nodes, axis=0)[1:-1]
    stretched = np.sqrt(h**2 + 2 * h**4 / 5e4 * np.asarray(found.tension))
    assert np.abs(np.linalg.norm(edges, axis=1) - stretched).max() < 2 * TOLERANCE
    bends = np.diff(nodes, n=2, axis=0)
    pull = np.asarray(found.tension)[:, None] * edges
    balance = 2.2e4 * nodes[2:-2] + 5e3 * np.diff(bends, n=2, axis=0) - np.diff(pull, axis=0) - force
    assert np.abs(balance).max() < 1e-6 * np.abs(force).max()


def test_without_a_solution_the_error_is_not_finite():
    chain = ElasticChain(jnp.full(6, 1.0), jnp.zeros(8), jnp.asarray(0.1), jnp.asarray(1e-9), jnp.zeros((0, 6)))
    held = jnp.asarray(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.6, 0, 0], [0.7, 0, 0]]))
    found = constrained(False, chain, jnp.full((6, 3), jnp.nan), held, jnp.zeros((6, 3)), jnp.zeros(7))
    assert not found.error <= TOLERANCE and np.isfinite(found.free).all()


def _at_nodes(edges: int, **changes):
    """A cable whose markers are its free nodes, let go from a hanging half wave between clamps that rest."""
    case = Case(0.02, 1.0, 0.0, "jerk")
    h = 1.0 / edges
    physics = dataclasses.replace(
        physics_of(case), arclength=(np.arange(2, edges) - 0.5) * h, offset=np.zeros((edges - 2, 2)),
        drag=np.zeros(()), **changes,
    )  # fmt: skip
    position, frames, seen = inputs_of(case, 0.45)
    along = np.linspace(0, 1, 11)
    ends = np.concatenate([position[:1, 0], seen[0], position[:1, 1]])
    markers = np.stack([np.interp(physics.arclength, along, ends[:, k]) for k in range(3)], axis=1)
    held = [position[0, 0] + s * 0.5 * h * frames[0, 0, 0] for s in (-1, 1)]
    held += [position[0, 1] + s * 0.5 * h * frames[0, 1, 0] for s in (-1, 1)]
    return physics, position, frames, np.stack([markers] * 2), np.array(held), h


_EDGES, _SHARE = 12, 0.2


def _nodes():
    """Nodes [T, n, 3] of the cable at rest in its clamps, a fifth of the usual interval apart, and h."""
    physics, position, frames, seen, held, h = _at_nodes(_EDGES)
    run = jax.jit(
        lambda p: Rod(_EDGES, 2, twisting=False).rollout(
            p, position[:1].repeat(200, 0), frames[:1].repeat(200, 0), seen, _SHARE * INTERVAL
        ),
        compiler_options=compiler_options(),
    )
    found = run(physics)
    assert found.result == RodResult.SOLVED
    points = np.asarray(found.points)
    ends = np.repeat(held[None], len(points), 0)
    return np.concatenate([ends[:, :2], points, ends[:, 2:]], axis=1), h


def test_balances_of_energy_and_momentum():
    nodes, h = _nodes()
    dt = _SHARE * INTERVAL
    velocity = (nodes[2:] - nodes[:-2]) / (2 * dt)
    bends = np.diff(nodes, n=2, axis=1)
    height, elastic = 9.81 * nodes[:, 2:-2, 2].sum(axis=1), 0.01 / h**4 * (bends**2).sum(axis=(1, 2))
    kinetic = 0.5 * (velocity[:, 2:-2] ** 2).sum(axis=(1, 2))
    energy = kinetic + (height + elastic)[1:-1]
    assert np.ptp(kinetic[60:]) > 0.5
    # from when vibrations have died away in which a cable that was drawn at rest begins to move
    assert np.ptp(energy[60:]) < 0.01 * np.ptp(kinetic[60:])
    # what is missing in the balance of forces at each node is the pull of its two edges
    acceleration = (nodes[2:] - 2 * nodes[1:-1] + nodes[:-2]) / dt**2
    missing = acceleration[:, 2:-2] - np.array([0, 0, -9.81]) + 0.02 / h**4 * np.diff(bends[1:-1], n=2, axis=1)
    edges = np.diff(nodes[1:-1], axis=1)[:, 1:-1]
    for lack, along in zip(missing[10:], edges[10:], strict=True):
        pulls = np.zeros((len(along), len(lack), 3))
        for k, edge in enumerate(along):
            if k < len(lack):
                pulls[k, k] -= edge
            if k:
                pulls[k, k - 1] += edge
        matrix = pulls.reshape(len(along), -1).T
        tension = np.linalg.lstsq(matrix, lack.ravel(), rcond=None)[0]
        off = (matrix @ tension - lack.ravel()).reshape(-1, 3)
        assert np.abs(off).max() < 0.03 * np.abs(acceleration).max()
        # the sum over the cable: its momentum changes by its weight and by what the clamps pull
        assert np.abs(off.sum(axis=0)).max() < 0.03 * np.abs(acceleration.sum(axis=1)).max()


@functools.cache
def _last_samples():
    """Last samples of a motion that moves along a direction, its derivative, and that of a weighted sum in reverse."""
    rod = Rod(10, 1, twisting=False)

    def last(scale, physics, direction, position, moved, frames, seen):
        changed = jax.tree.map(lambda leaf, d: leaf + scale * d, physics, direction)
        found = rod.rollout(changed, position + scale * moved, frames, seen, INTERVAL)
        return found.points[-3:], found.result

    def forward(scale, *more):
        return jax.jvp(lambda s: last(s, *more)[0], (scale,), (jnp.ones(()),))[1]

    def weighted(scale, weight, *more):
        return jnp.sum(weight * last(scale, *more)[0])

    return [jax.jit(f, compiler_options=compiler_options()) for f in (last, forward, jax.grad(weighted))]


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        Case(0.03, 1.0, 0.03, "hand"),
        Case(0.03, 1.0, 0.03, "jerk"),
        Case(0.03, 1.0, 0.1, "taut"),
        Case(0.003, 1.0, 0.03, "loop"),
    ],
    ids=lambda case: case.motion,
)
def test_derivatives_of_a_solved_motion(case):
    """Forward mode against central differences, and reverse mode against forward mode."""
    physics, (position, frames, seen) = physics_of(case), inputs_of(case, 1.2)
    generator = np.random.default_rng(0)
    direction = dataclasses.replace(
        jax.tree.map(np.zeros_like, physics), stiffness=0.3 * physics.stiffness, damping_time=np.asarray(0.02),
        length=np.asarray(0.01), drag=np.asarray(0.2), clamp_rotation=0.1 * generator.normal(size=(2, 2)),
    )  # fmt: skip
    more = (physics, direction, position, 1e-3 * generator.normal(size=(2, 3)), frames, seen)
    last, forward, reverse = _last_samples()
    derivative, step = np.asarray(forward(jnp.zeros(()), *more)), 1e-5
    (above, result), (below, _) = (last(jnp.asarray(s), *more) for s in (step, -step))
    assert result == RodResult.SOLVED
    difference = np.asarray(above - below) / (2 * step)
    assert np.abs(difference).max() > 1e-3
    np.testing.assert_allclose(derivative, difference, atol=1e-4 * float(np.abs(difference).max()))
    weight = generator.normal(size=derivative.shape)
    np.testing.assert_allclose(reverse(jnp.zeros(()), weight, *more), np.sum(weight * derivative), rtol=1e-7)
