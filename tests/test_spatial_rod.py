"""The rod in space against MuJoCo's composite, against statics, and its derivatives."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cablejax.cable import Cable, Discretisation
from cablejax.simulate.compile import compiler_options
from cablejax.simulate.composite import build_grasped_chain, link_bodies
from cablejax.simulate.rod import Rod, RodPhysics
from cablejax.simulate.rod.material import forces_of_torques, spin_of_joints

_INTERVAL = 0.01


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def _poses(time, sideways):
    """Gripper 0 stands still; gripper 1 comes 0.3 m nearer in an arc and tilts, softly. Position and quaternion."""
    s = 0.5 * (1 - np.cos(np.pi * min(time, 0.8) / 0.8))
    quaternion = np.array([np.cos(0.3 * s), 0.0, -np.sin(0.3 * s), 0.0])
    position = np.array([1.0 - 0.3 * s, sideways * s, 0.1 * np.sin(np.pi * s)])
    return (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])), (position, quaternion)


def _axes(quaternion):
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return rotation.reshape(3, 3).T


def _inputs(samples, sideways):
    poses = [_poses(_INTERVAL * k, sideways) for k in range(samples)]
    position = np.array([[p for p, _ in pair] for pair in poses])
    frames = np.array([[_axes(q) for _, q in pair] for pair in poses])
    return position, frames


def _mujoco(config, samples, sideways):
    """Nodes of the composite in C MuJoCo at every sample, shape [T, n, 3]."""
    model = build_grasped_chain(config)
    data = mujoco.MjData(model)
    mocap = [model.body_mocapid[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"gripper_{k}")] for k in range(2)]
    links = link_bodies(model)
    substeps, points = round(_INTERVAL / config.timestep), []
    for sample in range(samples):
        for k in range(substeps if sample else 0):
            pair = _poses(_INTERVAL * (sample - 1) + (k + 1) * config.timestep, sideways)
            for body, (position, quaternion) in zip(mocap, pair, strict=True):
                data.mocap_pos[body], data.mocap_quat[body] = position, quaternion
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        points.append(data.xipos[links].copy())
    return np.array(points)


def _physics(arclength, **changes):
    n = len(arclength)
    values = {
        "length": 1.0, "stiffness": np.full(1, 0.05), "rest_curvature": np.zeros((1, 2)), "damping_time": 0.05,
        "drag": 0.0, "quadratic_drag": 0.0, "twist_stiffness": 0.05, "stretch": 1e6, "marker_mass": 0.0,
        "clamp_rotation": np.zeros((2, 2)), "arclength": arclength,
        "offset": np.zeros((n, 2)), "gravity": np.array([0.0, 0.0, -9.81]),
    }  # fmt: skip
    return RodPhysics(**{name: jnp.asarray(v, float) for name, v in {**values, **changes}.items()})


def _run(rod, physics, position, frames, seen):
    run = jax.jit(
        lambda p: rod.rollout(p, position, frames, seen, _INTERVAL).points, compiler_options=compiler_options()
    )
    return np.asarray(run(physics))


@pytest.mark.parametrize(("sideways", "twisting"), [pytest.param(0.0, False, marks=pytest.mark.slow), (0.15, True)])
def test_agrees_with_the_mujoco_composite(sideways, twisting):
    config = Discretisation(
        Cable(
            friction_coefficient=0.0,
            bending_stiffness=0.002,
            damping_time=0.05,
            linear_density=0.04,
            diameter=0.006,
        ),
        dimension=3,
        n_links=33,
        timestep=5e-4,
    )
    reference = _mujoco(config, 101, sideways)[:, 1:-1]
    arclength = np.arange(1, 32) * config.link_length
    position, frames = _inputs(101, sideways)
    rod = Rod(n_edges=32, substeps=4, twisting=twisting)
    found = _run(rod, _physics(arclength), position, frames, jnp.asarray(reference[:2]))
    distance = np.linalg.norm(found - reference, axis=-1)
    assert distance.mean() < 1e-3
    assert np.linalg.norm(reference - reference[0], axis=-1).max() > 0.25


@pytest.mark.slow
def test_second_order_in_the_time_step():
    arclength = np.linspace(0.1, 0.9, 9)
    position, frames = _inputs(80, 0.1)
    seen = jnp.asarray(np.stack([np.stack([arclength, 0 * arclength, 0 * arclength], axis=1)] * 2))
    physics = _physics(arclength, drag=0.5)
    runs = {
        k: _run(Rod(12, k, twisting=False, local_error=np.inf), physics, position, frames, seen) for k in (1, 2, 4, 16)
    }
    off = {k: np.abs(run - runs[16]).mean() for k, run in runs.items()}
    # gravity sets in at once, with which no multistep method starts at its full order
    assert off[2] < 0.5 * off[1]
    assert off[4] < 0.5 * off[2]
    assert off[1] < 1e-3


@pytest.mark.slow
def test_second_order_in_the_length_of_edges():
    """Of a cable of uneven stiffness that does not begin at rest: both had once made it of first order."""
    arclength = np.linspace(0.1, 0.9, 9)
    position, frames = _inputs(60, 0.1)
    seen = np.stack([arclength, 0.04 * np.sin(2 * np.pi * arclength), 0 * arclength], axis=1)
    physics = _physics(arclength, stiffness=[0.3, 0.03], drag=0.5)
    coarse, middle, fine = (
        _run(Rod(n, 4, twisting=False, local_error=np.inf), physics, position, frames, jnp.asarray([seen, seen]))
        for n in (10, 20, 40)
    )
    assert np.abs(coarse - middle).mean() > 3.0 * np.abs(middle - fine).mean()


@pytest.mark.parametrize("axis", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_cable_clamped_on_its_rest_shape_stays(axis):
    """A cable with one bend, about the material's second or third axis, which are y and z here."""
    dense = np.linspace(0.0, 1.0, 2001)
    curvature = 5.0 * np.exp(-(((dense - 0.3) / 0.1) ** 2))
    turn = np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]) * np.diff(dense))])
    across = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])[axis]
    tangent = np.cos(turn)[:, None] * np.eye(3)[0] + np.sin(turn)[:, None] * across
    points = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(0.5 * (tangent[1:] + tangent[:-1]) * np.diff(dense)[:, None], 0)]
    )
    arclength, samples = np.linspace(0.1, 0.9, 9), 60
    marks = points[np.round(2000 * arclength).astype(int)]
    about = np.eye(3)[1 + axis]
    frames = []
    for t in tangent[[0, -1]]:
        frames.append(np.array([t, about, np.cross(t, about)] if axis == 0 else [t, np.cross(about, t), about]))
    position = np.repeat(points[None, [0, -1]], samples, 0)
    rest = np.zeros((41, 2))
    rest[:, axis] = 5.0 * np.exp(-(((np.linspace(0.0, 1.0, 41) - 0.3) / 0.1) ** 2))
    rod, moved = Rod(24), {}
    run = jax.jit(
        lambda p: (
            rod.rollout(
                p, position, np.repeat(np.array(frames)[None], samples, 0), np.stack([marks] * 2), _INTERVAL
            ).points
        ),
        compiler_options=compiler_options(),
    )
    for name, curved in {
        "its own": rest,
        "straight": 0 * rest,
        "turned over": -rest,
        "uniform": 0 * rest + 2.0,
    }.items():
        physics = _physics(arclength, rest_curvature=curved, gravity=np.zeros(3), drag=1.0)
        moved[name] = np.asarray(run(physics))[-1] - marks
    size = {name: np.abs(off).max() for name, off in moved.items()}
    assert size["its own"] < 2e-3
    assert size["straight"] > 10 * size["its own"]
    assert size["turned over"] > size["straight"]


def test_hangs_as_a_catenary_when_it_hardly_resists_bending():
    arclength = np.linspace(0.1, 0.9, 9)
    samples = 400
    position = np.repeat(np.array([[[0.0, 0, 0], [0.6, 0, 0]]]), samples, 0)
    # along the catenary at its ends: sinh(d / 2a) = s / 2a
    a = 0.5
    for _ in range(100):
        a = 0.3 / np.arcsinh(0.5 / a)
    slope = np.array([-0.5 / a, 0.5 / a])
    along = np.stack([np.ones(2), np.zeros(2), slope], axis=1) / np.hypot(1, slope)[:, None]
    frames = np.stack([np.stack([t, [0, 1.0, 0], np.cross(t, [0, 1.0, 0])]) for t in along])
    s = arclength - 0.5
    x = 0.3 + a * np.arcsinh(s / a)
    z = np.sqrt(a**2 + s**2) - np.sqrt(a**2 + 0.25)
    catenary = np.stack([x, 0 * x, z], axis=1)
    pushed = catenary + 0.03 * np.sin(np.pi * arclength)[:, None] * np.array([0.0, 1.0, 0.0])
    physics = _physics(arclength, stiffness=np.full(1, 1e-4), drag=3.0)
    found = _run(
        Rod(24, twisting=False), physics, position, np.repeat(frames[None], samples, 0), jnp.asarray([pushed, pushed])
    )
    assert np.abs(found[-1] - catenary).max() < 2e-3


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences():
    arclength = np.linspace(0.1, 0.9, 9)
    position, frames = _inputs(25, 0.1)
    seen = np.stack([np.stack([arclength, 0 * arclength, -0.1 * np.sin(np.pi * arclength)], axis=1)] * 2)
    physics = _physics(
        1.04 * arclength,
        length=1.04,
        rest_curvature=np.array([[0.5, -0.3], [0.2, 0.4]]),
        clamp_rotation=np.array([[0.05, -0.02], [0.01, 0.03]]),
        offset=np.full((9, 2), 0.002),
        drag=0.4,
        quadratic_drag=0.2,
        marker_mass=0.01,
        twist_stiffness=0.03,
    )
    rod = Rod(12)

    def motion(physics):
        return rod.rollout(physics, position, frames, seen, _INTERVAL).points[::10]

    run = jax.jit(motion, compiler_options=compiler_options())
    slope = jax.jit(lambda d: jax.jvp(motion, (physics,), (d,))[1], compiler_options=compiler_options())
    back = jax.jit(lambda w: jax.vjp(motion, physics)[1](w)[0], compiler_options=compiler_options())
    rng = np.random.default_rng(0)
    weight = jnp.asarray(rng.normal(size=run(physics).shape))
    transposed = back(weight)
    for field in dataclasses.fields(physics):
        value = getattr(physics, field.name)
        moved = 1e-2 * jnp.maximum(jnp.abs(value).max(), 0.05) * rng.normal(size=jnp.shape(value))
        direction = dataclasses.replace(jax.tree.map(jnp.zeros_like, physics), **{field.name: moved})
        derivative = slope(direction)
        # far above what a time step leaves unsolved, 1e-9 m, and small for the motion
        step = min(1e-5 / float(jnp.abs(derivative).max()), 0.1)
        ahead, behind = (run(jax.tree.map(lambda x, d, k=k: x + k * d, physics, direction)) for k in (step, -step))
        difference = (ahead - behind) / (2 * step)
        largest = float(np.abs(difference).max())
        assert largest > 1e-8, field.name
        np.testing.assert_allclose(derivative, difference, atol=2e-3 * largest, rtol=0, err_msg=field.name)
        forward, reverse = jnp.vdot(weight, derivative), jnp.vdot(getattr(transposed, field.name), moved)
        np.testing.assert_allclose(reverse, forward, rtol=1e-6, atol=1e-6 * largest, err_msg=field.name)


@pytest.mark.parametrize("twisting", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_damping_does_not_resist_a_cable_that_turns_as_a_whole(twisting):
    # both grippers are carried around the vertical and turn with it, and soon the cable does too
    arclength = np.linspace(0.1, 0.9, 7)
    time = _INTERVAL * np.arange(300)
    angle = 1.5 * (time + np.exp(-3 * time) / 3)
    turn = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    # the cable leaves one gripper downwards and comes up to the other
    down = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    up = down * np.array([-1.0, 1.0, -1.0])[:, None]
    frames = np.einsum("tij,qkj->tqki", turn, np.stack([down, up]))
    position = np.einsum("tij,qj->tqi", turn, np.array([[-0.2, 0.0, 0.0], [0.2, 0.0, 0.0]]))
    sagging = np.stack([0.4 * arclength - 0.2, 0 * arclength, -0.4 * np.sin(np.pi * arclength)], axis=1)
    seen = jnp.asarray(sagging @ turn[:2].transpose(0, 2, 1))
    rod = Rod(n_edges=16, twisting=twisting)
    little, much = (
        _run(rod, _physics(arclength, damping_time=tau, drag=0.5), position, frames, seen)[-1] for tau in (0.02, 0.3)
    )
    assert np.linalg.norm(little - much, axis=1).max() < 1e-4


def test_material_turns_with_a_body_that_turns_as_a_whole():
    rng = np.random.default_rng(0)
    edges = 0.05 * np.stack([np.cos(np.linspace(0, 3, 12)), np.sin(np.linspace(0, 3, 12)), np.linspace(0, 1, 12)], 1)
    spin = rng.normal(size=3)
    tangents = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    rate = np.cross(spin, edges)
    found = spin_of_joints(*map(jnp.asarray, (edges, rate, tangents[[0, -1]] @ spin)))
    np.testing.assert_allclose(found, np.broadcast_to(spin, found.shape), atol=1e-12)


def test_forces_of_torques_have_the_power_of_the_torques():
    rng = np.random.default_rng(0)
    edges = 0.05 * (np.array([1.0, 0.0, 0.0]) + 0.4 * rng.normal(size=(12, 3)))
    edges[5] = [-0.05, 0.01, 0.0]  # a fold that is not resolved
    torque, rate = rng.normal(size=(11, 3)), rng.normal(size=(12, 3))
    edges, torque, rate, still = map(jnp.asarray, (edges, torque, rate, np.zeros(2)))
    spin, transposed = jax.vjp(lambda rate: spin_of_joints(edges, rate, still), rate)
    force = forces_of_torques(edges, torque)
    np.testing.assert_allclose(force, transposed(torque)[0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(jnp.vdot(force, rate), jnp.vdot(torque, spin), rtol=1e-12)


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_rod_begins_at_its_markers_however_few(count):
    """An arch with one or two markers: beyond them the clamps say where the first shape goes on."""
    opening = 1.9
    radius, s = 1.0 / opening, np.linspace(0.0, 1.0, count + 2)

    def place(at):
        angle = opening * (at - 0.5)
        height = radius * (np.cos(opening / 2) - np.cos(angle))
        return np.stack([radius * np.sin(angle), 0 * at, height], axis=-1)

    angle = opening * (s[[0, -1]] - 0.5)
    along = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    across = np.broadcast_to([0.0, 1.0, 0.0], (2, 3))
    frames = np.broadcast_to(np.stack([along, across, np.cross(along, across)], axis=1), (3, 2, 3, 3))
    physics = RodPhysics(
        length=jnp.ones(()), stiffness=jnp.full(1, 0.25), rest_curvature=jnp.zeros((1, 2)),
        damping_time=jnp.asarray(0.03), drag=jnp.asarray(0.3), quadratic_drag=jnp.zeros(()),
        twist_stiffness=jnp.asarray(0.1), stretch=jnp.asarray(5e4), marker_mass=jnp.zeros(()),
        clamp_rotation=jnp.zeros((2, 2)), arclength=jnp.asarray(s[1:-1]), offset=jnp.zeros((count, 2)),
        gravity=jnp.array([0.0, 0.0, -9.81]),
    )  # fmt: skip
    seen = np.broadcast_to(place(s[1:-1]), (2, count, 3))
    found = Rod(32, 1, twisting=False).rollout(
        physics, np.broadcast_to(place(s[[0, -1]]), (3, 2, 3)), frames, seen, _INTERVAL
    )
    np.testing.assert_allclose(found.points[0], seen[0], atol=3e-3)


@pytest.fixture(scope="module")
def swung():
    """A cable that is shaken, from the middle of its motion on: poses, six markers with gaps, and its true markers."""
    arclength, count, begin = np.linspace(0.12, 0.88, 6), 150, 60
    time = _INTERVAL * np.arange(count)
    swing = np.stack([0 * time, 0.05 * np.sin(9 * time), 0.04 * np.sin(13 * time)], axis=1)
    position = np.stack([swing, np.array([0.6, 0.0, 0.0]) - swing], axis=1)
    down = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    frames = np.broadcast_to(np.stack([down, down * np.array([-1.0, 1.0, -1.0])[:, None]]), (count, 2, 3, 3))
    sag = np.stack([0.6 * arclength, 0 * arclength, -0.4 * np.sin(np.pi * arclength)], axis=1)
    with jax.enable_x64(True):
        physics = _physics(arclength, damping_time=0.01, stiffness=np.full(1, 0.02))
        true = _run(Rod(40, 4, twisting=False), physics, position, frames, np.stack([sag, sag]))[begin:]
    shown = true[:12].copy()
    shown[3:6, 2] = np.nan
    return physics, position[begin:], frames[begin:], shown, true


@pytest.mark.parametrize(
    ("twisting", "changes"),
    [
        (False, {"marker_mass": 0.3}),
        pytest.param(True, {"rest_curvature": np.array([[0.0, 0.0], [1.5, 3.0], [0.0, 0.0]])}, marks=pytest.mark.slow),
    ],
)
def test_a_cable_that_rests_begins_at_rest(twisting, changes):
    arclength = np.linspace(0.0, 1.0, 8)[1:-1]
    physics = _physics(arclength, stiffness=np.full(1, 0.01), damping_time=0.2, drag=5.0, **changes)
    position = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]])
    frames = np.array([Rotation.from_euler("y", angle).as_matrix().T for angle in (0.9, -0.9)])

    def run(seen, physics, samples):
        moving = [np.repeat(part[None], samples, axis=0) for part in (position, frames)]
        return _run(Rod(20, 2, twisting=twisting), physics, *moving, np.stack([seen, seen]))

    sagging = np.stack([0.6 * arclength, 0.0 * arclength, -0.35 * np.sin(np.pi * arclength)], axis=1)
    rest = run(sagging, physics, 1200)[-1]
    assert np.linalg.norm(rest - sagging, axis=1).max() > 0.01
    again = run(rest, dataclasses.replace(physics, damping_time=0.02, drag=0.0), 100)
    assert np.abs(again - rest).max() < 5e-6


@pytest.mark.parametrize("count", [1, 13])
def test_too_few_and_too_many_samples_are_refused(swung, count):
    physics, position, frames, shown, _ = swung
    with pytest.raises(ValueError, match=rf"{count} samples of the markers, expected 2 to 12"):
        Rod().rollout(physics, position[:12], frames[:12], np.resize(shown, (count, *shown.shape[1:])), _INTERVAL)


def test_a_rod_that_was_shown_more_of_a_motion_goes_on_closer_to_it(swung):
    physics, position, frames, shown, true = swung
    rod = Rod(40, 4, twisting=False)
    two, more = (_run(rod, physics, position, frames, shown[:count]) for count in (2, 12))
    off = [np.linalg.norm(found - true, axis=2) for found in (two, more)]
    assert off[1][[2, *range(8, 12)]].max() < 5e-4
    assert np.median(off[1][20:]) < 0.3 * np.median(off[0][20:])


@pytest.mark.parametrize("twisting", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_derivatives_of_a_rod_that_is_shown_a_motion(swung, twisting):
    physics, position, frames, shown, _ = swung
    rod, count, lost = Rod(12, twisting=twisting), 16, np.isnan(shown)
    stiffer = jax.tree.map(jnp.zeros_like, physics)
    stiffer = dataclasses.replace(stiffer, stiffness=0.1 * physics.stiffness, offset=0.002 + physics.offset)
    shifted = 1e-3 * np.random.default_rng(0).standard_normal(shown.shape)

    def last(scale):
        changed = jax.tree.map(lambda leaf, d: leaf + scale * d, physics, stiffer)
        seen = jnp.where(lost, jnp.nan, shown + scale * shifted)
        return rod.rollout(changed, position[:count], frames[:count], seen, _INTERVAL).points[-1]

    compiled = functools.partial(jax.jit, compiler_options=compiler_options())
    run, zero, step = compiled(last), jnp.zeros(()), 1e-3
    forward = compiled(lambda s: jax.jvp(last, (s,), (jnp.ones(()),))[1])(zero)
    difference = (run(zero + step) - run(zero - step)) / (2 * step)
    assert np.abs(difference).max() > 1e-4
    np.testing.assert_allclose(forward, difference, atol=1e-4 * float(np.abs(difference).max()))
    cotangent = np.random.default_rng(1).standard_normal(forward.shape)
    pulled = compiled(lambda s: jax.vjp(last, s)[1](jnp.asarray(cotangent))[0])(zero)
    np.testing.assert_allclose(pulled, np.sum(cotangent * forward), rtol=1e-8)
