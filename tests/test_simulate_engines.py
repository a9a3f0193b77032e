"""MJX, threaded C MuJoCo and other programs agree on how a cable moves."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.effects.given import parse_effect, with_effects
from cablejax.effects.physics import nominal_physics
from cablejax.simulate import ChainEngine, MjxEngine, ThreadedEngine
from cablejax.simulate.composite import build_grasped_chain

PLANAR = Discretisation(n_links=25)
SPATIAL = Discretisation(Cable(bending_stiffness=0.05), n_links=13, dimension=3, timestep=0.01)


def planar_pose() -> np.ndarray:
    return np.array([[-0.45, 0.0, 0.5], [0.45, 0.0, -0.5]])


def planar_twist() -> np.ndarray:
    twist = np.zeros((3, 2, 3))
    twist[:, 0] = [0.03, 0.01, 0.15]
    twist[:, 1] = [-0.03, -0.01, 0.1]
    return twist


def tilted(angle: float) -> list[float]:
    """Quaternion of a turn about -y, which lifts the x axis."""
    return [np.cos(angle / 2), 0.0, -np.sin(angle / 2), 0.0]


def spatial_pose() -> np.ndarray:
    return np.array([[-0.4, 0.0, 0.0, *tilted(-0.9)], [0.4, 0.0, 0.0, *tilted(0.9)]])


def spatial_twist() -> np.ndarray:
    twist = np.zeros((3, 2, 6))
    twist[:, 0] = [0.03, 0.02, 0.01, 0.1, 0.0, 0.2]
    twist[:, 1] = [-0.03, -0.01, 0.02, -0.1, 0.1, 0.1]
    return twist


@pytest.mark.parametrize(
    ("config", "pose", "twist"),
    [(PLANAR, planar_pose(), planar_twist()), (SPATIAL, spatial_pose(), spatial_twist())],
    ids=["planar", "spatial"],
)
def test_mjx_follows_c_mujoco_within_a_hundredth_of_a_millimetre(config, pose, twist):
    threaded, mjx = ThreadedEngine(config, n_threads=1), MjxEngine(config)
    state, params = mjx.initial_state(pose), nominal_physics(config)
    _, reference = threaded.rollout(params, state, twist)
    _, trajectory = mjx.rollout(params, state, twist)
    moved = np.abs(np.asarray(reference.keypoints[-1] - reference.keypoints[0])).max()
    assert moved > 0.02
    assert np.abs(np.asarray(trajectory.keypoints - reference.keypoints)).max() <= 1e-5
    np.testing.assert_allclose(trajectory.gripper_pose, reference.gripper_pose, atol=2e-6)


@pytest.mark.parametrize(
    "cable",
    [
        Cable(length=5.0, diameter=0.05, linear_density=2.0, bending_stiffness=50.0),
        Cable(length=0.05, diameter=0.001, linear_density=0.001, bending_stiffness=1e-6, damping_time=0.02),
    ],
    ids=["stiff hose", "short"],
)
def test_c_mujoco_holds_cables_of_any_size(cable):
    config, size = Discretisation(cable), np.array([cable.length, cable.length, 1.0])
    threaded, chain = ThreadedEngine(config, n_threads=1), ChainEngine(config)
    pose, twist = planar_pose() * size, np.tile(planar_twist(), (3, 1, 1)) * size
    state, params = chain.initial_state(pose), nominal_physics(config)
    _, reference = chain.rollout(params, state, twist)
    _, trajectory = threaded.rollout(params, state, twist)
    assert np.abs(np.asarray(trajectory.keypoints - reference.keypoints)).max() <= 1e-3 * cable.length


@pytest.mark.skipif(mujoco.__version__ >= "4", reason="MuJoCo 4 has no cable plugin")
def test_joint_springs_bend_like_the_cable_plugin():
    """A cantilever of 24 links with the elasticity plugin, and with `stiffness = EI / link_length`."""
    length, radius, count, bending_stiffness = 1.0, 0.005, 25, 0.02
    link = length / (count - 1)
    modulus = bending_stiffness / (np.pi * radius**4 / 4)
    shear = bending_stiffness / (np.pi * radius**4 / 2)

    def settle(plugin: str, stiffness: float) -> np.ndarray:
        model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
          <option timestep="0.002" gravity="0 -0.3 -0.2" integrator="implicitfast"/>
          <worldbody>
            <composite type="cable" prefix="c" initial="none" curve="s" count="{count} 1 1" size="{length} 0 0">
              {plugin}
              <joint kind="main" damping="0.01" stiffness="{stiffness}"/>
              <geom type="capsule" size="{radius}" density="1000" contype="0" conaffinity="0"/>
            </composite>
          </worldbody>
        </mujoco>""")
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=1500)
        return data.xpos[1:].copy()

    plugin = f"""<plugin plugin="mujoco.elasticity.cable">
      <config key="twist" value="{shear}"/><config key="bend" value="{modulus}"/><config key="flat" value="true"/>
    </plugin>"""
    by_plugin, by_springs = settle(plugin, 0.0), settle("", bending_stiffness / link)
    assert np.abs(by_plugin[:, 1:]).max() > 0.05
    assert np.abs(by_plugin - by_springs).max() <= 1e-6


@pytest.mark.parametrize("engine", [ThreadedEngine, MjxEngine])
def test_ends_stay_at_the_grippers_while_they_move(engine):
    config = Discretisation(n_links=13)
    simulator = engine(config)
    _, trajectory = simulator.rollout(nominal_physics(config), simulator.initial_state(planar_pose()), planar_twist())
    ends = np.asarray(trajectory.keypoints)[:, [0, -1]]
    np.testing.assert_allclose(ends, np.asarray(trajectory.gripper_pose)[..., :2], atol=5e-6)


@pytest.mark.parametrize("engine", [ThreadedEngine, MjxEngine])
def test_a_batch_equals_its_members(engine):
    config = Discretisation(n_links=9)
    simulator = engine(config)
    poses = np.stack([planar_pose(), planar_pose() * [1, 1, -1]])
    twists = np.stack([planar_twist(), 0.5 * planar_twist()])
    params = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), nominal_physics(config))
    params = dataclasses.replace(params, friction=jnp.array([0.1, 0.4]))
    states = simulator.initial_state(poses)
    _, batch = simulator.rollout(params, states, twists)
    for i in range(2):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], (params, states))
        _, alone = simulator.rollout(*one, twists[i])
        np.testing.assert_allclose(batch.keypoints[i], alone.keypoints, atol=2e-6)


def test_friction_holds_a_cable_that_was_shifted():
    """After a shift, friction leaves the cable behind its frictionless shape, and it stays so while it is held."""
    config = Discretisation(Cable(friction_coefficient=1.0), n_links=17)
    engine = ThreadedEngine(config)
    state, params = engine.initial_state(planar_pose()), nominal_physics(config)
    shift = np.zeros((1, 2, 3))
    shift[..., 0] = 0.05
    state, moved = engine.rollout(params, state, shift)
    _, held = engine.rollout(params, state, np.zeros((20, 2, 3)))
    lag = np.asarray(moved.keypoints[-1] - moved.keypoints[0]) - [0.05, 0.0]
    assert np.abs(lag).max() > 5e-3
    creep = np.abs(np.diff(np.asarray(held.keypoints), axis=0))[1:].max()
    assert creep < config.friction_speed * 1.0, "a held cable creeps no faster than the regularisation speed"


def test_twists_beyond_the_cables_reach_are_warned_of_where_they_are_differentiated_too():
    engine = MjxEngine(Discretisation(n_links=5))
    state, params = engine.initial_state(np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])), nominal_physics(engine.config)
    apart = jnp.zeros((1, 2, 3)).at[0, 1, 0].set(1e-3)
    for direction in (apart, jnp.zeros_like(apart)):
        with pytest.warns(UserWarning, match=r"driven 1\.0010 m apart but the cable is 1 m long"):
            jax.jvp(lambda twist: engine.rollout(params, state, twist)[1].keypoints, (apart,), (direction,))
    with pytest.warns(UserWarning, match=r"driven 1\.0000 m apart .* it is taut"):
        engine.rollout(params, state, jnp.zeros_like(apart))
    slack = engine.initial_state(np.array([[-0.499, 0.0, 0.0], [0.499, 0.0, 0.0]]))
    engine.rollout(params, slack, apart)  # within reach: no warning, which would be an error here
    far = dataclasses.replace(params, actuation_gain=np.float32(3.0))
    with pytest.warns(UserWarning, match=r"driven 1\.0010 m apart"):
        engine.rollout(far, slack, apart)


@pytest.mark.parametrize("engine", [ChainEngine, MjxEngine, ThreadedEngine])
def test_a_cable_that_lies_otherwise_than_the_nominal_one_rests_before_the_first_command(engine):
    engine = engine(Discretisation(n_links=13))
    bent = parse_effect("intrinsic_curvature:centre_m=0.3,width_m=0.2,curvature_per_m=5")
    physics = with_effects(nominal_physics(engine.config), [bent], engine.config)
    laid, still = engine.initial_state(planar_pose()), np.zeros((2, 2, 3))

    def moved(state):
        points = np.asarray(engine.rollout(physics, state, still)[1].keypoints)
        return np.abs(points - points[0]).max()

    rested = engine.settled(physics, laid)
    assert moved(rested) < 1e-3 < 0.01 < moved(laid)
    np.testing.assert_allclose(rested.gripper_pose, laid.gripper_pose, atol=1e-6)
    assert not np.asarray(rested.qvel).any()


def test_what_happens_at_a_time_happens_after_a_cable_has_settled():
    """Slip at 1.5 s is that of an episode."""
    engine = ChainEngine(Discretisation(n_links=13))
    slip = parse_effect("gripper_slip:gripper=1,time_s=1.5,distance_m=0.03")
    physics = with_effects(nominal_physics(engine.config), [slip], engine.config)
    state = engine.settled(physics, engine.initial_state(planar_pose()))
    assert float(state.memory.time) == 0.0
    points = np.asarray(engine.rollout(physics, state, np.zeros((3, 2, 3)))[1].keypoints)
    apart = np.abs(np.diff(points, axis=0)).max(axis=(1, 2))
    assert apart[0] < 5e-4 < 5e-3 < apart[1]
    stretched = with_effects(physics, [parse_effect("axial_stretch:stiffness_n=20")], engine.config)
    memory = engine.settled(stretched, engine.initial_state(planar_pose())).memory
    assert float(memory.stretch_rate) == 0.0 and float(memory.stretch) != 0.0


def test_links_shorter_than_thick_have_an_inertia_that_mujoco_takes():
    assert build_grasped_chain(Discretisation(n_links=200)).nbody > 200


def test_bad_input_is_refused_with_what_came_and_what_was_expected():
    engine = MjxEngine(Discretisation(n_links=5))
    state, params = engine.initial_state(planar_pose()), nominal_physics(engine.config)
    with pytest.raises(ValueError, match=r"\(3, 2, 2\).*expected"):
        engine.rollout(params, state, np.zeros((3, 2, 2)))
    with pytest.raises(ValueError, match="multiple of the time step"):
        engine.rollout(params, state, np.zeros((3, 2, 3)), 0.033)
    with pytest.raises(ValueError, match="length is -1"):
        Discretisation(Cable(length=-1))
    with pytest.raises(ValueError, match="n_links is 1"):
        Discretisation(n_links=1)
    with pytest.raises(ValueError, match="more than the cable's length"):
        engine.initial_state(np.array([[-0.6, 0.0, 0.0], [0.6, 0.0, 0.0]]))
    with pytest.raises(ValueError, match="NaN"):
        engine.initial_state(np.array([[np.nan, 0.0, 0.0], [0.5, 0.0, 0.0]]))
