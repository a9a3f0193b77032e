"""Hanging wires: the shape against boundary-value solutions, its derivatives, and what fits and verdicts make of it."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_bvp

from cablejax.cable import GRAVITY
from cablejax.diagnose.protocol import explanation
from cablejax.simulate import hanging
from cablejax.simulate.elastica import elastica
from cablejax.simulate.hanging import Wire, hanging_angles, hanging_points, joint_arclength
from cablejax.spatial.hanging import (
    HangingWire,
    Photographs,
    diagnose_wire,
    rig_error,
    tracing_noise,
    wire_verdict_json,
)
from cablejax.spatial.hanging_effects import EFFECTS, wire_shape
from real_cables.wires import read_wires
from recording_cases import DATA, needs_wires

LENGTH, LINKS = 1.0, 80
CLAMPS = np.array([[0.0, 0.0, 0.1], [-0.15, 0.02, -2 * np.pi - 0.2]])
STIFFNESS = 6e-3


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def imbalance(angles: jax.Array, wire: Wire, clamps: jax.Array) -> jax.Array:
    """Largest moment out of balance, over EI / L of the wire's middle, and largest distance from the clamp over L."""
    links = angles.shape[0]
    zero = hanging._residual(jnp.append(angles, jnp.zeros(2, angles.dtype)), wire, clamps)
    # The forces that balance the links best; the moments that they leave are those out of balance.
    h = wire.length / links
    lever = h * jnp.stack([-jnp.sin(angles), jnp.cos(angles)], axis=-1)
    force = jnp.linalg.lstsq(lever, -zero[:-2])[0]
    moment = (zero[:-2] + lever @ force) * wire.length / wire.stiffness[links // 2]
    return jnp.maximum(jnp.abs(moment).max(), jnp.abs(zero[-2:]).max() / wire.length)


solved, balance = jax.jit(hanging_angles), jax.jit(imbalance)


def loop(links: int = LINKS) -> np.ndarray:
    """Angles of a round loop through one turn: near enough for Newton's method."""
    return np.linspace(CLAMPS[0, 2], CLAMPS[1, 2], links)


def wire(stiffness: float = STIFFNESS, links: int = LINKS, curvature=0.0) -> Wire:
    joints = jnp.zeros(links + 1)
    return Wire(joints + stiffness, joints + curvature, jnp.asarray(LENGTH))


def exact(stiffness: float, clamps: np.ndarray, curvature_slope, guess: np.ndarray) -> np.ndarray:
    """Points of the continuous wire by collocation, 41 of them, shape [41, 2].

    `EI (theta'' - kappa_0') = (w (L - s) + Fy) cos(theta) - Fx sin(theta)`, with theta, theta', x, z and two forces.
    """

    def slopes(s, y, force):
        load = (LENGTH - s + force[1]) * np.cos(y[0]) - force[0] * np.sin(y[0])
        return np.stack([y[1], load / stiffness + curvature_slope(s), np.cos(y[0]), np.sin(y[0])])

    def ends(a, b, force):
        return np.concatenate([a[[2, 3, 0]] - clamps[0], b[[2, 3, 0]] - clamps[1]])

    s = np.linspace(0, LENGTH, len(guess))
    position = np.concatenate([np.zeros((1, 2)), np.cumsum(np.stack([np.cos(guess), np.sin(guess)], 1), 0)[:-1] * s[1]])
    start = np.stack([guess, np.gradient(guess, s), *position.T])
    found = solve_bvp(slopes, ends, s, start, p=np.array([0.0, -0.5]), tol=1e-8, max_nodes=20000)
    assert found.success
    return found.sol(np.linspace(0, LENGTH, 41))[2:].T


@pytest.mark.slow
def test_the_shape_is_that_of_the_continuous_wire():
    errors = []
    for links in (40, 80, 160):
        angles = solved(wire(links=links), jnp.asarray(CLAMPS), jnp.asarray(loop(links)))
        assert float(balance(angles, wire(links=links), jnp.asarray(CLAMPS))) < 1e-9
        points = np.asarray(hanging_points(angles, jnp.asarray(CLAMPS), LENGTH, 41))
        guess = np.interp(np.linspace(0, 1, 81), np.linspace(0, 1, links), angles)
        truth = exact(STIFFNESS, CLAMPS, lambda s: 0 * s, guess)
        errors.append(np.linalg.norm(points - truth, axis=1).max())
    # of second order in the length of the links
    assert errors[2] < 1e-4 and errors[0] / errors[1] == pytest.approx(4, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.2)


def test_a_curved_rest_shape_is_that_of_the_continuous_wire():
    s = np.asarray(joint_arclength(160, LENGTH))
    bump = 6.0 * np.exp(-(((s - 0.3) / 0.1) ** 2))
    curved = wire(links=160, curvature=bump)
    angles = solved(curved, jnp.asarray(CLAMPS), jnp.asarray(loop(160)))
    slope = lambda s: 6.0 * np.exp(-(((s - 0.3) / 0.1) ** 2)) * -2 * (s - 0.3) / 0.01  # noqa: E731
    truth = exact(STIFFNESS, CLAMPS, slope, np.interp(np.linspace(0, 1, 81), np.linspace(0, 1, 160), angles))
    points = np.asarray(hanging_points(angles, jnp.asarray(CLAMPS), LENGTH, 41))
    assert np.linalg.norm(points - truth, axis=1).max() < 2e-4
    straight = solved(wire(links=160), jnp.asarray(CLAMPS), jnp.asarray(loop(160)))
    assert np.linalg.norm(points - hanging_points(straight, jnp.asarray(CLAMPS), LENGTH, 41), axis=1).max() > 0.01


def test_a_very_stiff_wire_is_the_elastica_without_weight():
    pose = np.array([[-0.3, 0.05, 1.2], [0.35, -0.02, -0.7]])
    arclength = np.linspace(0, LENGTH, 41)
    guess = jnp.linspace(1.2, -0.7, 160) + 0.3 * jnp.sin(jnp.linspace(0, 2 * np.pi, 160))
    angles = solved(wire(1e3, 160), jnp.asarray(pose), guess)
    points = np.asarray(hanging_points(angles, jnp.asarray(pose), LENGTH, 41))
    truth = elastica(pose, LENGTH, arclength, guess=points)
    assert np.linalg.norm(points - truth, axis=1).max() < 1e-4


def test_a_limp_wire_is_a_catenary():
    ends = np.array([[0.0, 0.0, -1.0], [0.5, 0.0, 1.0]])
    s = (np.arange(400) + 0.5) / 400 * LENGTH
    # x = a asinh((s - L / 2) / a), with a from the span
    from scipy.optimize import brentq

    a = brentq(lambda a: 2 * a * np.arcsinh(LENGTH / (2 * a)) - 0.5, 0.01, 1.0)
    ends[:, 2] = np.arctan((np.array([0, LENGTH]) - LENGTH / 2) / a)
    guess = np.arctan((s - LENGTH / 2) / a)
    angles = solved(wire(1e-6, 400), jnp.asarray(ends), jnp.asarray(guess))
    points = np.asarray(hanging_points(angles, jnp.asarray(ends), LENGTH, 41))
    at = np.linspace(0, LENGTH, 41)
    truth = np.stack([a * np.arcsinh((at - 0.5) / a) + 0.25, np.hypot(a, at - 0.5) - np.hypot(a, 0.5)], axis=1)
    assert np.linalg.norm(points - truth, axis=1).max() < 1e-3


def test_only_stiffness_over_weight_and_no_uniform_rest_curvature_shows():
    straight = solved(wire(), jnp.asarray(CLAMPS), jnp.asarray(loop()))
    curved = solved(wire(curvature=4.0), jnp.asarray(CLAMPS), jnp.asarray(loop()))
    np.testing.assert_allclose(curved, straight, atol=1e-9)


def test_no_equilibrium_is_noticed():
    far = jnp.asarray([[0.0, 0.0, 0.0], [1.2, 0.0, 0.0]])
    angles = solved(wire(), far, jnp.zeros(LINKS) + 0.1)
    assert not float(imbalance(angles, wire(), far)) < 1e-2


def test_derivatives_are_those_of_finite_differences_and_of_both_modes():
    random = np.random.default_rng(0)
    s = np.asarray(joint_arclength(40, LENGTH))

    def shape(x):
        there = Wire(jnp.exp(x[0] + x[1] * s), x[2] * jnp.exp(-(((s - 0.3) / 0.2) ** 2)), LENGTH * jnp.exp(x[3]))
        clamps = CLAMPS + jnp.concatenate([x[4:8].reshape(2, 2), x[8:, None]], axis=1)
        return hanging_points(hanging_angles(there, clamps, loop(40)), clamps, there.length, 21)

    @jax.jit
    def both(x, direction, weights):
        value, forward = jax.jvp(shape, (x,), (direction,))
        return value, forward, jax.vjp(shape, x)[1](weights)[0]

    for scale in (1.0, 0.2):  # the second is a much softer wire, nearly vertical and sharply bent below
        x = np.concatenate([[np.log(scale * STIFFNESS), 0.3, 2.0, 0.01], random.normal(scale=0.02, size=6)])
        direction = random.normal(size=10) * [1, 1, 5, 0.1, 0.1, 0.1, 0.1, 0.1, 1, 1]
        weights = random.normal(size=(21, 2))
        _, forward, backward = both(jnp.asarray(x), jnp.asarray(direction), jnp.asarray(weights))
        assert float((backward * direction).sum()) == pytest.approx(float((weights * forward).sum()), rel=1e-8)
        step = 1e-5
        ahead = both(x + step * direction, direction, weights)[0]
        behind = both(x - step * direction, direction, weights)[0]
        central = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(forward, central, atol=1e-6 * float(jnp.abs(forward).max()))


COUNT, REPEATS = 21, 3


@functools.cache
def photographs(curvature: float, ratio: float, noise: float = 2e-4) -> Photographs:
    """A made-up wire in clamps that are a few degrees off: 1.5 m, EI / w of 4e-3 m^3 believed."""
    random = np.random.default_rng(3)
    length, believed = 1.5, 4e-3
    values = {"bending_stiffness": (ratio,), "intrinsic_curvature": (0.25, 0.3, curvature)}
    z = np.concatenate(
        [[p.coordinate(v) for p, v in zip(effect.parameters, values.get(effect.name, effect.null), strict=True)]
         for effect in EFFECTS]
    )  # fmt: skip
    pictures = []
    for ends in ((0.0, -0.123, 0.0), (0.0, -0.124, 0.001), (0.0, -0.122, -0.001)):
        traced = np.zeros((COUNT, 2))
        traced[-1] = ends[1:]
        guess = jnp.linspace(0, -2 * np.pi, 2 * (COUNT - 1))
        off = random.normal(scale=0.05, size=2)
        for stiffness in (2e-2, 8e-3, believed):  # from a stiffer wire, which is a round loop
            clamps = jnp.asarray([[0.0, 0.0, off[0]], [ends[1], ends[2], off[1] - 2 * np.pi]])
            soft = wire(stiffness, 2 * (COUNT - 1))
            guess = solved(Wire(soft.stiffness, soft.rest_curvature, jnp.asarray(length)), clamps, guess)
        points = np.array(wire_shape(jnp.asarray(z), jnp.asarray(off), jnp.asarray(traced), guess, believed, length))
        points[1:-1] += random.normal(scale=noise, size=(COUNT - 2, 2))
        pictures.append(points)
    return Photographs(np.array(pictures), length, believed, 1e-3)


def names(diagnosis) -> tuple[str, ...]:
    return tuple(effect.name for effect in diagnosis.effects)


@pytest.mark.slow
def test_derivatives_of_photographs_are_those_of_finite_differences():
    hanging = HangingWire(photographs(5.0, 0.8))
    trial = explanation((EFFECTS[1], 0, (0.4, 0.3, 2.0)), (EFFECTS[3], 0, (0.01,)))
    random = np.random.default_rng(1)
    trial = trial.moved(trial.z, 0.1 * random.normal(size=(REPEATS, 2)))
    ((here, slopes),) = hanging.linearise([trial], np.array([0, 2]))
    assert slopes.shape == (6, 2, 1, COUNT, 2)
    direction, step = random.normal(size=6), 1e-5
    ahead, behind = (
        hanging.predict([trial.moved(trial.z + s * direction[:4], trial.own + s * direction[4:])], np.array([0, 2]))[0]
        for s in (step, -step)
    )
    np.testing.assert_allclose(here, (ahead + behind) / 2, atol=1e-9)
    np.testing.assert_allclose(np.tensordot(direction, slopes, 1), (ahead - behind) / (2 * step), atol=1e-7)


@pytest.mark.slow
def test_the_intervals_cover_a_softer_wire_with_a_permanent_set():
    diagnosis = diagnose_wire(photographs(5.0, 0.8))
    assert "intrinsic_curvature" in names(diagnosis)
    low, high = diagnosis.stiffness[1:]
    assert low < 0.8 < high < 3 * low  # from three photographs; the prior's interval is a factor of 27
    effects = {effect["name"]: effect["parameters"] for effect in wire_verdict_json(diagnosis)["effects"]}
    for name, true in (("centre_m", 0.375), ("width_m", 0.45), ("curvature_per_m", 5.0)):
        low, high = effects["intrinsic_curvature"][name]["ci90"]
        assert low < true < high, name


def test_a_permanent_set_is_named_where_there_is_one():
    diagnosis = diagnose_wire(photographs(5.0, 1.0))
    assert names(diagnosis) == ("intrinsic_curvature",)
    interval = diagnosis.gap.shrinkage_ci90
    assert interval is not None and interval[0] > 0.5 and diagnosis.verdict in ("named", "ambiguous")
    verdict = json.loads(json.dumps(wire_verdict_json(diagnosis), allow_nan=False))
    (effect,) = verdict["effects"]
    low, high = effect["parameters"]["centre_m"]["ci90"]
    assert low < 0.375 < high
    assert verdict["schema"] == "cablejax-verdict/1" and verdict["gap"]["held_out_episodes"] == [0, 1, 2]
    assert effect["probability"] > 0.9
    assert {entry["name"] for entry in verdict["ranking"]} == {effect.name for effect in EFFECTS}
    assert np.sqrt(np.mean(np.square(verdict["where"]["per_episode_mm"]))) == pytest.approx(
        verdict["gap"]["before_rmse_mm"], rel=0.02
    )
    # no motion was evaluated, and of a shape at rest nothing is learnable online
    assert verdict["next_motion"] is None and verdict["gap"]["split"]["learnable"] is None


def test_nothing_is_named_where_the_wire_is_as_believed():
    diagnosis = diagnose_wire(photographs(0.0, 1.0))
    assert diagnosis.verdict == "none" and diagnosis.effects == () and diagnosis.gap.shrinkage is None
    low, high = diagnosis.stiffness[1:]
    assert low < 1.0 < high and high / low < 1.6


def test_a_softer_wire_is_no_permanent_set():
    diagnosis = diagnose_wire(photographs(0.0, 0.6))
    assert names(diagnosis) == ("bending_stiffness",)
    assert diagnosis.stiffness[1] < 0.6 < diagnosis.stiffness[2] < 0.9


def test_noise_and_the_error_of_the_rig_are_measured():
    random = np.random.default_rng(0)
    smooth = np.stack([np.cos(np.linspace(0, 3, 200)), np.sin(np.linspace(0, 3, 200))], axis=1)
    assert tracing_noise(smooth + random.normal(scale=1e-3, size=(20, 200, 2))) == pytest.approx(1e-3, rel=0.03)
    assert rig_error(random.normal(scale=2e-3, size=(4000, 2))) == pytest.approx(2e-3, rel=0.03)
    for wrong in (np.ones((1, 2)), np.ones(2), np.full((3, 2), np.nan)):
        with pytest.raises(ValueError, match="of two photographs or more"):
            rig_error(wrong)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((2, 21, 2))}, "at least three photographs"),
        ({"points": np.full((3, 21, 2), np.nan)}, "expected finite ones"),
        ({"points": np.zeros((3, 21, 2))}, "the wire measures 0 m, expected its length, 1.5 m"),
        ({"error": 0.0}, r"error is 0\.0, expected a positive number"),
    ],
)
def test_photographs_that_are_none_are_refused(change, message):
    right = {"points": np.zeros((3, 21, 2)), "length": 1.5, "stiffness": 1e-3, "error": 1e-3}
    with pytest.raises(ValueError, match=message):
        Photographs(**(right | change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda points: {"points": points * [-1, 1]}, "from right to left at both clamps, .* reverse the order"),
        (lambda points: {"points": points * [1, -1]}, "hangs upwards from its clamps, .* negate it"),
        (lambda points: {"error": 0.112}, "error is 0.112 m, expected less than 5% of the wire's length"),
    ],
    ids=["from right to left", "upside down", "clamps that move"],
)
def test_photographs_in_other_coordinates_are_refused(change, message):
    s = np.linspace(0, 1, 21)
    points = np.tile(np.stack([0.9 * s, -2.2 * s * (1 - s)], axis=1), (3, 1, 1))
    length = float(np.linalg.norm(np.diff(points[0], axis=0), axis=1).sum())
    right = {"points": points, "length": length, "stiffness": 1e-3, "error": 1e-3}
    Photographs(**right)
    with pytest.raises(ValueError, match=message):
        Photographs(**(right | change(points)))


def test_a_wire_far_softer_than_a_traced_one_comes_to_rest_or_has_none():
    """Newton's method alone ended 0.2 m away from the clamp, without a word."""
    s = np.linspace(0, 1, 2 * (COUNT - 1) + 1)
    clamps = jnp.asarray([[0.0, 0.0, 0.05], [0.7, 0.0, -0.05]])
    guess = jnp.asarray(1.25 * np.cos(np.pi * (s[:-1] + s[1:]) / 2) * -1)
    hanging = jax.jit(hanging_angles)
    for span in (0.7, 0.9, 1.1):
        clamps = clamps.at[1, 0].set(span)
        for factor in (1.0, 1 / 3, 1 / 10, 10.0):
            found = wire(2.5e-3 * factor, 2 * (COUNT - 1))
            found = Wire(found.stiffness, found.rest_curvature, jnp.asarray(1.5))
            points = hanging_points(hanging(found, clamps, guess), clamps, 1.5, COUNT)
            np.testing.assert_allclose(points[-1], [span, 0.0], atol=1e-7)
            assert points[COUNT // 2, 1] < -0.4
    too_far = clamps.at[1, 0].set(1.6)
    assert np.isnan(hanging(found, too_far, guess)).all()


def test_single_precision_is_refused():
    taken = photographs(0.0, 1.0)
    with jax.enable_x64(False), pytest.raises(ValueError, match="double precision"):
        HangingWire(taken)


@needs_wires
@pytest.mark.slow
def test_real_wires_black_and_red_keep_a_set_and_white_does_not():
    wires = read_wires(DATA / "hanging_wires" / "wires.npz")
    error = rig_error(np.concatenate([w.keypoints[:, -1] - w.keypoints[:, 0] for w in wires])[:, [0, 2]])
    for real in wires:
        stiffness = float(real.published_stiffness.mean()) / (GRAVITY * real.linear_density)
        diagnosis = diagnose_wire(Photographs(real.keypoints[..., [0, 2]], real.length, stiffness, error))
        assert ("intrinsic_curvature" in names(diagnosis)) == (real.name != "white"), real.name
        assert diagnosis.gap.shrinkage_ci90 is not None and diagnosis.gap.shrinkage_ci90[0] > 0
        assert 0.4 < diagnosis.stiffness[1] < diagnosis.stiffness[2] < 1.4
